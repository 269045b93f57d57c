from dataclasses import replace
from datetime import datetime, timezone
from functools import cache

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from tests.support.heat_bodies import CONCRETE, SIDES, STEEL, assemble, box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, Varying, tabulated
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.time_loop import BACKWARD_EULER, SDIRK2, solve_heat
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.scene_fields import Sun
from thermoxels_ns.mesh.tetrahedra import TetMesh

PAPER = TimeSteps(10, 60.0)
SUN = Sun(datetime(2026, 1, 10, tzinfo=timezone.utc), 47.0, 0.0, (0.0, 1.0, 0.0), clear_sky="meinel")


@pytest.mark.parametrize("temperature_c", [-273.15, -40.0, 0.1, 20.0, 1500.3])
def test_uniform_temperature_does_not_change_at_all(random_body, temperature_c) -> None:
    start = np.full(len(random_body.points_m), temperature_c)
    solution = solve_heat(HeatProblem(random_body, CONCRETE, start), PAPER)
    np.testing.assert_array_equal(solution.temperature_c, temperature_c)
    assert solution.energy_residual == 0.0


def test_failure_to_converge_raises(random_body, monkeypatch) -> None:
    monkeypatch.setattr("thermoxels_ns.fem.implicit_equation.MOST_UNBALANCED", 0.0)
    with pytest.raises(HeatError, match=r"The step from 0 s failed.*are not balanced"):
        solve_heat(HeatProblem(random_body, CONCRETE), PAPER)


@pytest.mark.parametrize("outputs", [1, 10])
def test_a_body_at_rest_in_the_dark_still_sees_the_sun_rise(outputs: int) -> None:
    """Nothing flows at midnight; a step as long as an interval would end at midnight again."""
    mesh = box_mesh(*(planes(0.0, 0.2, step=0.1) for _ in range(3)))
    mesh = replace(mesh, temperature_c=np.full(len(mesh.points_m), 5.0))
    sun = AbsorbedSolar(SIDES, 0.7, SUN.irradiance())
    problem = HeatProblem(mesh, CONCRETE, effects=(Convection(SIDES, 10.0, 5.0), sun))
    days = solve_heat(problem, AdaptiveSteps(4 * 86400.0, outputs=outputs))
    assert days.steps >= 96  # one an hour at least
    fine = solve_heat(problem, TimeSteps(4 * 24 * 12, 300.0))
    mean_w = {heat.effect.split(" on ")[0]: float(heat.heat_w.mean()) for heat in days.effects}
    fine_w = {heat.effect.split(" on ")[0]: float(heat.heat_w.mean()) for heat in fine.effects}
    assert fine_w["absorbed solar"] > 1.0
    assert mean_w["absorbed solar"] == pytest.approx(fine_w["absorbed solar"], rel=0.02)
    coarse = solve_heat(problem, TimeSteps(4, 86400.0))
    assert "Steps of 86400 s are longer than the 3600 s by which effects" in coarse.status
    assert "longer than" not in fine.status


@pytest.mark.parametrize("radiates", [False, True])
def test_equal_steps_tell_their_error(radiates) -> None:
    """A wall in air that swings over a day, with steps of 1200 s: against steps of 75 s."""
    swing = Varying(lambda places, time_s: 10.0 + 8.0 * np.sin(2.0 * np.pi * time_s / 86400.0))
    mesh = box_mesh(planes(0.0, 0.3, step=0.05), [0.0, 0.1], [0.0, 0.1], temperature_c=10.0)
    effects = (Convection(("x1",), 25.0, swing), *([Radiation(("x1",), 0.9, 0.0)] if radiates else []))
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    found = solve_heat(problem, TimeSteps(72, 1200.0), estimate_steps=True)
    exact = solve_heat(problem, TimeSteps(1152, 75.0)).temperature_c[::16]
    true_k = float(np.abs(found.temperature_c - exact).max())
    assert 0.5 < found.time_error_k / true_k < 2.0
    assert f"an error of about {found.time_error_k:.2g} K at most" in found.status
    assert np.isnan(solve_heat(problem, TimeSteps(72, 1200.0)).time_error_k)
    assert "takes two of them" in solve_heat(problem, TimeSteps(1, 1200.0), estimate_steps=True).status


@pytest.mark.parametrize("scheme", [BACKWARD_EULER, SDIRK2])
@pytest.mark.parametrize("step_s", [1e-9, 1e-6, 1e-3])
def test_newton_takes_few_steps_however_short_the_time_step(scheme, step_s) -> None:
    """Of two plates that do not touch, at 20 and 60 C."""
    x, apart = [0.0, 0.01, 0.02, 0.03], lambda p: np.abs(p[..., 0] - 0.015) > 0.005
    mesh = box_mesh(x, x, x[:2], keep=apart, temperature_c=lambda p: np.where(p[:, 0] > 0.015, 60.0, 20.0))
    problem = HeatProblem(mesh, CONCRETE, effects=(Radiation(("x1",), 0.9, 306.6),))
    solution = solve_heat(problem, TimeSteps(3, step_s), scheme=scheme)
    assert solution.newton_iterations.max() <= 3 * len(scheme.nodes)
    # As long as nothing has changed to speak of, the heat is that of the first moment.
    around, plate = 306.6 + 273.15, 60.0 + 273.15
    heat = 0.9 * 5.670374419e-8 * (around**4 - plate**4) * 0.03 * 0.01
    np.testing.assert_allclose(solution.effects[0].heat_w, heat, rtol=1e-4)


