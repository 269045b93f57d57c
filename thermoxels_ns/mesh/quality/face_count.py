"""Faces and edges of a tetrahedral mesh, and which tetrahedra share them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.arrays import IntArray
from thermoxels_ns.core.errors import MeshError

OUTWARD_FACES: IntArray = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], dtype=np.int64)
"""Faces of a positively oriented tetrahedron; face f lies opposite node f, its right-hand normal points outwards."""
TET_EDGES: IntArray = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], dtype=np.int64)
"""Positions of a tetrahedron's nodes at the ends of its six edges, shape (6, 2)."""


@dataclass(frozen=True)
class Groups:
    """Rows put together by equality; group g is `order[start[g]:start[g + 1]]`, the last one ends with `order`."""

    order: IntArray  # row numbers, those of a group in a row; within a group in no particular order. Shape (rows,).
    start: IntArray
    """Where each group starts in `order`, shape (groups,); groups go by their first and then their second number."""

    @property
    def sizes(self) -> IntArray:
        """Number of rows in each group, shape (groups,)."""
        return np.diff(np.append(self.start, len(self.order)))

    @property
    def first(self) -> IntArray:
        """Smallest row number of each group, shape (groups,)."""
        return np.minimum.reduceat(self.order, self.start) if len(self.start) else self.start

    @property
    def of_row(self) -> IntArray:
        """Number of the group that each row is in, shape (rows,)."""
        group = np.empty(len(self.order), dtype=np.int64)
        group[self.order] = np.repeat(np.arange(len(self.start)), self.sizes)
        return group

    def sums(self, values: npt.NDArray) -> npt.NDArray:
        """Sum of a value per row over each group, shape (groups,)."""
        return np.add.reduceat(values[self.order], self.start) if len(self.start) else values[:0]


def group_pairs(first: IntArray, second: IntArray) -> Groups:
    """Find the rows in which a pair of whole numbers of at least 0 is the same.

    Two stages, both linear in memory: a counting sort by the first number (a sparse row turned into columns), then a
    sort of the few rows that share it. On a million tetrahedra this is several times faster than one sort of all rows.
    The work space grows with the largest first number; second numbers are below 2^63 - 1.

    >>> groups = group_pairs(np.array([5, 2, 5, 2]), np.array([1, 9, 1, 0]))
    >>> groups.sizes, groups.first
    (array([1, 1, 2]), array([3, 1, 0]))
    """
    rows = len(first)
    if rows == 0:
        empty = np.zeros(0, dtype=np.int64)
        return Groups(empty, empty)
    shape = (int(first.max()) + 1, int(second.max()) + 1)
    by_first = sparse.csr_array((np.arange(rows), first, np.array([0, rows])), shape=(1, shape[0])).tocsc()
    rows_by_first = np.asarray(by_first.data, dtype=np.int64)
    starts = np.asarray(by_first.indptr, dtype=np.int64)
    by_both = sparse.csr_array((rows_by_first, second[rows_by_first], starts), shape=shape)
    by_both.sort_indices()
    new = np.empty(rows, dtype=bool)
    new[0] = True
    np.not_equal(by_both.indices[1:], by_both.indices[:-1], out=new[1:])
    new[starts[:-1][np.diff(starts) > 0]] = True
    return Groups(np.asarray(by_both.data, dtype=np.int64), np.flatnonzero(new))


def group_faces(tets: IntArray) -> Groups:
    """Find the faces that tetrahedra share; row 4 t + f is the face of tetrahedron t opposite its node f."""
    node = [np.ascontiguousarray(tets[:, n]) for n in range(4)]
    # Sorted element by element with five comparisons.
    a, b = np.minimum(node[0], node[1]), np.maximum(node[0], node[1])
    c, d = np.minimum(node[2], node[3]), np.maximum(node[2], node[3])
    s0, low, high, s3 = np.minimum(a, c), np.maximum(a, c), np.minimum(b, d), np.maximum(b, d)
    s1, s2 = np.minimum(low, high), np.maximum(low, high)
    size = int(s3.max()) + 1 if len(tets) else 1
    lowest, others = np.empty((len(tets), 4), dtype=np.int64), np.empty((len(tets), 4), dtype=np.int64)
    for n, left_out in enumerate(node):
        lowest[:, n] = np.where(left_out == s0, s1, s0)
        others[:, n] = np.where(left_out <= s1, s2, s1) * size + np.where(left_out == s3, s2, s3)
    return group_pairs(lowest.ravel(), others.ravel())


