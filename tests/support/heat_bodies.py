import numpy as np
import pytest

from tests.support.heat_meshes import Nodal, mesh_from
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)
STEEL = Material("steel", 50.0, 7800.0, 450.0)


def make_body(cells: np.ndarray, voxel_m: float, temperature_c: Nodal = 20.0) -> TetMesh:
    corners, tets = kuhn_tets(cells)
    return mesh_from(corners * voxel_m, tets, temperature_c)


@pytest.fixture
def concrete() -> Material:
    return CONCRETE


@pytest.fixture
def random_body() -> TetMesh:
    """A 6 x 5 x 4 block with a tunnel, a cavity and a bite out of its corner."""
    cells, rng = np.ones((6, 5, 4), dtype=bool), np.random.default_rng(7)
    cells[:, 2, 1] = False
    cells[3, 3, 2] = False
    cells[4:, :2, 2:] = False
    return make_body(cells, 0.05, lambda points: rng.uniform(-15.0, 45.0, len(points)))
