import numpy as np
import pytest

from thermoxels_ns.mesh.quality.face_count import boundary_facets, group_faces
from thermoxels_ns.mesh.quality.topology import SurfaceComponent, count_bodies, surface_topology, tets_across_faces
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


def topology_of(cells: np.ndarray):
    corners, tets = kuhn_tets(cells)
    return surface_topology(corners.astype(float), boundary_facets(tets))


def plate(holes: int) -> np.ndarray:
    cells = np.ones((2 * holes + 1, 3, 1), dtype=bool)
    cells[1::2, 1] = False
    return cells


@pytest.mark.parametrize("holes", [0, 1, 2, 5])
def test_a_plate_with_holes_has_as_many_handles(holes):
    found = topology_of(plate(holes))
    assert [component.genus for component in found.components] == [holes]
    assert found.euler_characteristic == 2 - 2 * holes
    assert (found.num_open_edges, found.num_non_manifold_edges, found.num_non_manifold_vertices) == (0, 0, 0)


def test_a_cavity_is_a_component_of_its_own():
    cells = np.ones((5, 4, 4), dtype=bool)
    cells[1:3, 1, 1] = False
    found = topology_of(cells)
    assert [component.is_cavity for component in found.components] == [False, True]
    assert [component.genus for component in found.components] == [0, 0]
    assert [component.num_triangles for component in found.components] == [2 * (4 * 20 + 2 * 16), 2 * 10]
    assert found.euler_characteristic == 4


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
    assert (found.num_open_edges, found.num_non_manifold_edges, found.num_non_manifold_vertices) == (0, edges, vertices)
    assert [component.genus for component in found.components] == [None]


def test_random_voxels_keep_the_sums(random_cells):
    for seed in range(8):
        corners, tets = kuhn_tets(random_cells(seed))
        facets = boundary_facets(tets)
        found = surface_topology(corners.astype(float), facets)
        edges = np.unique(np.sort(facets[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        assert found.euler_characteristic == len(np.unique(facets)) - len(edges) + len(facets)
        assert sum(component.num_triangles for component in found.components) == len(facets)
        assert found.num_open_edges == 0


def test_an_open_surface_has_open_edges_and_no_genus():
    corners, tets = kuhn_tets(np.ones((1, 1, 1), dtype=bool))
    facets = boundary_facets(tets)
    found = surface_topology(corners.astype(float), facets[1:])
    assert found.num_open_edges == 3
    assert found.components[0].genus is None and not found.components[0].is_cavity
    inside_out = surface_topology(corners.astype(float), facets[1:, ::-1])
    assert not inside_out.components[0].is_cavity  # what is open encloses nothing
    inward = surface_topology(corners.astype(float), np.vstack([facets[:1, ::-1], facets[1:]]))
    assert inward.num_open_edges == 3  # passed twice in one direction


def test_bodies_that_share_a_node_an_edge_or_a_face():
    # Tetrahedra in a row: 0 and 1 share a face, 1 and 2 an edge, 2 and 3 a node, 4 nothing.
    tets = np.array([[0, 1, 2, 3], [1, 3, 2, 4], [3, 4, 5, 6], [6, 7, 8, 9], [10, 11, 12, 13]])
    assert count_bodies(5, tets_across_faces(group_faces(tets))) == 4
    assert count_bodies(3, np.zeros((0, 2), dtype=np.int64)) == 3
