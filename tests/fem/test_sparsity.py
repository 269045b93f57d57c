from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.sparsity import MeshEdges, mesh_edges, product_and_bound, symmetric_matrix


def pairs(edges: MeshEdges) -> np.ndarray:
    return np.column_stack([edges.smaller_nodes(), edges.other])


def all_pairs(tets: np.ndarray) -> np.ndarray:
    """Every edge of every tetrahedron, by brute force."""
    ends = tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)
    return np.unique(np.sort(ends, axis=1), axis=0)


def random_tets(num_tets: int, num_nodes: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([rng.choice(num_nodes, 4, replace=False) for _ in range(num_tets)])


def test_every_edge_once_and_in_order() -> None:
    tets = random_tets(300, 60)
    np.testing.assert_array_equal(pairs(mesh_edges(tets, 60)), all_pairs(tets))


def test_a_node_with_very_many_neighbours() -> None:
    """Tetrahedra around one axis, numbered at random: buckets are far larger than in any regular mesh."""
    count = 3000
    ring = np.random.default_rng(1).permutation(count) + 2
    tets = np.column_stack([np.zeros(count, int), np.ones(count, int), ring, np.roll(ring, -1)])
    edges = mesh_edges(tets, count + 2)
    np.testing.assert_array_equal(pairs(edges), all_pairs(tets))
    assert np.diff(edges.first)[0] == count + 1


def test_nodes_without_edges_and_no_tets_at_all() -> None:
    tets = np.array([[2, 5, 3, 7]])
    edges = mesh_edges(tets, 10)
    assert edges.num_nodes == 10
    np.testing.assert_array_equal(pairs(edges), [[2, 3], [2, 5], [2, 7], [3, 5], [3, 7], [5, 7]])
    assert pairs(mesh_edges(np.zeros((0, 4), int), 3)).shape == (0, 2)


def test_layout_of_the_arrays_does_not_matter() -> None:
    tets = random_tets(50, 30)
    wanted = pairs(mesh_edges(tets, 30))
    read_only = tets.copy()
    read_only.flags.writeable = False
    for other in (tets.astype(np.int32), np.asfortranarray(tets), np.repeat(tets, 2, axis=0)[::2], read_only):
        np.testing.assert_array_equal(pairs(mesh_edges(other, 30)), wanted)


@pytest.mark.parametrize("bad", [-1, 4])
def test_node_numbers_out_of_range_are_refused(bad: int) -> None:
    with pytest.raises(HeatError, match="mesh tets: expected node numbers from 0 to 3"):
        mesh_edges(np.array([[0, 1, 2, bad]]), 4)


def test_symmetric_matrix_holds_the_values_and_no_zeros() -> None:
    rng = np.random.default_rng(2)
    tets = random_tets(80, 40)
    edges = mesh_edges(tets, 40)
    values, diagonal = rng.normal(size=len(edges.other)), rng.normal(size=40)
    values[::3] = 0.0
    expected = np.diag(diagonal)
    low, high = pairs(edges).T
    expected[low, high] = expected[high, low] = values
    first, other = edges.first.copy(), edges.other.copy()
    matrix = symmetric_matrix(edges, values, diagonal)
    np.testing.assert_array_equal(matrix.toarray(), expected)
    assert matrix.nnz == 40 + 2 * np.count_nonzero(values)
    assert matrix.has_sorted_indices and matrix.indices.dtype == np.int32
    # Matrices are made one after the other from the same edges.
    np.testing.assert_array_equal(edges.first, first)
    np.testing.assert_array_equal(edges.other, other)


def test_product_and_its_bound() -> None:
    matrix = sparse.random(50, 50, 0.2, "csr", random_state=3)
    matrix.data -= 0.5
    vector = np.random.default_rng(3).normal(size=50)
    product, bound = product_and_bound(matrix, vector)
    np.testing.assert_allclose(product, matrix.toarray() @ vector, rtol=0, atol=1e-15 * bound.max())
    np.testing.assert_allclose(bound, np.abs(matrix.toarray()) @ np.abs(vector), rtol=1e-14)
