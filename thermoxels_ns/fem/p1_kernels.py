"""Compiled loops for the stiffness and lumped mass of linear tetrahedra (P1), and for the edges of a mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.kernel_cache import kernel

Vector = FloatArray
Numbers = IntArray

FLATTEST = 1e-6
"""Least height of a tetrahedron over its size. In a flatter one, conduction along its plane is lost to round-off beside
conduction through its thickness, which is 1 / `FLATTEST`^2 times as large."""
_ANGLE_ROUND_OFF = 32.0 * np.finfo(np.float64).eps
"""Upper estimate of the round-off of the cosine of an angle, for a tetrahedron as large as its largest coordinate."""
TET_EDGES = np.array([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)])
"""Local numbers of the two ends of each edge of a tetrahedron, in scikit-fem's order."""
FACET_EDGES = np.array([(0, 1), (1, 2), (0, 2)])  # The same for the edges of a triangle


@dataclass(frozen=True)
class MeshEdges:
    """The e edges of a tetrahedral mesh of n nodes, each listed once, sorted by smaller, then by larger node."""

    first: IntArray  # Edges whose smaller node is i have numbers first[i] to first[i + 1] - 1; shape (n + 1,)
    other: npt.NDArray[np.int32]  # The larger node number of each edge, shape (e,)

    @property
    def num_nodes(self) -> int:
        """Number of nodes, including nodes without an edge."""
        return len(self.first) - 1

    def smaller_nodes(self) -> npt.NDArray[np.int32]:
        """Return the smaller node number of each edge, shape (e,)."""
        return np.repeat(np.arange(self.num_nodes, dtype=np.int32), np.diff(self.first))

    def midpoints(self, nodal: FloatArray) -> FloatArray:
        """Return the mean of the values at both ends of each edge, shape (e, ...), from values at nodes, (n, ...)."""
        return 0.5 * (nodal[self.smaller_nodes()] + nodal[self.other])

    def numbers(self, elements: IntArray, ends: IntArray) -> IntArray:
        """Return the numbers of the j edges, (k, j), of k tets or triangles; `ends` is `TET_EDGES` or `FACET_EDGES`.

        >>> edges = mesh_edges(np.array([[3, 0, 2, 1]]), 4)
        >>> edges.numbers(np.array([[0, 2, 3]]), FACET_EDGES).tolist()
        [[1, 5, 2]]
        """
        numbers = np.empty((len(elements), len(ends)), np.int64)
        _edge_numbers(self.first, self.other, np.ascontiguousarray(elements, np.int64), ends, numbers)
        return numbers


def mesh_edges(tets: IntArray, num_nodes: int) -> MeshEdges:
    """Return the edges of a mesh of n nodes in ascending order; `tets` has shape (t, 4).

    >>> edges = mesh_edges(np.array([[3, 0, 2, 1], [1, 2, 4, 3]]), 5)
    >>> np.column_stack([edges.smaller_nodes(), edges.other]).tolist()
    [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]
    """
    ends = tets.astype(np.int32)[:, TET_EDGES].reshape(-1, 2).T
    pairs = np.minimum(*ends), np.maximum(*ends)
    links = sparse.csr_matrix((np.ones(len(pairs[0]), bool), pairs), shape=(num_nodes, num_nodes))
    return MeshEdges(links.indptr.astype(np.int64), links.indices.astype(np.int32, copy=False))


def stiffness_matrix(
    points_m: Vector, tets: Numbers, conductivity_w_mk: Vector, *, edges: MeshEdges | None = None
) -> sparse.csr_matrix:
    """Assemble K, entries k * integral(grad phi_i . grad phi_j), shape (n, n), [W / K], symmetric bit for bit.

    The result is that of `space.conduction` through scikit-fem, in a tenth of the time and of the memory of whole runs
    (`tests/benchmarks/heat_speed.py`). A tetrahedron whose faces opposite nodes i and j have the outward area vectors
    n_i and n_j adds k n_i . n_j / (9 V), or 0 if the angle between these faces is right up to round-off of the
    coordinates. `points_m` has shape (n, 3), [m], `tets` (t, 4), checked by `refuse_flat_tets`; the conductivity has
    shape (t,), [W / (m K)], above 0; `edges` None: `mesh_edges` finds them.

    >>> corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> (6 * stiffness_matrix(corner, np.array([[0, 1, 2, 3]]), np.ones(1))).toarray().round(12).tolist()
    [[3.0, -1.0, -1.0, -1.0], [-1.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 1.0]]
    """
    points_m, tets = _prepared(points_m, tets)
    edges = mesh_edges(tets, len(points_m)) if edges is None else edges
    coupling, reach_m = np.zeros(len(edges.other)), float(np.max(np.abs(points_m), initial=0.0))
    _add_couplings(points_m, tets, conductivity_w_mk, reach_m, edges.first, edges.other, coupling)
    # A constant temperature has no gradient, so each row sums to 0.
    diagonal = np.zeros(edges.num_nodes)
    diagonal -= np.bincount(edges.smaller_nodes(), coupling, edges.num_nodes)
    diagonal -= np.bincount(edges.other, coupling, edges.num_nodes)
    kept = np.flatnonzero(coupling)
    rows, shape = np.searchsorted(kept, edges.first).astype(np.int32), (edges.num_nodes, edges.num_nodes)
    upper = sparse.csr_matrix((coupling[kept], edges.other[kept], rows), shape=shape)
    return sparse.csr_matrix(upper + upper.T.tocsr() + sparse.diags(diagonal, format="csr"))


