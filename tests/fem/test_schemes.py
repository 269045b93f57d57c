from functools import cache

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from tests.support.heat_bodies import CONCRETE, STEEL
from tests.support.heat_matrices import assemble
from tests.support.heat_meshes import box_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, Varying
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.time_loop import BACKWARD_EULER, SDIRK2, solve_heat
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.mesh.tetrahedra import TetMesh

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
    mass = assemble(mesh, CONCRETE).nodal_mass_j_k
    assert mass.sum() == pytest.approx(volume, rel=1e-12)
    np.testing.assert_allclose(stored, np.diff(solution.temperature_c @ mass), rtol=1e-6)


def test_steps_of_backward_euler_are_the_textbook_s() -> None:
    """(M + dt A) T1 = M T0 + dt b, solved directly beside it."""
    mesh = bar(6, lambda p: 20.0 + 30.0 * np.sin(40.0 * p[:, 0]))
    problem = HeatProblem(mesh, CONCRETE, effects=(Convection(("x1",), 9.0, 5.0),))
    dt, system = 0.8 * STEP_S, HeatSystem(problem)
    a, mass, state = system.matrix(0.0, np.inf), assemble(mesh, CONCRETE).mass_j_k, mesh.temperature_c
    for computed in solve_heat(problem, TimeSteps(3, dt)).temperature_c[1:]:
        b = 5.0 * (a @ np.ones(system.num_nodes))
        state = spsolve((mass + dt * a).tocsc(), mass @ state + dt * b)
        np.testing.assert_allclose(computed, state, atol=1e-9)


def test_a_body_radiates_from_1000_k_to_3_k() -> None:
    """A thin plate in the dark: rho c d dT/dt = -2 sigma T^4, so T = (T0^-3 + 6 sigma t / (rho c d))^(-1/3)."""
    thickness = 1e-3
    mesh = box_mesh([0, 0.01, 0.02], [0, 0.01, 0.02], [0, thickness], temperature_c=1000.0 - 273.15)
    steel = STEEL
    problem = HeatProblem(mesh, steel, effects=(Radiation(("z0", "z1"), 1.0, -273.15),))
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
