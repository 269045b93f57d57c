from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.runge_kutta import BACKWARD_EULER, CRANK_NICOLSON, SDIRK2
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, Radiation
from thermoxels_ns.mesh.tetrahedra import TetMesh


def two_plates(step: float = 0.01) -> TetMesh:
    """Two plates that do not touch, at 20 and 60 C."""
    x = np.array([0.0, 0.01, 0.02, 0.03])
    return box_mesh(
        x,
        x,
        [0.0, step],
        keep=lambda p: np.abs(p[..., 0] - 0.015) > 0.005,
        temperature_c=lambda p: np.where(p[:, 0] > 0.015, 60.0, 20.0),
    )


@pytest.mark.parametrize("patches", [("x1",), ("*",)])
def test_newton_ends_in_stages_whose_change_is_tiny(concrete, patches) -> None:
    """Short steps change far less than the temperatures are: what one stage stores must reach the next one in full."""
    problem = HeatProblem(two_plates(), concrete, effects=(Radiation(patches, 0.9, 306.6),))
    fine = solve_heat(problem, AdaptiveSteps(264.0, 1e-3, outputs=4))
    coarse = solve_heat(problem, AdaptiveSteps(264.0, 1e-2, outputs=4))
    assert fine.energy_residual_of_spread < 1e-12
    assert np.abs(fine.temperature_c - coarse.temperature_c).max() < 1e-2


@pytest.mark.parametrize("scheme", [BACKWARD_EULER, CRANK_NICOLSON, SDIRK2])
@pytest.mark.parametrize("step_s", [1e-9, 1e-6, 1e-3])
def test_newton_takes_few_steps_however_short_the_time_step(concrete, scheme, step_s) -> None:
    problem = HeatProblem(two_plates(), concrete, effects=(Radiation(("x1",), 0.9, 306.6),))
    solution = solve_heat(problem, TimeSteps(3, step_s), scheme=scheme)
    assert solution.newton_iterations.max() <= 3 * len(scheme.nodes)
    # As long as nothing has changed to speak of, the heat is that of the first moment.
    around, plate = 306.6 + 273.15, 60.0 + 273.15
    heat = 0.9 * 5.670374419e-8 * (around**4 - plate**4) * 0.03 * 0.01
    np.testing.assert_allclose(solution.effects[0].heat_w, heat, rtol=1e-4)


def test_newton_ends_near_a_steady_state_and_after_it(concrete) -> None:
    """Restarts from what is all but steady: the residual begins at round-off and has nowhere to go."""
    effects = (Radiation(("x1",), 0.9, 306.6), Convection(("x0",), 8.0, 10.0))
    mesh = box_mesh(*[np.arange(4) * 0.05] * 3, temperature_c=100.0)
    problem = HeatProblem(mesh, concrete, effects=effects)
    steady = solve_steady(problem).temperature_c
    for away in (0.0, 1e-12, 1e-9, 1e-6):
        near = replace(problem, initial_temperature_c=steady + away * np.sin(np.arange(len(steady))))
        for time in (AdaptiveSteps(1e5, 1e-4, outputs=3), TimeSteps(3, 1e-6), TimeSteps(3, 1e7)):
            solution = solve_heat(near, time)
            assert np.abs(solution.temperature_c[-1] - steady).max() < max(10.0 * away, 1e-8)
