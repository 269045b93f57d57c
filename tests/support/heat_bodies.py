"""Bodies for the tests of the heat solver."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.quality.face_count import boundary_facets
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


def make_body(cells: np.ndarray, voxel_m: float, temperature_c: Callable[[np.ndarray], np.ndarray]) -> TetMesh:
    corners, tets = kuhn_tets(cells)
    points, facets = corners * voxel_m, boundary_facets(tets)
    seen, tags, region = np.ones(len(points), bool), np.zeros(len(facets), np.int64), np.zeros(len(tets), np.int64)
    return TetMesh(points, tets, temperature_c(points), seen, facets, tags, region)


@pytest.fixture
def concrete() -> Material:
    return Material("concrete", 1.7, 2200.0, 880.0)


@pytest.fixture
def carved_cells() -> np.ndarray:
    """A 6 x 5 x 4 block with a tunnel, a cavity and a bite out of its corner."""
    cells = np.ones((6, 5, 4), dtype=bool)
    cells[:, 2, 1] = False
    cells[3, 3, 2] = False
    cells[4:, :2, 2:] = False
    return cells


@pytest.fixture
def random_body(carved_cells: np.ndarray) -> TetMesh:
    rng = np.random.default_rng(7)
    return make_body(carved_cells, 0.05, lambda points: rng.uniform(-15.0, 45.0, len(points)))