def lumped_mass(points_m: Vector, tets: Numbers, heat_capacity_j_m3k: Vector) -> Vector:
    """Return rho c * integral(phi_i) for every node i, the row sums of the mass matrix, shape (n,), [J / K].

    With non-obtuse tetrahedra, such as those of a lattice, backward Euler with this mass keeps every temperature within
    the initial range for any step length (Li and Huang, arXiv 1209.5657). The capacity, (t,), is in [J / (m3 K)].
    """
    points_m, tets = _prepared(points_m, tets)
    nodal = np.zeros(len(points_m))
    _add_capacities(points_m, tets, heat_capacity_j_m3k, nodal)
    return nodal


def refuse_flat_tets(points_m: Vector, tets: Numbers) -> None:
    """Raise `HeatError` if tetrahedra of a mesh that `TetMesh.check` accepts are inverted or flat."""
    num_flat = _count_flat(*_prepared(points_m, tets))
    if num_flat:
        expected = f"volumes above 0 and heights of at least {FLATTEST:g} of the longest side"
        got = f"{num_flat} of {len(tets)} flat or inverted"
        raise HeatError("mesh tets", expected=expected, got=got, remedy="Build the mesh with thermoxels_ns.mesh.")


def _prepared(points_m: Vector, tets: Numbers) -> tuple[Vector, Numbers]:
    """Return the arrays as the kernels take them."""
    return np.ascontiguousarray(points_m, np.float64), np.ascontiguousarray(tets, np.int64)


@kernel
def _sides(points, tet):
    # Node numbers are unsigned, here and below, which saves a test for negative indices.
    o, a = points[np.uint64(tet[0])], points[np.uint64(tet[1])]
    b, c = points[np.uint64(tet[2])], points[np.uint64(tet[3])]
    return (
        (a[0] - o[0], a[1] - o[1], a[2] - o[2]),
        (b[0] - o[0], b[1] - o[1], b[2] - o[2]),
        (c[0] - o[0], c[1] - o[1], c[2] - o[2]),
    )


@kernel
def _cross(u, v):
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


@kernel
def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@kernel
def _size(a, b, c):
    return max(abs(a[0]), abs(a[1]), abs(a[2]), abs(b[0]), abs(b[1]), abs(b[2]), abs(c[0]), abs(c[1]), abs(c[2]))


@kernel
def _is_flat(a, b, c):
    """Return whether a tetrahedron with these sides is inverted or its least height at most `FLATTEST` of its size."""
    n1, n2, n3 = _cross(b, c), _cross(c, a), _cross(a, b)
    n0 = (n1[0] + n2[0] + n3[0], n1[1] + n2[1] + n3[1], n1[2] + n2[2] + n3[2])
    largest = math.sqrt(max(_dot(n0, n0), _dot(n1, n1), _dot(n2, n2), _dot(n3, n3)))  # twice the area of a face
    return not _dot(a, n1) > FLATTEST * largest * _size(a, b, c)


@kernel
def _place(first, other, node, neighbour):
    """Return the number of the edge between two nodes, found by bisection."""
    low, high = np.uint64(min(node, neighbour)), max(node, neighbour)
    begin, end = np.uint64(first[low]), np.uint64(first[low + np.uint64(1)])
    while begin < end:
        middle = (begin + end) >> np.uint64(1)
        if other[middle] < high:
            begin = middle + np.uint64(1)
        else:
            end = middle
    return begin


@kernel
def _edge_numbers(first, other, elements, ends, numbers):
    for k in range(len(elements)):
        for j in range(len(ends)):
            numbers[k, j] = _place(first, other, elements[k, ends[j, 0]], elements[k, ends[j, 1]])


@kernel
def _count_flat(points, tets):
    flat = 0
    for t in range(len(tets)):
        a, b, c = _sides(points, tets[t])
        flat += _is_flat(a, b, c)
    return flat


@kernel
def _add_couplings(points, tets, conductivity, reach, first, other, coupling):
    for t in range(len(tets)):
        tet = tets[t]
        a, b, c = _sides(points, tet)
        # Inward normals of the face opposite each node, of twice this face's area in length.
        n1, n2, n3 = _cross(b, c), _cross(c, a), _cross(a, b)
        n0 = (-n1[0] - n2[0] - n3[0], -n1[1] - n2[1] - n3[1], -n1[2] - n2[2] - n3[2])
        normals = (n0, n1, n2, n3)
        right = _ANGLE_ROUND_OFF * reach / _size(a, b, c)
        squares = (_dot(n0, n0), _dot(n1, n1), _dot(n2, n2), _dot(n3, n3))
        factor = conductivity[t] / (6.0 * _dot(a, n1))
        for i in range(3):
            for j in range(i + 1, 4):
                product = _dot(normals[i], normals[j])
                if abs(product) > right * min(squares[i], squares[j]):
                    coupling[_place(first, other, tet[i], tet[j])] += factor * product


@kernel
def _add_capacities(points, tets, capacity, nodal):
    for t in range(len(tets)):
        tet = tets[t]
        a, b, c = _sides(points, tet)
        for i in range(4):
            nodal[tet[i]] += capacity[t] * _dot(a, _cross(b, c)) / 24.0
