import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from tests.support.heat_bodies import mesh_from
from tests.support.stuffed_shapes import random_turn, stiffness
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import check_mesh, count_overlaps, group_sides
from thermoxels_ns.mesh.quality.tet_shapes import dihedral_cosines, edge_stiffness, flatness, signed_volumes
from thermoxels_ns.mesh.temperature import tet_conductances
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


def crossed_diagonals() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two voxels side by side, and the same with the second mirrored: diagonals on the face that they share cross."""
    corners, tets = kuhn_tets(np.ones((2, 1, 1), dtype=bool))
    number = {tuple(c): n for n, c in enumerate(corners.tolist())}
    mirrored = np.array([[number[(x, 1 - y, z)] for x, y, z in corners[t].tolist()] for t in tets[6:]])
    return corners.astype(float), tets, np.vstack([tets[:6], mirrored[:, [0, 2, 1, 3]]])


@pytest.mark.parametrize("shape_of", [signed_volumes, flatness, dihedral_cosines, edge_stiffness])
@pytest.mark.parametrize("node", [-1, 4])
def test_a_node_that_is_not_there_is_not_read(shape_of, node):
    with pytest.raises(IndexError, match="4 points"):
        shape_of(np.eye(4)[:, :3], np.array([[0, 1, 2, node]]))


def _turned_over(mesh):
    tets = mesh.tets.copy()
    tets[5] = tets[5, [1, 0, 2, 3]]
    return replace(mesh, tets=tets)


def _three_owners(mesh):
    points = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4], [0, 0, 5], [0, 0, -1]])
    return mesh_from(points, np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 2, 1, 5]]))


def _nodes_of_its_own(mesh):
    tets = mesh.tets.copy()
    tets[-1] = np.arange(4) + len(mesh.points_m)
    return mesh_from(np.vstack([mesh.points_m, mesh.points_m[mesh.tets[-1]]]), tets)


def _other_facets(change):
    def damaged(mesh):
        facets = change(mesh.facets.copy())
        return replace(mesh, facets=facets, facet_tags=np.zeros(len(facets), dtype=np.int64), boundary=None)

    return damaged


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("mesh volumes", _turned_over),
        ("mesh conformity", _three_owners),
        ("mesh conformity", lambda mesh: mesh_from(*crossed_diagonals()[::2])),
        ("mesh conformity", _nodes_of_its_own),
        ("mesh conformity", lambda mesh: mesh_from(np.vstack([mesh.points_m, [[9.0, 9, 9]]]), mesh.tets)),
        ("mesh boundary", _other_facets(lambda facets: facets[1:])),
        ("mesh boundary", _other_facets(lambda facets: np.vstack([facets[:1, ::-1], facets[1:]]))),
        ("mesh conformity", _other_facets(lambda facets: np.vstack([facets, facets[:1]]))),
        ("mesh tets", lambda mesh: replace(mesh, tets=mesh.tets + 1)),
        ("mesh temperature_c", lambda mesh: replace(mesh, temperature_c=np.where(mesh.observed, np.nan, 1.0))),
        ("mesh tets", lambda mesh: replace(mesh, tets=mesh.tets[:0], region=mesh.region[:0])),
    ],
)
def test_what_no_solver_can_take_is_refused(box_mesh, name, damage):
    with pytest.raises(MeshError, match=f"{name}: "):
        check_mesh(damage(box_mesh))


def test_sound_meshes_pass_whatever_the_order_of_nodes_in_triangles(box_mesh):
    rotated = replace(box_mesh, facets=np.roll(box_mesh.facets, 1, axis=1)[::-1].copy())
    for mesh in (box_mesh, rotated):
        quality = check_mesh(mesh)
        assert quality.volume_m3 == pytest.approx(3.0) and quality.area_m2 == pytest.approx(13.0)
    check_mesh(mesh_from(*crossed_diagonals()[:2]))


POINTS = np.array(
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.3, 0.7, 0.0], [0.5, -1.0, 1.0], [0.5, -1.0, -1.0]]
)
"""An edge along x; two points on one side of it in one plane, and two in planes of their own."""


@pytest.mark.parametrize(
    ("facets", "overlaps"), [([[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 5]], 1), ([[0, 1, 2], [0, 1, 4], [1, 0, 5]], 0)]
)
def test_triangles_at_an_edge_that_lie_on_each_other_are_found_in_any_order(facets, overlaps) -> None:
    for order in itertools.permutations(facets):
        assert count_overlaps(POINTS, np.array(order), group_sides(np.array(order))) == overlaps


@pytest.mark.parametrize(("depth", "edges"), [(1, 1), (2, 0)])
def test_edges_where_a_boundary_touches_itself_are_counted(mesh_of_cells, depth, edges):
    """Two cubes that share an edge, or a corner alone."""
    cells = np.zeros((2, 2, depth), dtype=bool)
    cells[0, 0, 0] = cells[1, 1, -1] = True
    assert check_mesh(mesh_of_cells(cells)).num_non_manifold_edges == edges


@pytest.mark.parametrize("shift_m", [(0.0, 0.0, 0.0), (450_000.3, 5_200_000.4, 300.0)])
def test_angles_of_voxels_are_right_in_national_coordinates_too(box_mesh, shift_m):
    """Five million metres from the origin nodes have steps of a nanometre."""
    figures = check_mesh(replace(box_mesh, points_m=0.05 * box_mesh.points_m @ random_turn(1).T + shift_m))
    assert figures.dihedral_range_deg == pytest.approx((45.0, 90.0), abs=1e-4)


def test_stiffness_is_that_of_scikit_fem():
    corners, tets = kuhn_tets(np.ones((3, 2, 2), dtype=bool))
    points = corners + np.random.default_rng(0).uniform(-0.2, 0.2, corners.shape)
    edges, conductances = tet_conductances(points, tets)
    ours = sparse.coo_array((-conductances, np.sort(edges, axis=1).T), shape=(len(points),) * 2).toarray()
    assert ours == pytest.approx(np.triu(stiffness(points, tets).toarray(), 1), abs=1e-12)
