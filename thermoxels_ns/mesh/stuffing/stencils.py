"""What fills the four tetrahedra around a voxel face, for every combination of signs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.mesh.quality.checks import OUTWARD_FACES

BUNDLE_EDGES: tuple[tuple[int, int], ...] = (
    (0, 1),
    *((0, corner) for corner in (2, 3, 4, 5)),
    *((1, corner) for corner in (2, 3, 4, 5)),
    *((2, 3), (3, 4), (4, 5), (5, 2)),
)
"""Ends of the 13 edges of a bundle; edge e has its cut at number 6 + e."""
BUNDLE_POINTS: FloatArray = np.array(
    [[0, 0, 0], [1, 0, 0], [0.5, -0.5, -0.5], [0.5, 0.5, -0.5], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5]]
)
"""Positions of the six points, the first coordinate along the face's axis, the others in cyclic order, [voxels]."""
SIDES_OUTWARD: IntArray = np.array([[0, 0, -1], [0, 1, 0], [0, 0, 1], [0, -1, 0]])
"""Steps, [voxels], from either centre to the centre on the other side of the triangle it spans with side 2-3, 3-4, 4-5
or 5-2 of the face."""
NUM_BUNDLE_NODES = 19
CODE_WEIGHTS: npt.NDArray[np.int16] = (3 ** np.arange(6)).astype(np.int16)
"""A bundle's code is the sum of (sign + 1) times these."""

_EDGE_NODE: dict[frozenset[int], int] = {frozenset(edge): 6 + e for e, edge in enumerate(BUNDLE_EDGES)}
_Tet = tuple[int, int, int, int]


@dataclass(frozen=True)
class StencilTable:
    """Tetrahedra and surface triangles of every bundle code; those of code c have rows start[c] to start[c + 1].

    The tetrahedra of the lattice come in bundles of four: around the long edge from the voxel centre below a face to
    the one above it, each with one side of the face. Points and edges of a bundle are numbered

        0, 1           centre below and above the face
        2 .. 5         the face's corners, counter-clockwise seen from above
        6              the cut of edge 0-1
        7 .. 10        the cuts of edges 0-2, 0-3, 0-4, 0-5
        11 .. 14       the cuts of edges 1-2, 1-3, 1-4, 1-5
        15 .. 18       the cuts of the face's sides 2-3, 3-4, 4-5, 5-2

    The same numbers serve the faces of all three axes: nothing changes when x, y, z are turned into y, z, x.
    """

    tets: IntArray  # bundle numbers, positively oriented, shape (t, 4)
    tet_start: IntArray  # shape (730,)
    facets: IntArray  # bundle numbers of triangles on the surface, right-hand normal out of the solid, shape (f, 3)
    facet_start: IntArray  # shape (730,)
    facet_behind: IntArray
    """-1: always on the boundary. 4 * c + s: only if the centre beyond side s, seen from centre c (0 or 1), is not
    inside the solid, because the lattice tetrahedron on the other side is then empty. Shape (f,)."""


@cache
def stencil_table() -> StencilTable:
    """Build the table, once."""
    tets, facets, behind = [], [], []
    tet_start, facet_start = [0], [0]
    # The first sign varies fastest, as in `CODE_WEIGHTS`.
    for reversed_signs in product((-1, 0, 1), repeat=6):
        signs = reversed_signs[::-1]
        for side in range(4):
            points = (0, 1, 2 + side, 2 + (side + 1) % 4)
            found = _fill_tet(points, tuple(signs[v] for v in points))
            tets += found
            for facet, where in _surface_faces(found, side, signs):
                facets.append(facet)
                behind.append(where)
        tet_start.append(len(tets))
        facet_start.append(len(facets))
    return StencilTable(
        tets=np.array(tets, dtype=np.int64),
        tet_start=np.array(tet_start, dtype=np.int64),
        facets=np.array(facets, dtype=np.int64),
        facet_start=np.array(facet_start, dtype=np.int64),
        facet_behind=np.array(behind, dtype=np.int64),
    )


