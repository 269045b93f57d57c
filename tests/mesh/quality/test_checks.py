import itertools
from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import mesh_from
from tests.support.small_fields import crossed_diagonals
from tests.support.stuffed_shapes import volumes_and_angles
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import count_overlaps, count_twin_nodes, facet_areas, facet_normals
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.quality.topology import group_sides

CORNER_TET = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]])


def test_volume_area_and_normal_by_hand():
    tet = np.array([[0, 1, 2, 3]])
    assert signed_volumes(CORNER_TET, tet).tolist() == [4.0]
    assert signed_volumes(CORNER_TET, tet[:, [0, 2, 1, 3]]).tolist() == [-4.0]
    base = np.array([[0, 2, 1]])
    assert facet_areas(CORNER_TET, base).tolist() == [3.0]
    assert facet_normals(CORNER_TET, base).tolist() == [[0.0, 0.0, -1.0]]


def test_dihedral_angles_of_the_regular_tetrahedron():
    points = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    _, low, high = volumes_and_angles(points, np.array([[0, 1, 2, 3]]))
    assert low == pytest.approx(np.degrees(np.arccos(1 / 3)))
    assert high == pytest.approx(np.degrees(np.arccos(1 / 3)))


def test_a_valid_mesh_passes(box_mesh):
    quality = check_mesh(box_mesh)
    assert quality.volume_m3 == pytest.approx(1.5 * 2.0 * 1.0)
    assert quality.area_m2 == pytest.approx(2 * (1.5 * 2 + 1.5 * 1 + 2 * 1))
    assert (quality.num_nodes, quality.num_tets) == (60, 144)
    assert quality.num_box_facets == quality.num_facets


def test_turned_over_tetrahedron(box_mesh):
    tets = box_mesh.tets.copy()
    tets[5] = tets[5, [1, 0, 2, 3]]
    with pytest.raises(MeshError, match="mesh volumes_positive: "):
        check_mesh(replace(box_mesh, tets=tets))


def test_face_with_three_owners():
    points = np.vstack([CORNER_TET, [[0.0, 0.0, 5.0], [0.0, 0.0, -1.0]]])
    tets = np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 2, 1, 5]])
    with pytest.raises(MeshError, match="mesh conforming"):
        check_mesh(mesh_from(points, tets))


def test_missing_turned_or_extra_boundary_triangle(box_mesh):
    flipped = box_mesh.facets.copy()
    flipped[3] = flipped[3, ::-1]
    for facets in (box_mesh.facets[1:], flipped, np.vstack([box_mesh.facets, box_mesh.facets[:1]])):
        bad = replace(box_mesh, facets=facets, facet_tags=np.zeros(len(facets), dtype=np.int64))
        with pytest.raises(MeshError, match=r"mesh (boundary_closed|conforming): "):
            check_mesh(bad)


def test_rotated_node_order_of_a_triangle_is_fine(box_mesh):
    rotated = replace(box_mesh, facets=np.roll(box_mesh.facets, 1, axis=1)[::-1].copy())
    assert check_mesh(rotated).area_m2 == pytest.approx(check_mesh(box_mesh).area_m2)


def test_diagonals_that_do_not_match_are_found():
    points, tets, crossed = crossed_diagonals()
    check_mesh(mesh_from(points, tets))
    assert np.all(signed_volumes(points, crossed) > 0)
    with pytest.raises(MeshError, match="mesh conforming"):
        check_mesh(mesh_from(points, crossed))


def test_two_nodes_at_one_place_are_a_crack_too(box_mesh):
    # Give the last tetrahedron nodes of its own.
    points = np.vstack([box_mesh.points_m, box_mesh.points_m[box_mesh.tets[-1]]])
    tets = box_mesh.tets.copy()
    tets[-1] = np.arange(4) + len(box_mesh.points_m)
    with pytest.raises(MeshError, match="mesh conforming"):
        check_mesh(mesh_from(points, tets))


def test_unused_node(box_mesh):
    mesh = mesh_from(np.vstack([box_mesh.points_m, [[9.0, 9.0, 9.0]]]), box_mesh.tets)
    with pytest.raises(MeshError, match="mesh conforming: "):
        check_mesh(mesh)


def test_numbers_out_of_range_nan_shapes_and_emptiness(box_mesh):
    with pytest.raises(MeshError, match="mesh tets: "):
        check_mesh(replace(box_mesh, tets=box_mesh.tets + 1))
    hot = box_mesh.temperature_c.copy()
    hot[0] = np.nan
    with pytest.raises(MeshError, match="mesh temperature_c: "):
        check_mesh(replace(box_mesh, temperature_c=hot))
    with pytest.raises(MeshError, match="mesh tets: "):
        check_mesh(replace(box_mesh, tets=box_mesh.tets[:0], region=box_mesh.region[:0]))


def test_twin_nodes_are_counted():
    random = np.random.default_rng(0)
    points = random.integers(0, 4, size=(500, 3)).astype(float)
    assert count_twin_nodes(points) == 500 - len(np.unique(points, axis=0))
    assert count_twin_nodes(random.normal(size=(500, 3))) == 0
    assert count_twin_nodes(np.array([[0.0, 1.0, 2.0], [-0.0, 1.0, 2.0], [1.0, 0.0, 2.0]])) == 1


def test_a_spherical_fan_of_thin_tetrahedra_is_no_crack():
    # Boundary triangles that meet at 1 degree are sharp, but do not lie on each other.
    angle = np.radians(1.0)
    points = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [np.cos(angle), np.sin(angle), 0]])
    tets = np.array([[0, 2, 3, 1]])
    assert check_mesh(mesh_from(points, tets)).dihedral_range_deg[0] == pytest.approx(1.0)


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
