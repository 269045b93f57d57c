import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.heat_meshes import mesh_from
from tests.support.small_fields import crossed_diagonals
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import (
    OUTWARD_FACES,
    SurfaceComponent,
    boundary_facets,
    count_open_edges,
    count_overlaps,
    count_twin_nodes,
    facet_owners,
    group_sides,
    surface_topology,
)
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

CORNER_TET = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]])


def _turned_over(mesh):
    tets = mesh.tets.copy()
    tets[5] = tets[5, [1, 0, 2, 3]]
    return replace(mesh, tets=tets)


def _three_owners(mesh):
    points = np.vstack([CORNER_TET, [[0.0, 0.0, 5.0], [0.0, 0.0, -1.0]]])
    return mesh_from(points, np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 2, 1, 5]]))


def _crack(mesh):
    points, _, crossed = crossed_diagonals()
    return mesh_from(points, crossed)


def _nodes_of_its_own(mesh):
    tets = mesh.tets.copy()
    tets[-1] = np.arange(4) + len(mesh.points_m)
    return mesh_from(np.vstack([mesh.points_m, mesh.points_m[mesh.tets[-1]]]), tets)


def _other_facets(change):
    def damaged(mesh):
        facets = change(mesh.facets.copy())
        return replace(mesh, facets=facets, facet_tags=np.zeros(len(facets), dtype=np.int64))

    return damaged


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("mesh volumes_positive", _turned_over),
        ("mesh conforming", _three_owners),
        ("mesh conforming", _crack),
        ("mesh conforming", _nodes_of_its_own),
        ("mesh conforming", lambda mesh: mesh_from(np.vstack([mesh.points_m, [[9.0, 9, 9]]]), mesh.tets)),
        ("mesh boundary_closed", _other_facets(lambda facets: facets[1:])),
        ("mesh boundary_closed", _other_facets(lambda facets: np.vstack([facets[:1, ::-1], facets[1:]]))),
        ("mesh conforming", _other_facets(lambda facets: np.vstack([facets, facets[:1]]))),
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
        assert quality.num_box_facets == quality.num_facets
    check_mesh(mesh_from(*crossed_diagonals()[:2]))


def test_twin_nodes_are_counted():
    assert count_twin_nodes(np.array([[0.0, 1.0, 2.0], [-0.0, 1.0, 2.0], [1.0, 0.0, 2.0]])) == 1


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


@pytest.mark.parametrize(("seed", "first"), [(0, 0), (1, 0), (2, 0), (3, 2**22)])  # the last: beyond 64 bits
def test_every_boundary_triangle_has_its_tetrahedron(random_cells, seed, first):
    tets = kuhn_tets(random_cells(seed))[1] + first
    facets = boundary_facets(tets)
    facets = np.roll(facets[np.random.default_rng(seed).permutation(len(facets))], seed, axis=1)
    tet, opposite = facet_owners(tets, facets)
    assert np.array_equal(np.sort(tets[tet[:, None], OUTWARD_FACES[opposite]], axis=1), np.sort(facets, axis=1))
    assert [len(found) for found in facet_owners(tets, facets[:0])] == [0, 0]


@pytest.mark.parametrize("facets", [[[0, 1, 2], [2, 0, 1]], [[1, 2, 3]], [[0, 1, 4]]], ids=["twice", "inside", "none"])
def test_a_triangle_without_one_tetrahedron_is_refused(facets):
    with pytest.raises(MeshError, match="facets: "):
        facet_owners(np.array([[0, 1, 2, 3], [1, 3, 2, 4]]), np.array(facets))


def topology_of(cells: np.ndarray):
    corners, tets = kuhn_tets(cells)
    facets = boundary_facets(tets)
    assert count_open_edges(facets, group_sides(facets)) == 0
    return SimpleNamespace(**surface_topology(corners.astype(float), facets, group_sides(facets)))


@pytest.mark.parametrize("holes", [0, 1, 2, 5])
def test_a_plate_with_holes_has_as_many_handles(holes):
    cells = np.ones((2 * holes + 1, 3, 1), dtype=bool)
    cells[1::2, 1] = False
    found = topology_of(cells)
    assert [component.genus for component in found.components] == [holes]
    assert found.euler_characteristic == 2 - 2 * holes
    assert (found.genus, found.num_non_manifold_edges, found.num_non_manifold_vertices) == (holes, 0, 0)


def test_a_cavity_is_a_component_of_its_own():
    cells = np.ones((5, 4, 4), dtype=bool)
    cells[1:3, 1, 1] = False
    outside, inside = SurfaceComponent(2 * (4 * 20 + 2 * 16), 2, 0, False), SurfaceComponent(2 * 10, 2, 0, True)
    assert topology_of(cells).components == (outside, inside)


def test_cubes_that_touch_at_a_point():
    cells = np.zeros((2, 2, 2), dtype=bool)
    cells[0, 0, 0] = cells[1, 1, 1] = True
    found = topology_of(cells)
    assert found.components == (SurfaceComponent(12, 2, 0, False),) * 2  # each is a sphere
    assert (found.num_non_manifold_edges, found.num_non_manifold_vertices) == (0, 1)
    assert found.euler_characteristic == 3  # two spheres share one vertex


@pytest.mark.parametrize(("depth", "chain", "edges", "vertices"), [(1, False, 1, 2), (2, True, 0, 1)])
def test_cubes_that_touch_along_an_edge_and_a_body_pinched_at_a_vertex_have_no_genus(depth, chain, edges, vertices):
    # The chain of voxels goes around two opposite corners of a cube, which meet at its middle only.
    cells = np.full((2, 2, depth), chain)
    cells[0, 0, 0] = cells[1, 1, -1] = not chain
    found = topology_of(cells)
    assert (found.num_non_manifold_edges, found.num_non_manifold_vertices) == (edges, vertices)
    assert [component.genus for component in found.components] == [None] and found.genus is None