def test_newton_ends_near_a_steady_state_and_after_it() -> None:
    """Restarts from what is all but steady: the residual begins at round-off and has nowhere to go."""
    effects = (Radiation(("x1",), 0.9, 306.6), Convection(("x0",), 8.0, 10.0))
    mesh = box_mesh(*[np.arange(4) * 0.05] * 3, temperature_c=100.0)
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    steady = solve_steady(problem).temperature_c
    for away in (0.0, 1e-12, 1e-9, 1e-6):
        near = replace(problem, initial_temperature_c=steady + away * np.sin(np.arange(len(steady))))
        for time in (AdaptiveSteps(1e5, 1e-4, outputs=3), TimeSteps(3, 1e-6), TimeSteps(3, 1e7)):
            solution = solve_heat(near, time)
            assert np.abs(solution.temperature_c[-1] - steady).max() < max(10.0 * away, 1e-8)


def test_adaptive_steps_do_not_step_over_a_table() -> None:
    """Two hours of heat in a week: a triangle of 500 W/m2, 1800 kJ/m2 in all."""
    mesh, times_s = box_mesh(np.linspace(0, 0.2, 5), [0, 0.1], [0, 0.1]), 3600.0 * np.array([0, 100, 101, 102, 200])
    flash = tabulated(times_s, np.array([0.0, 0.0, 500.0, 0.0, 0.0]))
    solution = solve_heat(
        HeatProblem(mesh, CONCRETE, effects=(HeatFlux(("x1",), flash),)), AdaptiveSteps(times_s[-1], 0.5, outputs=1)
    )
    assert float(solution.heat_w[0]) * times_s[-1] == pytest.approx(500.0 * 3600.0 * 0.01, rel=0.05)


SCHEMES = (BACKWARD_EULER, SDIRK2)
H = 0.05
STEP_S = H**2 / CONCRETE.diffusivity_m2_s
"""Step after which heat has spread over one element, h^2 / alpha."""

EVERY = (
    FixedTemperature(
        ("x0",), Varying(lambda places, time_s: 10.0 + places.points_m[:, 1] + 5.0 * np.sin(1e-3 * time_s))
    ),
    Convection(("x1", "y0"), Varying(lambda places, time_s: 5.0 + 3.0 * np.cos(1e-3 * time_s)), 30.0),
    Convection(("z0",), 8.0, Varying(lambda places, time_s: 5.0 * np.sin(time_s / 600.0))),
    Radiation(("z1", "y1"), 0.9, -40.0),
    AbsorbedSolar(("z1",), 0.6, 700.0),
    HeatFlux(("y1",), -30.0),
    InternalHeat(("*",), Varying(lambda places, time_s: 300.0 * places.points_m[:, 0] + np.cos(1e-3 * time_s))),
)
"""All kinds of terms, many of them changing in time."""


def bar(parts: int = 8, temperature_c=20.0) -> TetMesh:
    return box_mesh(np.arange(parts + 1) * H, [0, H, 2 * H], [0, H, 2 * H], temperature_c=temperature_c)


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: scheme.name)
@pytest.mark.parametrize("fourier", [1e-3, 1.0, 1e3])
def test_heat_is_conserved_by_every_scheme(scheme, fourier) -> None:
    """Stored = in - out + sources to 1e-9, over every single step, with everything that can flow."""
    mesh = bar(6, lambda p: 20.0 + 30.0 * np.sin(40.0 * p @ [1.0, 2.0, 3.0]))
    problem, time = HeatProblem(mesh, CONCRETE, effects=EVERY), TimeSteps(4, fourier * STEP_S)
    solution = solve_heat(problem, time, scheme=scheme)
    supplied = sum(heat.heat_w for heat in solution.effects)
    exchanged = sum(np.abs(heat.heat_w) for heat in solution.effects)
    np.testing.assert_array_less(np.abs(solution.heat_w - supplied), 1e-9 * exchanged)
    assert solution.energy_residual < 1e-9
    assert np.abs(solution.heat_w).max() > 1e-3
    volume = 2200.0 * 880.0 * 4 * H * H * 6 * H
    stored = np.diff(solution.heat_content_j)
    mass = assemble(mesh, CONCRETE)[1].diagonal()
    assert mass.sum() == pytest.approx(volume, rel=1e-12)
    np.testing.assert_allclose(stored, np.diff(solution.temperature_c @ mass), rtol=1e-6)


