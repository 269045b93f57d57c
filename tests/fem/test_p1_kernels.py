import numpy as np
import pytest
from scipy import sparse
from scipy.spatial import Delaunay

from tests.support.heat_matrices import storage
from tests.support.heat_meshes import mesh_from
from thermoxels_ns.fem.p1_kernels import lumped_mass, stiffness_matrix
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space, conduction
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


def oriented(points: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Drop flat tetrahedra and turn the inverted ones over."""
    sides = points[tets[:, 1:]] - points[tets[:, :1]]
    volumes = np.linalg.det(sides)
    tets = np.where(volumes[:, None] > 0, tets, tets[:, [0, 2, 1, 3]])
    return tets[np.abs(volumes) > 1e-3 * np.median(np.abs(volumes))]


def kuhn_mesh() -> tuple[np.ndarray, np.ndarray]:
    corners, tets = kuhn_tets(np.random.default_rng(5).random((4, 3, 5)) < 0.8)
    return 0.07 * corners, tets


def random_mesh() -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(6).uniform(-1.0, 2.0, (150, 3))
    tets = oriented(points, Delaunay(points).simplices.astype(np.int64))
    used, numbers = np.unique(tets, return_inverse=True)
    return points[used], numbers.reshape(-1, 4)


def fan_mesh() -> tuple[np.ndarray, np.ndarray]:
    """A hundred thin tetrahedra around one axis, numbered at random."""
    count = 100
    order = np.random.default_rng(8).permutation(count) + 2
    angle = 2.0 * np.pi * np.arange(count) / count
    points = np.zeros((count + 2, 3))
    points[1, 2] = 0.5
    points[order, 0], points[order, 1] = np.cos(angle), np.sin(angle)
    tets = np.column_stack([np.zeros(count, int), np.ones(count, int), order, np.roll(order, -1)])
    return points, oriented(points, tets)


MESHES = {"kuhn": kuhn_mesh, "random": random_mesh, "fan": fan_mesh}


def space(points: np.ndarray, tets: np.ndarray) -> Space:
    return Space(Selection(mesh_from(points, tets)))


def entries_per_row(matrix: sparse.csr_matrix) -> int:
    return int(np.diff(matrix.indptr).max())


@pytest.mark.parametrize("mesh", MESHES)
def test_matrices_are_those_of_the_forms_of_scikit_fem(mesh: str) -> None:
    points, tets = MESHES[mesh]()
    varied = 10.0 ** np.random.default_rng(9).uniform(-3.0, 3.0, len(tets))
    for conductivity in (np.full(len(tets), 1.7), varied):
        expected = space(points, tets).assembled(conduction, 0, conductivity=conductivity).toarray()
        stiffness = stiffness_matrix(points, tets, conductivity)
        assert np.abs(stiffness.toarray() - expected).max() < 1e-13 * np.abs(expected).max()
    nodal = space(points, tets).assembled(storage, 2, heat_capacity=1e5 * varied) @ np.ones(len(points))
    np.testing.assert_allclose(lumped_mass(points, tets, 1e5 * varied), nodal, rtol=1e-12)


@pytest.mark.parametrize("mesh", MESHES)
def test_stiffness_is_symmetric_bit_for_bit_and_its_rows_sum_to_zero(mesh: str) -> None:
    points, tets = MESHES[mesh]()
    stiffness = stiffness_matrix(points, tets, np.full(len(tets), 1.7))
    assert (stiffness != stiffness.T).nnz == 0
    assert np.all(np.abs(stiffness.sum(axis=1)).A1 <= 1e-15 * np.abs(stiffness).sum(axis=1).A1)


def turned(points: np.ndarray) -> np.ndarray:
    c, s = np.cos(0.7), np.sin(0.7)
    about_z, about_x = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    return points @ about_z @ about_x + np.array([30.0, -50.0, 10.0])


def test_right_angles_couple_nothing_wherever_the_body_stands() -> None:
    """Nodes that only right angles lie between have no entry, so that matrices of lattices are small."""
    points, tets = kuhn_mesh()
    stiffness = stiffness_matrix(points, tets, np.full(len(tets), 1.7))
    moved = stiffness_matrix(turned(points), tets, np.full(len(tets), 1.7))
    assert entries_per_row(stiffness) == entries_per_row(moved) == 7
    assert stiffness.nnz == moved.nnz
    assert np.abs(stiffness - moved).max() < 1e-11 * stiffness.max()


@pytest.mark.parametrize("scale", [1e-60, 1e-20, 1e20, 1e60])
def test_scale(scale: float) -> None:
    """K grows with the size of a body, its mass with the cube; neither over- nor underflows on the way."""
    points, tets = kuhn_mesh()
    stiffness, mass = (
        stiffness_matrix(points, tets, np.full(len(tets), 1.7)),
        lumped_mass(points, tets, np.full(len(tets), 2e6)),
    )
    scaled = stiffness_matrix(scale * points, tets, np.full(len(tets), 1.7))
    assert scaled.nnz == stiffness.nnz
    np.testing.assert_allclose(scaled.data, scale * stiffness.data, rtol=1e-12)
    np.testing.assert_allclose(lumped_mass(scale * points, tets, np.full(len(tets), 2e6)), scale**3 * mass, rtol=1e-12)