def faces_of_rows(tets: IntArray, rows: IntArray) -> IntArray:
    """Node numbers of faces numbered as in `group_faces`, outwards from the tetrahedron, shape (rows, 3)."""
    return tets.ravel().take((rows & ~3)[:, None] + OUTWARD_FACES[rows & 3])


def boundary_facets(tets: IntArray, faces: Groups | None = None) -> IntArray:
    """Triangles that belong to exactly one tetrahedron, outwards, shape (f, 3), ordered by their sorted node numbers.

    `faces` is `group_faces(tets)` where that is already known.

    >>> boundary_facets(np.array([[0, 1, 2, 3], [1, 3, 2, 4]])).shape
    (6, 3)
    """
    faces = group_faces(tets) if faces is None else faces
    return faces_of_rows(tets, faces.first[faces.sizes == 1])


def group_edges(tets: IntArray) -> Groups:
    """Find the edges that tetrahedra share; row 6 t + e is edge `TET_EDGES[e]` of tetrahedron t."""
    ends = [tets[:, TET_EDGES[:, side]] for side in range(2)]
    return group_pairs(np.minimum(*ends).ravel(), np.maximum(*ends).ravel())


def edges_of_rows(tets: IntArray, rows: IntArray) -> IntArray:
    """Node numbers of the ends of edges numbered as in `group_edges`, shape (rows, 2)."""
    tet, edge = np.divmod(rows, 6)
    return tets[tet[:, None], TET_EDGES[edge]]


def facet_owners(tets: IntArray, facets: IntArray) -> tuple[IntArray, IntArray]:
    """Tetrahedron of every boundary triangle, and which of its four nodes lies opposite to it, each shape (f,).

    Only faces whose nodes all lie on the boundary are looked at, so the sort follows the surface, not the volume.

    Raises:
        MeshError: A triangle is listed twice, is no face of a tetrahedron, or lies between two.

    >>> facet_owners(np.array([[0, 1, 2, 3]]), np.array([[0, 2, 1], [1, 2, 3]]))
    (array([0, 0]), array([3, 0]))
    """
    if not len(facets):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    on_boundary = np.zeros(max(int(tets.max()), int(facets.max())) + 1, dtype=bool)
    on_boundary[facets.ravel()] = True
    flags = on_boundary[tets]
    num_flagged = flags.sum(axis=1)
    # A face is flagged if the only node that is not is the one opposite, or none is not.
    flagged_face = (num_flagged[:, None] - flags) == 3
    candidate_tet, candidate_face = np.nonzero(flagged_face)
    faces = tets[candidate_tet[:, None], OUTWARD_FACES[candidate_face]]

    low, middle, high = np.sort(np.concatenate([facets, faces]).astype(np.int64), axis=1).T
    # Two keys sort faster than three; node numbers are far below 2^31. The sort is stable: triangles come first.
    key = low * len(on_boundary) + middle
    order = np.lexsort((high, key))
    key, high = key[order], high[order]
    first = np.flatnonzero(np.concatenate([[True], (key[1:] != key[:-1]) | (high[1:] != high[:-1])]))
    uses = np.diff(np.append(first, len(order)))
    asked = order[first] < len(facets)
    first, uses = first[asked], uses[asked]
    second = order[np.minimum(first + 1, len(order) - 1)]
    if len(first) != len(facets) or np.any(uses != 2) or np.any(second < len(facets)):
        expected = "different triangles, each a face of exactly one tetrahedron"
        got = f"{len(facets) - np.count_nonzero((uses == 2) & (second >= len(facets)))} others"
        remedy = "Build the mesh with thermoxels_ns.mesh.build."
        raise MeshError("facets", expected=expected, got=got, remedy=remedy)
    face = np.empty(len(facets), dtype=np.int64)
    face[order[first]] = second - len(facets)
    return candidate_tet[face], candidate_face[face]
