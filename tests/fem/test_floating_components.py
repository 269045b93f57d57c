import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import box_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh

EMPTY = Material("next to nothing", 1.7, 1.0, 1e-12)
AIR = Convection(("x0",), 10.0, 5.0)
SKY = Radiation(("x0",), 0.9, -20.0)
SUN = HeatFlux(("x1",), 100.0)


def two_blocks() -> TetMesh:
    """They do not touch; x0 is the first one's, x1 the second one's."""
    return box_mesh(np.linspace(0, 0.5, 6), [0, 0.1], [0, 0.1], keep=lambda p: abs(p[..., 0] - 0.25) > 0.06)


@pytest.mark.parametrize("effects", [(AIR, SUN), (SKY, SUN), (AIR, SKY, SUN), (AIR, InternalHeat(("*",), -1e3))])
@pytest.mark.parametrize("time", [TimeSteps(3, 600.0), AdaptiveSteps(1800.0)], ids=["equal", "adaptive"])
def test_heat_that_a_loose_piece_cannot_store_is_refused(effects, time) -> None:
    with pytest.raises(
        HeatError, match=r"heat problem: expected heat capacity.*1 of 2 pieces.*\(0\.3, 0, 0\) to \(0\.5,"
    ):
        solve_heat(HeatProblem(two_blocks(), EMPTY, effects=effects), time)


def test_a_loose_piece_that_stores_its_heat_is_followed() -> None:
    mesh = two_blocks()
    end = solve_heat(HeatProblem(mesh, CONCRETE, effects=(SKY, SUN)), TimeSteps(3, 600.0)).temperature_c[-1]
    second = mesh.points_m[:, 0] > 0.25
    volume, area = 0.2 * 0.1 * 0.1, 0.1 * 0.1
    capacity = np.zeros(len(end))
    for tet in mesh.tets:
        corner = mesh.points_m[tet]
        capacity[tet] += np.linalg.det(corner[1:] - corner[0]) / 24.0
    mean_rise_k = float(capacity[second] @ (end[second] - 20.0)) / volume
    assert mean_rise_k == pytest.approx(100.0 * area * 1800.0 / (2200.0 * 880.0 * volume), rel=1e-9)


def test_a_piece_that_exchanges_heat_needs_no_capacity() -> None:
    """It follows at once: the flux goes out as it comes in, q = h (T - T_air)."""
    block = box_mesh(np.linspace(0, 0.2, 3), [0, 0.1], [0, 0.1])
    sun = HeatFlux(("x0",), 100.0)
    for time in (TimeSteps(2, 600.0), AdaptiveSteps(1800.0)):
        solution = solve_heat(HeatProblem(block, EMPTY, effects=(AIR, sun)), time)
        np.testing.assert_allclose(solution.temperature_c[-1], 15.0, atol=1e-6)
        assert solution.converged and solution.energy_residual < 1e-9


@pytest.mark.parametrize("capacity", [1e-9, 1e-15, 1e-21])
@pytest.mark.parametrize("time", [TimeSteps(2, 1e4), AdaptiveSteps(1e5, 0.5, outputs=2)], ids=["equal", "adaptive"])
def test_next_to_no_heat_capacity_is_solved_and_balances(capacity, time) -> None:
    """Steps are 1e9 to 1e24 times longer than heat takes to leave; round-off of its flow exceeds what is stored."""
    block = box_mesh(np.linspace(0, 0.2, 5), [0, 0.1], [0, 0.1], temperature_c=60.0)
    problem = HeatProblem(block, Material("gas", 200.0, 1.0, capacity), effects=(AIR, Radiation(("x1",), 0.9, 5.0)))
    solution = solve_heat(problem, time)
    np.testing.assert_allclose(solution.temperature_c[-1], 5.0, atol=1e-6)
    assert solution.converged and solution.energy_residual < 1e-9 and solution.energy_residual_of_spread < 1e-9
    assert solution.temperature_c.min() >= 5.0 - 1e-3 and solution.temperature_c.max() <= 60.0 + 1e-6
