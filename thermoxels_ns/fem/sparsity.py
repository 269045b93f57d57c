"""Symmetric matrices on the nodes of a mesh: one value per edge, one per node, and products with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.checks import check_shape
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.kernel_cache import kernel


@dataclass(frozen=True)
class MeshEdges:
    """Every edge of a tetrahedral mesh once, at its smaller node number: a strict upper triangle."""

    first: npt.NDArray[np.int64]
    """Edges of node i stand at first[i] to first[i + 1]; shape (n + 1,)."""
    other: npt.NDArray[np.int32]
    """The larger node number of each edge, ascending for each smaller one, shape (e,)."""

    @property
    def num_nodes(self) -> int:
        """Number of nodes, also those without an edge."""
        return len(self.first) - 1

    def smaller_nodes(self) -> npt.NDArray[np.int32]:
        """The smaller node number of each edge, shape (e,)."""
        return np.repeat(np.arange(self.num_nodes, dtype=np.int32), np.diff(self.first))


def mesh_edges(tets: npt.NDArray[np.int64], num_nodes: int) -> MeshEdges:
    """Find the edges of a mesh.

    Edges are put into one bucket per smaller node, where a mark on each node seen tells which came before: time and
    memory are linear, and no array of all 16 entries of all element matrices is ever made.

    Args:
        tets: Node numbers, shape (t, 4).
        num_nodes: Number of nodes, above the largest node number.

    Returns:
        The edges, in ascending order.

    Raises:
        HeatError: If a node number is out of range.

    >>> edges = mesh_edges(np.array([[3, 0, 2, 1], [1, 2, 4, 3]]), 5)
    >>> np.column_stack([edges.smaller_nodes(), edges.other]).tolist()
    [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]
    """
    tets = checked_tets(tets, num_nodes)
    end, other = np.zeros(num_nodes + 1, np.int64), np.empty(6 * len(tets), np.int32)
    first, mark = np.zeros(num_nodes + 1, np.int64), np.full(num_nodes, -1, np.int32)
    kept = _unique_edges(tets, end, other, first, mark)
    return MeshEdges(first, other[:kept].copy())


def checked_tets(tets: npt.NDArray[np.int64], num_nodes: int) -> npt.NDArray[np.int64]:
    """Return tetrahedra as compiled loops take them, if every node number is in range, else raise `HeatError`."""
    remedy = "Build the mesh with thermoxels_ns.mesh."
    check_shape("mesh tets", tets, (None, 4), remedy, HeatError)
    if len(tets) and (tets.min() < 0 or tets.max() >= num_nodes):
        raise HeatError(
            "mesh tets",
            expected=f"node numbers from 0 to {num_nodes - 1}",
            got=f"{tets.min()} to {tets.max()}",
            remedy=remedy,
        )
    return np.ascontiguousarray(tets, dtype=np.int64)


def symmetric_matrix(
    edges: MeshEdges, edge_values: npt.NDArray[np.float64], diagonal: npt.NDArray[np.float64]
) -> sparse.csr_matrix:
    """Put one value per edge and one per node into a matrix that is symmetric bit for bit.

    Args:
        edges: Where the values off the diagonal stand.
        edge_values: Shape (e,); those that are exactly 0 are not stored.
        diagonal: Shape (n,).

    Returns:
        Shape (n, n), columns in ascending order.
    """
    kept = np.flatnonzero(edge_values)
    rows = np.searchsorted(kept, edges.first).astype(np.int32)
    shape = (edges.num_nodes, edges.num_nodes)
    upper = sparse.csr_matrix((edge_values[kept], edges.other[kept], rows), shape=shape)
    return sparse.csr_matrix(upper + upper.T.tocsr() + sparse.diags(diagonal, format="csr"))


def product_and_bound(
    matrix: sparse.csr_matrix, vector: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Compute A x and |A| |x|: the round-off in the first is a few eps of the second.

    >>> product_and_bound(sparse.csr_matrix([[2.0, -1.0], [-1.0, 2.0]]), np.array([3.0, 3.0]))
    (array([3., 3.]), array([9., 9.]))
    """
    product, bound = np.empty(len(vector)), np.empty(len(vector))
    _product_and_bound(matrix.indptr, matrix.indices, matrix.data, vector, product, bound)
    return product, bound


@kernel
def _unique_edges(tets, end, other, first, mark):
    """Returns the number of edges; `first` and the beginning of `other` are those of `MeshEdges`."""
    num_nodes = len(mark)
    for t in range(len(tets)):
        for a in range(3):
            for b in range(a + 1, 4):
                end[min(tets[t, a], tets[t, b]) + 1] += 1
    for node in range(num_nodes):
        end[node + 1] += end[node]
    # Each edge moves the end of its bucket: afterwards end[i] is where the bucket of i + 1 begins.
    for t in range(len(tets)):
        for a in range(3):
            for b in range(a + 1, 4):
                low, high = min(tets[t, a], tets[t, b]), max(tets[t, a], tets[t, b])
                other[end[low]] = high
                end[low] += 1
    begin = kept = np.int64(0)
    for node in range(num_nodes):
        for k in range(begin, end[node]):
            if mark[other[k]] != node:
                mark[other[k]] = node
                other[kept] = other[k]
                kept += 1
        # A node has few edges, and they are almost in order: insertion sort.
        for k in range(first[node] + 1, kept):
            high, place = other[k], k
            while place > first[node] and other[place - 1] > high:
                other[place] = other[place - 1]
                place -= 1
            other[place] = high
        begin = end[node]
        first[node + 1] = kept
    return kept


@kernel
def _product_and_bound(indptr, indices, data, vector, product, bound):
    for row in range(len(vector)):
        total = size = 0.0
        for k in range(np.uint64(indptr[row]), np.uint64(indptr[row + 1])):
            term = data[k] * vector[np.uint64(indices[k])]  # unsigned: no test for negative numbers
            total += term
            size += abs(term)
        product[row], bound[row] = total, size
