import numpy as np
import pytest
import skfem
from skfem.models.poisson import laplace

from thermoxels_ns.mesh.quality.checks import TET_EDGES
from thermoxels_ns.mesh.quality.tet_shapes import TetShapes, shapes_in_chunks, signed_volumes
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

REGULAR = np.array([[1.0, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]])
CORNER = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
ONE = np.array([[0, 1, 2, 3]])


def shapes_of(points: np.ndarray, tets: np.ndarray = ONE) -> TetShapes:
    return next(shapes_in_chunks(points, tets))[1]


def test_regular_tetrahedron():
    shapes = shapes_of(REGULAR)
    cosines = shapes.dihedral_cosines()
    assert cosines[:, 0] == pytest.approx([1 / 3] * 6)
    assert shapes.volumes.tolist() == pytest.approx([8 / 3])
    assert shapes.radius_ratios() == pytest.approx([1.0], abs=1e-14)
    # Edge length l: each edge adds -cot(angle) l / 6 = -l / (6 sqrt 8).
    assert shapes.stiffness(cosines)[:, 0] == pytest.approx([-np.sqrt(8) / (6 * np.sqrt(8))] * 6)


def test_corner_of_a_cube():
    shapes = shapes_of(CORNER)
    cosines = shapes.dihedral_cosines()
    assert cosines[:3, 0].tolist() == [0.0, 0.0, 0.0]
    assert cosines[3:, 0] == pytest.approx([1 / np.sqrt(3)] * 3)
    inscribed, circumscribed = 1 / (3 + np.sqrt(3)), np.sqrt(3) / 2
    assert shapes.radius_ratios() == pytest.approx([3 * inscribed / circumscribed])
    assert shapes.stiffness(cosines)[:, 0] == pytest.approx([-1 / 6] * 3 + [0.0] * 3)


@pytest.mark.parametrize("seed", range(3))
def test_stiffness_is_that_of_scikit_fem(seed):
    corners, tets = kuhn_tets(np.ones((3, 2, 2), dtype=bool))
    points = corners + np.random.default_rng(seed).uniform(-0.2, 0.2, corners.shape)
    assert signed_volumes(points, tets).min() > 0
    ours = np.zeros((len(points), len(points)))
    for which, shapes in shapes_in_chunks(points, tets):
        ends = tets[which][:, TET_EDGES]
        np.add.at(ours, (ends[..., 0], ends[..., 1]), shapes.stiffness(shapes.dihedral_cosines()).T)
    ours += ours.T
    basis = skfem.Basis(skfem.MeshTet(points.T, tets.T), skfem.ElementTetP1())
    theirs = laplace.assemble(basis).toarray()
    np.fill_diagonal(theirs, 0.0)
    assert np.abs(theirs).max() > 0.1
    np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_degenerate_tetrahedra_have_figures_not_nan():
    points = np.vstack([CORNER, [[0.5, 0.5, 0.0]]])
    turned, flat, doubled = [0, 2, 1, 3], [0, 1, 2, 4], [0, 0, 1, 2]
    shapes = shapes_of(points, np.array([turned, flat, doubled]))
    cosines = shapes.dihedral_cosines()
    assert np.isfinite(cosines).all() and np.isfinite(shapes.stiffness(cosines)).all()
    assert shapes.radius_ratios().tolist() == [0.0, 0.0, 0.0]
    assert shapes.volumes == pytest.approx([-1 / 6, 0.0, 0.0])
