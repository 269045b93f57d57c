"""Stiffness and lumped mass of linear tetrahedra (P1), the edges of a mesh, and uniform refinement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.mesh.quality.tet_shapes import TET_EDGES as SHAPE_EDGES
from thermoxels_ns.mesh.quality.tet_shapes import edge_stiffness, flatness, signed_volumes
from thermoxels_ns.mesh.tetrahedra import TetMesh

FLATTEST = 1e-6
"""Least `flatness` of a tetrahedron. In a flatter one, conduction through the thickness is more than 1 / `FLATTEST`^2
times conduction along the plane, and round-off hides the latter."""
TET_EDGES = np.array([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)])
"""Local numbers of the two ends of each edge of a tetrahedron, shape (6, 2), in scikit-fem's order."""
FACET_EDGES = np.array([(0, 1), (1, 2), (0, 2)])  # Local numbers of the two ends of each edge of a triangle, (3, 2)


@dataclass(frozen=True)
class MeshEdges:
    """The e edges of a tetrahedral mesh of n nodes, each listed once, sorted by smaller, then by larger node."""

    ends: IntArray  # Smaller and larger node number of each edge, shape (e, 2)
    num_nodes: int  # Number of nodes, n, including nodes without an edge

    def midpoints(self, nodal: FloatArray) -> FloatArray:
        """Return the mean of the values at both ends of each edge, shape (e, ...), from values at nodes, (n, ...)."""
        return 0.5 * (nodal[self.ends[:, 0]] + nodal[self.ends[:, 1]])

    def numbers(self, elements: IntArray, ends: IntArray) -> IntArray:
        """Return the numbers, rows of `self.ends`, of the edges of k tetrahedra or triangles, shape (k, j).

        `elements` (k, 4 or 3) are their nodes, and `ends` is `TET_EDGES` or `FACET_EDGES` (j is 6 or 3).

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
    """Return the stiffness matrix, k * integral(grad phi_i . grad phi_j), (n, n), [W / K], symmetric bit for bit.

    The result equals that of scikit-fem with `space.conduction`, in a fraction of the time and of the memory
    (`tests/benchmarks/heat_speed.py`). `points_m` has the shape (n, 3), [m], and `conductivity_w_mk` (t,), above 0. The
    caller must check `tets` (t, 4) by `refuse_flat_tets`. Entries that are 0 because of right angles are not stored.

    >>> corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> (6 * stiffness_matrix(corner, np.array([[0, 1, 2, 3]]), np.ones(1))).toarray().round(12).tolist()
    [[3.0, -1.0, -1.0, -1.0], [-1.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 1.0]]
    """
    num_nodes, entries = len(points_m), edge_stiffness(points_m, tets)
    start = np.minimum(np.arange(num_nodes + 1, dtype=np.int32), 1)
    sums = _sums_at_edges(tets, entries, np.asarray(conductivity_w_mk, np.float64), start)
    upper = sparse.csr_matrix((*sums, start), shape=(num_nodes, num_nodes))
    upper.sort_indices()
    return sparse.csr_matrix(upper + upper.T.tocsr())


@kernel
def _sums_at_edges(tets: IntArray, entries: FloatArray, factors: FloatArray, start: IntArray):
    """Return data and column indices of the upper triangle of a CSR matrix whose rows sum to 0 with its transpose's.

    An entry is the sum of `entries`, (t, 6), times `factors`, (t,), at an edge. Its row is the smaller node, its column
    the larger one. The diagonal is halved, since the transpose has it too. Columns of a row are not sorted; edges whose
    entries are all 0 are left out. `start`, (n + 1,), must be 0, 1, ..., 1 and becomes the matrix's row pointer.
    """
    for t in range(len(tets)):
        for e in range(6):
            if entries[t, e] != 0.0:
                start[min(tets[t, SHAPE_EDGES[e, 0]], tets[t, SHAPE_EDGES[e, 1]]) + 1] += 1
    start[:] = np.cumsum(start)
    end, larger, sums = start[:-1] + 1, np.empty(start[-1], np.int32), np.zeros(start[-1])
    for node in range(len(end)):
        larger[start[node]] = node
    for t in range(len(tets)):
        for e in range(6):
            if entries[t, e] != 0.0:
                one, two = tets[t, SHAPE_EDGES[e, 0]], tets[t, SHAPE_EDGES[e, 1]]
                node, other = min(one, two), max(one, two)
                place = start[node] + 1
                while place < end[node] and larger[place] != other:
                    place += 1
                if place == end[node]:
                    larger[place], end[node] = other, place + 1
                entry = factors[t] * entries[t, e]
                sums[place] += entry
                sums[start[node]] -= 0.5 * entry
                sums[start[other]] -= 0.5 * entry
    count = 0
    for node in range(len(end)):
        first, start[node] = start[node], count
        for place in range(first, end[node]):
            larger[count], sums[count] = larger[place], sums[place]
            count += 1
    start[-1] = count
    return sums[:count].copy(), larger[:count].copy()


def lumped_mass(points_m: FloatArray, tets: IntArray, heat_capacity_j_m3k: FloatArray) -> FloatArray:
    """Return the lumped mass rho c * integral(phi_i) of every node i, the mass matrix's row sums, shape (n,), [J / K].

    If no dihedral angle is obtuse, as in voxels, backward Euler with this mass keeps every temperature within the
    initial range for any step length (Li and Huang, arXiv 1209.5657). The capacity rho c has the shape (t,).
    """
    quarters = np.repeat(0.25 * heat_capacity_j_m3k * signed_volumes(points_m, tets), 4)
    return np.bincount(tets.ravel(), quarters, len(points_m)).astype(np.float64, copy=False)


def refuse_flat_tets(points_m: FloatArray, tets: IntArray) -> None:
    """Raise `HeatError` if a tetrahedron is inverted or flatter than `FLATTEST`; `TetMesh.check` must have passed."""
    num_flat = np.count_nonzero(~(flatness(points_m, tets) > FLATTEST))
    if num_flat:
        expected = f"volumes above 0 and heights of at least {FLATTEST:g} of the longest side"
        got = f"{num_flat} of {len(tets)} flat or inverted"
        raise HeatError("mesh tets", expected=expected, got=got, remedy="Build the mesh with thermoxels_ns.mesh.")


def refine_mesh(mesh: TetMesh) -> TetMesh:
    """Return a uniform refinement: a conforming mesh of the same body with eight tetrahedra in place of each.

    The four corners of a tetrahedron become children of the same shape. The octahedron between them is cut into four
    along the shortest of its three diagonals, as scikit-fem does. Children of Kuhn tetrahedra, six of which fill a
    cube, are Kuhn tetrahedra, so no angle becomes obtuse.

    Nodes keep their numbers; the midpoints of edges follow in the order of `mesh_edges`. Children have the order,
    regions, tags and patches of their parents. Temperatures and colours of new nodes are means, and a new node counts
    as observed if both ends of its edge are observed.
    """
    edges = mesh_edges(mesh.tets, len(mesh.points_m))
    num_nodes, (low, high) = len(mesh.points_m), edges.ends.T
    points = np.concatenate([mesh.points_m, edges.midpoints(mesh.points_m)])
    local = np.concatenate([mesh.tets, num_nodes + edges.numbers(mesh.tets, TET_EDGES)], axis=1)
    facets = np.concatenate([mesh.facets, num_nodes + edges.numbers(mesh.facets, FACET_EDGES)], axis=1)
    tags, colour = mesh.boundary, mesh.colour
    return replace(
        mesh,
        points_m=points,
        tets=np.take_along_axis(local[:, None], _CHILDREN[_diagonals(points, local)], axis=2).reshape(-1, 4),
        temperature_c=np.concatenate([mesh.temperature_c, edges.midpoints(mesh.temperature_c)]),
        observed=np.concatenate([mesh.observed, mesh.observed[low] & mesh.observed[high]]),
        facets=facets[:, _FACET_CHILDREN].reshape(-1, 3),
        facet_tags=np.repeat(mesh.facet_tags, 4),
        region=np.repeat(mesh.region, 8),
        boundary=replace(
            tags,
            seen=np.repeat(tags.seen, 4),
            patch=np.repeat(tags.patch, 4),
            photographs=None if tags.photographs is None else np.repeat(tags.photographs, 4, axis=0),
        ),
        colour=None if colour is None else np.concatenate([colour, 0.5 * (colour[low] + colour[high])]),
    )


_OPPOSITE = ((4, 9), (6, 8), (7, 5))  # Pairs of midpoints of opposite edges; 4 + e is the midpoint of `TET_EDGES[e]`


def _children() -> IntArray:
    """Return the local nodes of the 8 children for each of 3 diagonals, shape (3, 8, 4); 4 to 9 are midpoints."""
    middle = {frozenset(map(int, ends)): 4 + number for number, ends in enumerate(TET_EDGES)}
    corners = [[i if j == i else middle[frozenset((i, j))] for j in range(4)] for i in range(4)]
    place = np.vstack([np.zeros(3), np.eye(3)])
    place = np.concatenate([place, [place[list(ends)].mean(axis=0) for ends in TET_EDGES]])
    table = []
    for first in range(3):
        # The middles of one pair are the ends of the diagonal; the other two pairs are the ring around it.
        (a, b), (c, d) = (pair for pair in _OPPOSITE if pair is not _OPPOSITE[first])
        ring = [[*_OPPOSITE[first], *pair] for pair in ((a, c), (c, b), (b, d), (d, a))]
        upright = [t if np.linalg.det(place[t[1:]] - place[t[0]]) > 0.0 else [t[1], t[0], *t[2:]] for t in ring]
        table.append(corners + upright)
    return np.array(table)


_CHILDREN = _children()
_FACET_CHILDREN = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""Local nodes of a triangle's children, (4, 3): 0 to 2 are the corners, 3 to 5 the midpoints of `FACET_EDGES`."""
_TIE = 1.0 - 1e-9  # A later diagonal is taken only if it is shorter than this factor times the shortest before


def _diagonals(points: FloatArray, local: IntArray) -> IntArray:
    """Return the number (0 to 2) of the shortest diagonal of the octahedron in each tetrahedron, shape (t,)."""
    lengths = [np.linalg.norm(points[local[:, a]] - points[local[:, b]], axis=1) for a, b in _OPPOSITE]
    chosen, best = np.zeros(len(local), np.int64), lengths[0]
    for option in (1, 2):
        shorter = lengths[option] < _TIE * best
        chosen, best = np.where(shorter, option, chosen), np.where(shorter, lengths[option], best)
    return chosen
