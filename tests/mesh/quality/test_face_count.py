import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.face_count import (
    OUTWARD_FACES,
    edges_of_rows,
    faces_of_rows,
    facet_owners,
    group_edges,
    group_faces,
)
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


def count_faces(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    groups = group_faces(tets)
    return faces_of_rows(tets, groups.first), groups.sizes


def faces_by_sorting(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces and their owners as one sort of all rows finds them, outwards from the first owner."""
    faces = tets[:, OUTWARD_FACES].reshape(-1, 3)
    _, first, uses = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first], uses


@pytest.mark.parametrize("seed", range(12))
def test_faces_of_random_voxels_in_any_order(random_cells, seed):
    random = np.random.default_rng(seed)
    corners, tets = kuhn_tets(random_cells(seed))
    names = random.permutation(3 * len(corners))[: len(corners)]  # numbers with gaps, in any order
    tets = names[tets[random.permutation(len(tets))]]
    faces, uses = count_faces(tets)
    expected, owners = faces_by_sorting(tets)
    np.testing.assert_array_equal(faces, expected)
    np.testing.assert_array_equal(uses, owners)


@pytest.mark.parametrize("seed", range(6))
def test_faces_of_nonsense_with_many_owners_and_repeated_nodes(seed):
    tets = np.random.default_rng(seed).integers(0, 7, size=(200, 4))
    faces, uses = count_faces(tets)
    expected, owners = faces_by_sorting(tets)
    assert owners.max() > 2
    np.testing.assert_array_equal(faces, expected)
    np.testing.assert_array_equal(uses, owners)


def test_node_numbers_whose_triple_does_not_fit_in_64_bits():
    low = np.array([[0, 1, 2, 3], [3, 2, 1, 4]])
    faces, uses = count_faces(low + 2**22)  # three numbers of 23 bits
    expected, owners = count_faces(low)
    np.testing.assert_array_equal(faces - 2**22, expected)
    assert uses.tolist() == owners.tolist() and sorted(uses.tolist()) == [1] * 6 + [2]


@pytest.mark.parametrize("seed", range(4))
def test_edges_of_random_voxels(random_cells, seed):
    _, tets = kuhn_tets(random_cells(seed))
    groups = group_edges(tets)
    found = np.sort(edges_of_rows(tets, groups.first), axis=1)
    pairs = np.sort(tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2), axis=1)
    expected, counts = np.unique(pairs, axis=0, return_counts=True)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(groups.sizes, counts)


@pytest.mark.parametrize("seed", range(6))
def test_the_owner_has_the_triangle_as_the_face_that_is_named(mesh_of_cells, random_cells, seed):
    """Bodies that touch themselves along edges and corners are among them."""
    mesh = mesh_of_cells(random_cells(seed))
    owner, opposite = facet_owners(mesh.tets, mesh.facets)
    faces = mesh.tets[owner[:, None], OUTWARD_FACES[opposite]]
    assert np.array_equal(np.sort(faces, axis=1), np.sort(mesh.facets, axis=1))
    assert len(np.unique(4 * owner + opposite)) == len(mesh.facets)


def test_the_order_and_the_turn_of_the_triangles_do_not_matter(mesh_of_cells):
    mesh = mesh_of_cells(np.ones((2, 1, 2), dtype=bool))
    owner, opposite = facet_owners(mesh.tets, mesh.facets)
    order = np.random.default_rng(0).permutation(len(mesh.facets))
    turned = mesh.facets[order][:, [1, 2, 0]].astype(np.int32)
    assert np.array_equal(facet_owners(mesh.tets.astype(np.int32), turned), (owner[order], opposite[order]))


def test_large_node_numbers_of_few_bits_do_not_overflow():
    nodes = np.array([0, 70_000, 140_000, 210_000], dtype=np.int32)
    owner, opposite = facet_owners(nodes[None], nodes[None, [1, 2, 3]])
    assert (owner.tolist(), opposite.tolist()) == ([0], [0])


@pytest.mark.parametrize("kind", ["twice", "inside", "elsewhere"])
def test_what_is_no_boundary_is_refused(mesh_of_cells, kind):
    mesh = mesh_of_cells(np.ones((1, 1, 1), dtype=bool))
    if kind == "twice":
        facets = np.concatenate([mesh.facets, mesh.facets[:1]])
    elif kind == "inside":
        # Node 0 and node 7 are the ends of the main diagonal, which all tetrahedra share.
        facets = np.concatenate([mesh.facets, [[0, 1, 7]]])
    else:
        facets = np.concatenate([mesh.facets, [[1, 2, 4]]])
    with pytest.raises(MeshError, match="each a face of exactly one tetrahedron, got"):
        facet_owners(mesh.tets, facets)
