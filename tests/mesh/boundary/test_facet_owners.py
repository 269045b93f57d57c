"""Each boundary triangle finds its tetrahedron."""

from __future__ import annotations

import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.boundary.facet_owners import facet_owners
from thermoxels_ns.mesh.voxel_tets import OUTWARD_FACES


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


def test_no_triangles_have_no_owners():
    owner, opposite = facet_owners(np.array([[0, 1, 2, 3]]), np.zeros((0, 3), dtype=np.int64))
    assert len(owner) == len(opposite) == 0
