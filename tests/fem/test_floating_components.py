import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import box_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, HeatFlux, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh

EMPTY = Material("next to nothing", 1.7, 1.0, 1e-12)
AIR = Convection(("x0",), 10.0, 5.0)
SKY = Radiation(("x0",), 0.9, -20.0)
SUN = HeatFlux(("x1",), 100.0)


def two_blocks() -> TetMesh:
    """They do not touch; x0 is the first one's, x1 the second one's."""
    return box_mesh(np.linspace(0, 0.5, 6), [0, 0.1], [0, 0.1], keep=lambda p: abs(p[..., 0] - 0.25) > 0.06)


@pytest.mark.parametrize("time", [TimeSteps(3, 600.0), AdaptiveSteps(1800.0)], ids=["equal", "adaptive"])
def test_a_body_that_stores_nothing_is_not_followed(time) -> None:
    with pytest.raises(HeatError, match=r"heat capacity: expected at least 1 J.* got 1e-12 J"):
        solve_heat(HeatProblem(two_blocks(), EMPTY, effects=(AIR, SUN)), time)


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
