"""Edges of tetrahedra and triangles by number, for nodes that sit in their middles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.sparsity import MeshEdges

TET_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
"""Ends of the edges of a tetrahedron; edges i and 5 - i are opposite."""
FACET_EDGES = np.array([(0, 1), (1, 2), (2, 0)])
"""Ends of the edges of a triangle."""


def edge_numbers(
    edges: MeshEdges, elements: npt.NDArray[np.int64], ends: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """Number the edges of elements.

    Args:
        edges: The edges of the mesh.
        elements: Node numbers, shape (k, m).
        ends: Which two of an element's nodes each of its edges joins, shape (j, 2).

    Returns:
        Numbers of edges, shape (k, j); -1 where the mesh has no such edge.

    >>> from thermoxels_ns.fem.sparsity import mesh_edges
    >>> edges = mesh_edges(np.array([[3, 0, 2, 1]]), 4)
    >>> edge_numbers(edges, np.array([[0, 2, 3]]), FACET_EDGES).tolist()
    [[1, 5, 2]]
    """
    numbers = np.empty((len(elements), len(ends)), np.int64)
    _find(edges.first, edges.other, np.ascontiguousarray(elements, np.int64), np.ascontiguousarray(ends), numbers)
    return numbers


def midpoints(edges: MeshEdges, nodal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Means of the values at both ends of each edge, shape (e, ...)."""
    return 0.5 * (nodal[edges.smaller_nodes()] + nodal[edges.other])


@kernel
def _find(first, other, elements, ends, numbers):
    num_nodes = len(first) - 1
    for k in range(len(elements)):
        for j in range(len(ends)):
            p, q = elements[k, ends[j, 0]], elements[k, ends[j, 1]]
            low, high = min(p, q), max(p, q)
            numbers[k, j] = -1
            if low < 0 or high >= num_nodes:
                continue
            begin, end = first[low], first[low + 1]
            while begin < end:
                middle = (begin + end) // 2
                if other[middle] < high:
                    begin = middle + 1
                else:
                    end = middle
            if begin < first[low + 1] and other[begin] == high:
                numbers[k, j] = begin
