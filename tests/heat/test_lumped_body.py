"""One temperature per piece: exact where the answer is known, and never used where it is not close enough."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.fem.effects import AbsorbedSolar, Convection, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.fem.materials import Material
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.heat.lumped_body import lumped_body

COPPER = Material("copper", 380.0, 8900.0, 380.0)
CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)


def cube(side_m: float = 0.02, temperature_c=80.0):
    return box_mesh(*(planes(0.0, side_m, step=side_m / 4) for _ in range(3)), temperature_c=temperature_c)


def test_a_copper_cube_cools_exponentially() -> None:
    """20 + 60 exp(-h A t / (rho c V)); Bi = h (V / A) / k = 10 / 300 / 380."""
    problem = HeatProblem(cube(), COPPER, effects=(Convection(("*",), 10.0, 20.0),))
    time = TimeSteps(6, 600.0)
    lumped = lumped_body(problem, time, 0.1)
    assert lumped.biot == pytest.approx(10.0 / 300.0 / 380.0, rel=1e-9)
    assert lumped.solution is not None and 0.0 < lumped.bound_k < 0.1
    exact = 20.0 + 60.0 * np.exp(-10.0 * 300.0 * time.times_s / (8900.0 * 380.0))
    np.testing.assert_allclose(lumped.solution.temperature_c, np.tile(exact[:, None], (1, 125)), atol=1e-6)
    assert lumped.solution.energy_residual < 1e-9 and lumped.solution.steps == 0
    lost = 8900.0 * 380.0 * 0.02**3 * (exact[:-1] - exact[1:]) / 600.0
    np.testing.assert_allclose(lumped.solution.effects[0].heat_w, -lost, rtol=1e-6)
    assert "lumped model" in lumped.solution.status


@pytest.mark.parametrize("seed", range(12))
def test_the_full_equations_differ_by_no_more_than_the_bound(seed) -> None:
    rng = np.random.default_rng(seed)
    x = planes(0.0, 0.03, step=0.01)
    mesh = box_mesh(x, x, planes(0.0, 0.02, step=0.005), temperature_c=float(rng.uniform(0.0, 100.0)))
    if seed % 3 == 0:
        # Two pieces that start differently.
        keep = lambda p: np.abs(p[..., 0] - 0.015) > 0.005  # noqa: E731
        mesh = box_mesh(x, x, [0.0, 0.01], keep=keep, temperature_c=lambda p: 20.0 + 1000.0 * (p[:, 0] > 0.015) * 0.04)
    effects = [Convection(("x0", "z1"), float(rng.uniform(1, 30)), 10.0), HeatFlux(("y1",), float(rng.normal() * 200))]
    if rng.random() < 0.7:
        effects.append(Radiation(("x1",), 0.9, float(rng.uniform(-100, 400))))
    if rng.random() < 0.5:
        effects.append(InternalHeat(("*",), 1e4))
    problem = HeatProblem(mesh, COPPER if seed % 2 else CONCRETE, effects=tuple(effects))
    time = TimeSteps(4, float(10 ** rng.uniform(0, 3)))
    lumped = lumped_body(problem, time, np.inf)
    if lumped.biot > 0.1:
        assert lumped.solution is None and "Biot number" in lumped.reason
        return
    fine = solve_heat(problem, AdaptiveSteps(float(time.times_s[-1]), 1e-2, outputs=4))
    difference = np.abs(fine.temperature_c - lumped.solution.temperature_c).max()
    assert difference <= lumped.bound_k + 1e-2, (lumped.bound_k, difference)
    assert lumped.bound_k < 60.0 * difference + 1e-2, "a bound that is worth something"
    for ours, full in zip(lumped.solution.effects, fine.effects, strict=True):
        size = max(np.abs(full.heat_w).max(), 1e-3)
        assert np.abs(ours.heat_w - full.heat_w).max() < 0.2 * size
    assert lumped.solution.energy_residual < 1e-9


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"material": CONCRETE, "effects": (Convection(("*",), 100.0, 20.0),)}, r"Biot number is 0\.196, above 0\.1"),
        ({"effects": (FixedTemperature(("x0",), 20.0),)}, "fixes a temperature or changes"),
        ({"effects": (AbsorbedSolar(("x0",), 1.0, Varying(lambda places, t: t)),)}, "fixes a temperature or changes"),
        ({"initial_temperature_c": np.linspace(20.0, 30.0, 125)}, "starts with differences of"),
        ({"effects": (HeatFlux(("x0",), 1e6), HeatFlux(("x1",), -1e6))}, r"could be wrong by \d+"),
    ],
)
def test_where_it_does_not_apply_it_says_why(change, reason) -> None:
    problem = replace(HeatProblem(cube(), COPPER, effects=(Convection(("*",), 10.0, 20.0),)), **change)
    lumped = lumped_body(problem, TimeSteps(6, 600.0), 0.1)
    assert lumped.solution is None
    assert re.search(reason, lumped.reason), lumped.reason


def test_an_insulated_body_at_one_temperature_stays() -> None:
    lumped = lumped_body(HeatProblem(cube(), COPPER), TimeSteps(2, 1e5), 1e-6)
    assert lumped.solution is not None and lumped.biot == 0.0
    np.testing.assert_allclose(lumped.solution.temperature_c, 80.0, atol=1e-9)


def test_the_bound_is_that_of_its_proof() -> None:
    """In a slab heated at one end psi is q L / (3 k) there: one part for the start and two for all times."""
    mesh = box_mesh(planes(0.0, 0.1, step=0.002), [0.0, 0.01], [0.0, 0.01], temperature_c=20.0)
    psi = 1000.0 * 0.1 / (3.0 * 380.0)
    heated = lumped_body(HeatProblem(mesh, COPPER, effects=(HeatFlux(("x0",), 1000.0),)), TimeSteps(2, 100.0), 1.0)
    assert heated.bound_k == pytest.approx(3.0 * psi, rel=0.01)
    # Air takes it back to 0 in the end: as much again in change, which counts three times.
    air = Convection(("x0",), 10.0, 120.0)
    warmed = lumped_body(HeatProblem(mesh, COPPER, effects=(air,)), TimeSteps(2, 1e6), 1.0)
    assert warmed.bound_k == pytest.approx(6.0 * psi, rel=0.01)
