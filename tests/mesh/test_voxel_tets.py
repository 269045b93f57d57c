import numpy as np
import pytest

from thermoxels_ns.mesh.quality.checks import check_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, FACET_SURFACE, facet_areas


def exposed_faces(cells: np.ndarray) -> int:
    """Number of voxel faces between solid and empty."""
    padded = np.pad(cells, 1)
    return sum(int(np.count_nonzero(np.diff(padded, axis=axis))) for axis in range(3))


def voxels(*others: tuple[int, int, int]) -> np.ndarray:
    """The middle one of 3 x 3 x 3 voxels, and others."""
    cells = np.zeros((3, 3, 3), dtype=bool)
    cells[tuple(zip((1, 1, 1), *others))] = True
    return cells


PATTERNS = {
    "single": voxels(),
    "sharing a face": voxels((1, 2, 1)),
    "sharing an edge": voxels((2, 2, 1)),
    "sharing a corner": voxels((2, 2, 2)),
    "checkerboard": np.indices((4, 3, 5)).sum(axis=0) % 2 == 0,
    "full": np.ones((3, 3, 3), dtype=bool),
    "hollow": ~voxels(),
}


@pytest.mark.parametrize("name", PATTERNS)
def test_volume_area_and_validity(mesh_of_cells, name):
    cells = PATTERNS[name]
    mesh = mesh_of_cells(cells, voxel_size=0.5)
    quality = check_mesh(mesh)
    assert signed_volumes(mesh.points_m, mesh.tets) == pytest.approx(np.full(6 * cells.sum(), 0.5**3 / 6), rel=1e-14)
    assert quality.volume_m3 == pytest.approx(cells.sum() * 0.5**3, rel=1e-14)
    assert len(mesh.facets) == 2 * exposed_faces(cells)
    assert quality.area_m2 == pytest.approx(exposed_faces(cells) * 0.5**2, rel=1e-14)
    assert quality.dihedral_range_deg == pytest.approx((45.0, 90.0))


def test_box_facets_are_those_on_the_lattice_border(mesh_of_cells):
    cells = np.zeros((3, 3, 3), dtype=bool)
    cells[1:, 1, 1] = True  # touches the box at x = 3 with one voxel face
    mesh = mesh_of_cells(cells, voxel_size=1.0)
    box = mesh.facet_tags == FACET_BOX
    assert np.all(mesh.points_m[mesh.facets[box]][:, :, 0] == 3.0)
    assert facet_areas(mesh.points_m, mesh.facets[box]).sum() == pytest.approx(1.0)
    assert np.count_nonzero(mesh.facet_tags == FACET_SURFACE) == len(mesh.facets) - 2
