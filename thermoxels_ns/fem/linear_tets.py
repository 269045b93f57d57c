"""Stiffness and lumped mass of linear tetrahedra (P1), and the edges of a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.mesh.quality.tet_shapes import TET_EDGES as SHAPE_EDGES
from thermoxels_ns.mesh.quality.tet_shapes import shapes_in_chunks, signed_volumes

FLATTEST = 1e-6
"""Least height of a tetrahedron over its size. In a flatter one, conduction along its plane is lost to round-off beside
conduction through its thickness, which is 1 / `FLATTEST`^2 times as large."""
TET_EDGES = np.array([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)])
"""Local numbers of the two ends of each edge of a tetrahedron, in scikit-fem's order."""
FACET_EDGES = np.array([(0, 1), (1, 2), (0, 2)])  # The same for the edges of a triangle


@dataclass(frozen=True)
class MeshEdges:
    """The e edges of a tetrahedral mesh of n nodes, each listed once, sorted by smaller, then by larger node."""

    ends: IntArray  # Smaller and larger node number of each edge, shape (e, 2)
    num_nodes: int  # Number of nodes, n, including nodes without an edge

    def midpoints(self, nodal: FloatArray) -> FloatArray:
        """Return the mean of the values at both ends of each edge, shape (e, ...), from values at nodes, (n, ...)."""
        return 0.5 * (nodal[self.ends[:, 0]] + nodal[self.ends[:, 1]])

    def numbers(self, elements: IntArray, ends: IntArray) -> IntArray:
        """Return the numbers of the j edges, (k, j), of k tets or triangles; `ends` is `TET_EDGES` or `FACET_EDGES`.

        >>> edges = mesh_edges(np.array([[3, 0, 2, 1]]), 4)
        >>> edges.numbers(np.array([[0, 2, 3]]), FACET_EDGES).tolist()
        [[1, 5, 2]]
        """
        return np.searchsorted(_keys(self.ends, self.num_nodes), _keys(elements[:, ends], self.num_nodes))


def mesh_edges(tets: IntArray, num_nodes: int) -> MeshEdges:
    """Return the edges of a mesh of n nodes in ascending order; `tets` has shape (t, 4).

    >>> mesh_edges(np.array([[3, 0, 2, 1], [1, 2, 4, 3]]), 5).ends.tolist()
    [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]
    """
    keys = np.unique(_keys(tets[:, TET_EDGES], num_nodes))
    return MeshEdges(np.stack(np.divmod(keys, num_nodes), axis=1), num_nodes)


def _keys(pairs: IntArray, num_nodes: int) -> IntArray:
    """Return one number for each pair of nodes (..., 2), in either order; the numbers ascend as the pairs do."""
    return pairs.min(axis=-1).astype(np.int64) * num_nodes + pairs.max(axis=-1)


def stiffness_matrix(points_m: FloatArray, tets: IntArray, conductivity_w_mk: FloatArray) -> sparse.csr_matrix:
    """Assemble K, entries k * integral(grad phi_i . grad phi_j), shape (n, n), [W / K], symmetric bit for bit.

    The result is that of `space.conduction` through scikit-fem, in a fraction of the time and of the memory of whole
    runs (`tests/benchmarks/heat_speed.py`). `points_m` has shape (n, 3), [m], `tets` (t, 4), checked by
    `refuse_flat_tets`; the conductivity has shape (t,), [W / (m K)], above 0. Nodes between which only right angles lie
    have no entry.

    >>> corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> (6 * stiffness_matrix(corner, np.array([[0, 1, 2, 3]]), np.ones(1))).toarray().round(12).tolist()
    [[3.0, -1.0, -1.0, -1.0], [-1.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 1.0]]
    """
    num_nodes, entries = len(points_m), np.empty((len(tets), 6))
    for which, shapes in shapes_in_chunks(points_m, tets):
        entries[which] = (conductivity_w_mk[which] * shapes.stiffness()).T
    first, second = (tets[:, SHAPE_EDGES[:, end]].ravel().astype(np.int32) for end in (0, 1))
    ends = np.minimum(first, second), np.maximum(first, second)
    upper = sparse.csr_matrix((entries.ravel(), ends), shape=(num_nodes, num_nodes))
    upper.eliminate_zeros()
    # A constant temperature has no gradient, so each row sums to 0.
    diagonal = np.zeros(num_nodes)
    diagonal -= np.asarray(upper.sum(axis=0)).ravel()
    diagonal -= np.asarray(upper.sum(axis=1)).ravel()
    return sparse.csr_matrix(upper + upper.T.tocsr() + sparse.diags(diagonal, format="csr"))


def lumped_mass(points_m: FloatArray, tets: IntArray, heat_capacity_j_m3k: FloatArray) -> FloatArray:
    """Return rho c * integral(phi_i) for every node i, the row sums of the mass matrix, shape (n,), [J / K].

    With non-obtuse tetrahedra, such as those of a lattice, backward Euler with this mass keeps every temperature within
    the initial range for any step length (Li and Huang, arXiv 1209.5657). The capacity, (t,), is in [J / (m3 K)].
    """
    quarters = np.repeat(0.25 * heat_capacity_j_m3k * signed_volumes(points_m, tets), 4)
    return np.bincount(tets.ravel(), quarters, len(points_m)).astype(np.float64, copy=False)


def refuse_flat_tets(points_m: FloatArray, tets: IntArray) -> None:
    """Raise `HeatError` if tetrahedra of a mesh that `TetMesh.check` accepts are inverted or flat."""
    num_flat = sum(int(np.count_nonzero(~(one.flatness > FLATTEST))) for _, one in shapes_in_chunks(points_m, tets))
    if num_flat:
        expected = f"volumes above 0 and heights of at least {FLATTEST:g} of the longest side"
        got = f"{num_flat} of {len(tets)} flat or inverted"
        raise HeatError("mesh tets", expected=expected, got=got, remedy="Build the mesh with thermoxels_ns.mesh.")