def test_steps_of_backward_euler_are_the_textbook_s() -> None:
    """(M + dt A) T1 = M T0 + dt b, solved directly beside it."""
    mesh = bar(6, lambda p: 20.0 + 30.0 * np.sin(40.0 * p[:, 0]))
    problem = HeatProblem(mesh, CONCRETE, effects=(Convection(("x1",), 9.0, 5.0),))
    dt, system = 0.8 * STEP_S, HeatSystem(problem)
    a, mass, state = system.matrix(0.0, np.inf), assemble(mesh, CONCRETE)[1], mesh.temperature_c
    for computed in solve_heat(problem, TimeSteps(3, dt)).temperature_c[1:]:
        b = 5.0 * (a @ np.ones(system.num_nodes))
        state = spsolve((mass + dt * a).tocsc(), mass @ state + dt * b)
        np.testing.assert_allclose(computed, state, atol=1e-9)


def test_a_body_radiates_from_1000_k_to_3_k() -> None:
    """A thin plate in the dark: rho c d dT/dt = -2 sigma T^4, so T = (T0^-3 + 6 sigma t / (rho c d))^(-1/3)."""
    thickness = 1e-3
    mesh = box_mesh([0, 0.01, 0.02], [0, 0.01, 0.02], [0, thickness], temperature_c=1000.0 - 273.15)
    problem = HeatProblem(mesh, STEEL, effects=(Radiation(("z0", "z1"), 1.0, -273.15),))
    rate = 6.0 * 5.670374419e-8 / (7800.0 * 450.0 * thickness)
    for duration, tolerance in ((600.0, 0.05), (1e9, 0.01)):
        solution = solve_heat(problem, AdaptiveSteps(duration, tolerance))
        exact = (1000.0**-3 + rate * solution.times_s) ** (-1.0 / 3.0) - 273.15
        np.testing.assert_allclose(solution.temperature_c, np.broadcast_to(exact[:, None], (11, 18)), atol=tolerance)
        assert solution.energy_residual < 1e-9
        assert np.all(np.diff(solution.temperature_c, axis=0) < 0.0)
    assert solution.temperature_c[-1].max() < 3.0 - 273.15


JUMPS = {
    "fixed": (FixedTemperature(("x0",), 0.0),),
    "cold air": (Convection(("x0",), 25.0, -10.0), Convection(("x1",), 7.69, 20.0)),
    "day": (Convection(("x0",), 25.0, Varying(lambda places, time_s: 10.0 * np.sin(2e-4 * time_s))),),
    "heater": (HeatFlux(("x1",), 500.0), Convection(("x0",), 10.0, 20.0)),
    "sky": (Radiation(("x0",), 0.9, -80.0), InternalHeat(("*",), 300.0)),
}


DURATION_S = 6 * 3600.0


@cache
def many_equal_steps(name: str) -> np.ndarray:
    """Temperatures at ten times, from 1000 steps of second order."""
    problem = HeatProblem(bar(10), CONCRETE, effects=JUMPS[name])
    return solve_heat(problem, TimeSteps(1000, DURATION_S / 1000), scheme=SDIRK2).temperature_c[::100]


@pytest.mark.parametrize("name", JUMPS)
@pytest.mark.parametrize("tolerance_k", [0.5, 0.02])
def test_adaptive_steps_keep_their_tolerance(name, tolerance_k) -> None:
    """Against 1000 equal steps of second order on the same mesh: the error is below what was asked for."""
    problem = HeatProblem(bar(10), CONCRETE, effects=JUMPS[name])
    adaptive = solve_heat(problem, AdaptiveSteps(DURATION_S, tolerance_k))
    error = np.abs(adaptive.temperature_c - many_equal_steps(name)).max()
    assert error < tolerance_k and error < adaptive.time_error_k, f"error {error}, {adaptive.status}"
    assert adaptive.steps < 200 and adaptive.energy_residual < 1e-9
    np.testing.assert_allclose(adaptive.times_s, np.linspace(0.0, DURATION_S, 11))
    assert f"All {adaptive.steps} steps converged" in adaptive.status


def test_adaptive_steps_grow_and_shrink_with_what_happens() -> None:
    problem = HeatProblem(bar(12), CONCRETE, effects=(Convection(("x0",), 25.0, 20.0),))
    assert solve_heat(problem, AdaptiveSteps(1e6, 0.1, outputs=3)).steps == 3
    jump = Convection(("*",), 1e5, Varying(lambda places, time_s: 20.0 if time_s < 5e5 else -20.0))
    solution = solve_heat(HeatProblem(bar(12), CONCRETE, effects=(jump,)), AdaptiveSteps(1e6, 0.1, outputs=10))
    assert solution.temperature_c.min() >= -20.0 - 1e-6 and solution.temperature_c.max() <= 20.0 + 1e-6
    np.testing.assert_allclose(solution.temperature_c[:5], 20.0, atol=1e-9)
    np.testing.assert_allclose(solution.temperature_c[-1], -20.0, atol=0.1)
    assert "repeated" in solution.status


def test_cooling_below_absolute_zero_is_refused() -> None:
    problem = HeatProblem(bar(), CONCRETE, effects=(HeatFlux(("x0",), -1e6),))
    for time in (TimeSteps(10, 600.0), AdaptiveSteps(6000.0)):
        with pytest.raises(HeatError, match="below absolute zero"):
            solve_heat(problem, time)
