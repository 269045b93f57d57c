from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Delaunay

from tests.support.heat_bodies import box_mesh, mesh_from, shell_mesh, storage
from thermoxels_ns.fem.linear_tets import TET_EDGES, lumped_mass, refine_mesh, stiffness_matrix
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space, conduction
from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


def turned(facets: np.ndarray) -> set[tuple[int, ...]]:
    """Triangles from their smallest node on, which keeps their sense of rotation."""
    return {tuple(np.roll(facet, -int(np.argmin(facet)))) for facet in facets}


def notched() -> TetMesh:
    mesh = box_mesh(
        [0, 1, 2, 4],
        [0, 1, 2],
        [0, 1.5, 2],
        temperature_c=lambda p: 3 * p[:, 0] - p[:, 2],
        regions={"low": lambda p: p[..., 0] < 2, "high": lambda p: p[..., 0] > 2},
        keep=lambda p: (p[..., 0] < 2) | (p[..., 1] < 1),
    )
    tags = mesh.boundary
    return replace(
        mesh,
        boundary=replace(tags, seen=tags.patch % 2 == 0),
        colour=np.linspace(0, 1, 3 * len(mesh.points_m), dtype=np.float32).reshape(-1, 3),
        observed=mesh.points_m[:, 0] < 1.5,
    )


@pytest.mark.parametrize("make", [notched, lambda: shell_mesh(0.5, 0.6, 2, 1)], ids=["notched", "shell"])
def test_the_body_and_its_boundary_stay_the_same(make) -> None:
    mesh = make()
    fine = refine_mesh(mesh)
    assert len(fine.tets) == 8 * len(mesh.tets) and len(fine.facets) == 4 * len(mesh.facets)
    parts = signed_volumes(fine.points_m, fine.tets).reshape(-1, 8)
    assert parts.min() > 0.0
    # Each child is an eighth of its parent, and stands where its parent stood.
    before = signed_volumes(mesh.points_m, mesh.tets)
    np.testing.assert_allclose(parts, np.repeat(before[:, None] / 8.0, 8, axis=1), rtol=1e-9)
    # Conforming: what faces no other tetrahedron is exactly the children of the boundary, with their orientation.
    assert turned(boundary_facets(fine.tets)) == turned(fine.facets)
    areas, finer = (facet_areas(one.points_m, one.facets) for one in (mesh, fine))
    np.testing.assert_allclose(finer.reshape(-1, 4), np.repeat(areas[:, None] / 4.0, 4, axis=1))
    assert len(np.unique(fine.tets)) == len(fine.points_m)


def test_children_inherit() -> None:
    mesh = notched()
    fine = refine_mesh(mesh)
    tags, finer = mesh.boundary, fine.boundary
    np.testing.assert_array_equal(fine.region, np.repeat(mesh.region, 8))
    for name in ("patch", "seen"):
        np.testing.assert_array_equal(getattr(finer, name), np.repeat(getattr(tags, name), 4, axis=0))
    np.testing.assert_array_equal(fine.facet_tags, np.repeat(mesh.facet_tags, 4))
    assert finer.patch_names == tags.patch_names and fine.region_names == mesh.region_names
    old = len(mesh.points_m)
    np.testing.assert_array_equal(fine.points_m[:old], mesh.points_m)
    np.testing.assert_array_equal(fine.observed[:old], mesh.observed)
    # Linear data stay linear; a node between a seen and an unseen one was not seen.
    np.testing.assert_allclose(fine.temperature_c, 3 * fine.points_m[:, 0] - fine.points_m[:, 2], atol=1e-12)
    np.testing.assert_array_equal(fine.observed, fine.points_m[:, 0] <= 1.0)
    assert fine.colour.dtype == np.float32 and fine.colour.min() >= 0.0 and fine.colour.max() <= 1.0
    np.testing.assert_array_equal(refine_mesh(replace(mesh, boundary=None, colour=None)).tets, fine.tets)


def test_no_angle_of_a_lattice_becomes_obtuse() -> None:
    """Entries of the stiffness matrix off its diagonal stay below 0: the maximum principle survives."""
    mesh = box_mesh([0, 1, 2], [0, 1], [0, 1])
    for _ in range(3):
        mesh = refine_mesh(mesh)
        stiffness = stiffness_matrix(mesh.points_m, mesh.tets, np.ones(len(mesh.tets)))
        stiffness.setdiag(0.0)
        assert stiffness.max() <= 0.0
        corner = mesh.points_m[mesh.tets]
        lengths = np.linalg.norm(corner[:, TET_EDGES[:, 0]] - corner[:, TET_EDGES[:, 1]], axis=2)
        # All children are of the one shape of the parents.
        shapes = np.sort(lengths, axis=1) / lengths.min(axis=1)[:, None]
        np.testing.assert_allclose(shapes, np.tile(np.sqrt([1, 1, 1, 2, 2, 3]), (len(shapes), 1)))


def test_shapes_do_not_degenerate() -> None:
    """Where tetrahedra are irregular, three more refinements leave the worst shape as it is after the first."""
    mesh, worst = shell_mesh(0.5, 0.6, 2, 1, eighth=True), []
    for _ in range(4):
        mesh = refine_mesh(mesh)
        corner = mesh.points_m[mesh.tets]
        longest = np.linalg.norm(corner[:, TET_EDGES[:, 0]] - corner[:, TET_EDGES[:, 1]], axis=2).max(axis=1)
        worst.append(float((signed_volumes(mesh.points_m, mesh.tets) / longest**3).min()))
    assert worst[-1] == pytest.approx(worst[0], rel=0.3), worst


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


MESHES = {"kuhn": kuhn_mesh, "random": random_mesh}


def space(points: np.ndarray, tets: np.ndarray) -> Space:
    return Space(Selection(mesh_from(points, tets)))


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


def test_right_angles_couple_nothing_wherever_the_body_stands() -> None:
    """Nodes that only right angles lie between have no entry, so that matrices of lattices are small."""
    points, tets = kuhn_mesh()
    stiffness = stiffness_matrix(points, tets, np.full(len(tets), 1.7))
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    moved = stiffness_matrix(points @ turn + [30.0, -50.0, 10.0], tets, np.full(len(tets), 1.7))
    assert np.diff(stiffness.indptr).max() == 7 and stiffness.nnz == moved.nnz
    assert (stiffness != stiffness.T).nnz == 0
    assert np.abs(stiffness - moved).max() < 1e-11 * stiffness.max()