@cache
def _fill_tet(points: _Tet, signs: tuple[int, ...]) -> list[_Tet]:
    """Fill the solid part of one lattice tetrahedron (the stencils of Labelle and Shewchuk 2007)."""
    plus = [v for v, sign in zip(points, signs) if sign > 0]
    zero = [v for v, sign in zip(points, signs) if sign == 0]
    minus = [v for v, sign in zip(points, signs) if sign < 0]
    if not plus:
        return []
    if not minus:
        return [points]
    if len(plus) == 1:
        return [_oriented((plus[0], *zero, *(_cut(plus[0], v) for v in minus)))]
    if len(plus) == 2 and zero:
        # A pyramid over the quadrilateral that is left of the face without the point on the surface.
        first, second = _diagonal_first(plus[0], plus[1], minus[0])
        near, far = _cut(first, minus[0]), _cut(second, minus[0])
        return [_oriented((first, second, far, zero[0])), _oriented((first, far, near, zero[0]))]
    if len(plus) == 2:
        a, b = plus
        top, bottom = (a, *(_cut(a, v) for v in minus)), (b, *(_cut(b, v) for v in minus))
        before = {(0, n) if _diagonal_first(a, b, v)[0] == a else (n, 0) for n, v in enumerate(minus, start=1)}
    else:
        top, bottom = tuple(plus), tuple(_cut(v, minus[0]) for v in plus)
        pairs = ((0, 1), (0, 2), (1, 2))
        before = {(m, n) if _diagonal_first(plus[m], plus[n], minus[0])[0] == plus[m] else (n, m) for m, n in pairs}
    return _fill_prism(top, bottom, before)


def _fill_prism(top: tuple[int, ...], bottom: tuple[int, ...], before: set[tuple[int, int]]) -> list[_Tet]:
    """Cut a prism into three; (m, n) in `before` is the diagonal from corner m of the top to corner n of the bottom."""
    for order in permutations(range(3)):
        if all(order.index(m) < order.index(n) for m, n in before):
            i, j, k = order
            return [
                _oriented((top[i], top[j], top[k], bottom[k])),
                _oriented((top[i], top[j], bottom[j], bottom[k])),
                _oriented((top[i], bottom[i], bottom[j], bottom[k])),
            ]
    raise AssertionError("the diagonals of a prism run in a circle")


def _diagonal_first(a: int, b: int, outside: int) -> tuple[int, int]:
    """Order the two inner points of a face so that its diagonal runs from the first one to the cut of the other.

    The rule depends on the face alone, so both tetrahedra that share it agree (Labelle and Shewchuk 2007, section 3):
    between the ends of a short edge, the diagonal ends at the cut of the long edge; between the ends of a long one, it
    starts at the lower end if an odd number of coordinates of the outer point is above those of the lower end. The
    diagonals of a prism then never run in a circle.
    """
    along = BUNDLE_POINTS[b] - BUNDLE_POINTS[a]
    if np.abs(along).max() < 1.0:
        to_a = np.abs(BUNDLE_POINTS[outside] - BUNDLE_POINTS[a]).max()
        return (b, a) if to_a == 1.0 else (a, b)
    low, high = (a, b) if along.sum() > 0.0 else (b, a)
    odd = np.count_nonzero(BUNDLE_POINTS[outside] > BUNDLE_POINTS[low]) % 2 == 1
    return (low, high) if odd else (high, low)


def _surface_faces(filled: list[_Tet], side: int, signs: tuple[int, ...]) -> list[tuple[tuple[int, int, int], int]]:
    """Faces of the filled part of one lattice tetrahedron that lie on the surface, and what decides about them."""
    found = []
    for tet in filled:
        for opposite, face in enumerate(OUTWARD_FACES.tolist()):
            facet = (tet[face[0]], tet[face[1]], tet[face[2]])
            if any(v < 6 and signs[v] > 0 for v in facet):
                continue
            behind = -1
            if max(facet) < 6:
                # Three lattice points: the face of a lattice tetrahedron, which has a neighbour there.
                if tet[opposite] in (0, 1):
                    behind = 4 * (1 - tet[opposite]) + side
                else:
                    kept = next(v for v in facet if v > 1)
                    beyond = 2 + (2 * (kept - 2) - (tet[opposite] - 2)) % 4
                    if signs[beyond] > 0:
                        continue
            found.append((facet, behind))
    return found


def _cut(a: int, b: int) -> int:
    return _EDGE_NODE[frozenset((a, b))]


def _oriented(tet: tuple[int, ...]) -> _Tet:
    """Turn a tetrahedron so that its volume is above 0, with all cuts in the middle of their edges."""
    middles = [0.5 * (BUNDLE_POINTS[a] + BUNDLE_POINTS[b]) for a, b in BUNDLE_EDGES]
    corners = np.concatenate([BUNDLE_POINTS, middles])[list(tet)]
    a, b, c, d = tet
    return (a, b, c, d) if np.linalg.det(corners[1:] - corners[0]) > 0.0 else (a, b, d, c)
