"""Isosurface stuffing: tetrahedra that fill a solid up to the zero surface of a level function on voxel centres."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.stuffing.lattice import (
    DIRECTIONS,
    BccLattice,
    CoarseInterior,
    WarpedLattice,
    bcc_lattice,
    coarse_interior,
    warp,
)
from thermoxels_ns.mesh.tetrahedra import FACET_BOX
from thermoxels_ns.mesh.voxel_tets import boundary_tags

BUNDLE_EDGES: tuple[tuple[int, int], ...] = (
    (0, 1),
    *((0, corner) for corner in (2, 3, 4, 5)),
    *((1, corner) for corner in (2, 3, 4, 5)),
    *((2, 3), (3, 4), (4, 5), (5, 2)),
)
"""The two end points of each of a bundle's 13 edges, see `stencil_table`; the cut of edge e has the number 6 + e."""
BUNDLE_POINTS: FloatArray = np.array(
    [[0, 0, 0], [1, 0, 0], [0.5, -0.5, -0.5], [0.5, 0.5, -0.5], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5]]
)
"""Positions of a bundle's six points, (6, 3), [voxels], along the axis across the face and then the next two axes."""
NUM_BUNDLE_NODES = 19
CODE_WEIGHTS: npt.NDArray[np.int16] = (3 ** np.arange(6)).astype(np.int16)
"""The code of a bundle is the sum of (sign + 1) times these weights over its six points."""

_CUT = {(a, b): 6 + e for e, (c, d) in enumerate(BUNDLE_EDGES) for a, b in ((c, d), (d, c))}  # ends to cut
_Tet = tuple[int, int, int, int]
_CHUNK = 1 << 16


@dataclass(frozen=True)
class StuffedSolid:
    """Tetrahedra that fill a solid up to its surface; positions are fractional corner indices of the voxel lattice."""

    points: FloatArray
    """Positions of nodes, shape (n, 3), all different and used; coordinates are from 0 to the number of voxels."""
    tets: IntArray  # node numbers, shape (t, 4), positively oriented
    facets: IntArray  # boundary triangles, shape (f, 3); right-hand normals point out of the solid
    on_box: BoolArray  # True for boundary triangles that lie exactly on a border plane of the voxel lattice, shape (f,)


def stuff(level: npt.NDArray[np.floating], coarsest: int = 4) -> StuffedSolid:
    """Return tetrahedra that fill the part of a voxel lattice in which the interpolated level is above 0.

    This is isosurface stuffing (Labelle and Shewchuk 2007, ACM Transactions on Graphics 26(3), article 57) on a
    body-centred cubic lattice. The lattice's cubes have an edge of one voxel near the surface, and their size doubles
    inwards. All dihedral angles are between 10.9 and 163.8 degrees for any levels, and between 45 and 120 degrees away
    from the surface. The size of the cubes inside has no influence on the surface.

    Errors of the surface are of second order in the voxel size if the level is linear over the voxels next to it. If
    levels are clipped to -1 and 1, the clipping should begin at least 1.5 voxels from the surface: at 0.5 voxels the
    area of a sphere is 1.5 % too large, and with levels of -1 and 1 alone 13 %. Sharp edges become chamfers half a
    voxel wide. Solid voxels that share a face remain connected; walls and gaps of one voxel get no holes. If solid
    voxels touch the border of the lattice, the mesh ends on the border.

    Args:
        level: Levels at the voxel centres, shape (cx, cy, cz), above 0 in solid voxels; at least one must be. Only the
            ratios of levels have an influence.
        coarsest: Edge of the largest cubes inside the solid, [voxels], a power of two; 1 makes all cubes equal. More
            than 4 saves little, because most tetrahedra are at the surface.

    >>> solid = stuff(np.ones((1, 1, 1)))
    >>> len(solid.points), len(solid.tets), len(solid.facets), bool(solid.on_box.all())
    (15, 24, 24, True)
    >>> [len(stuff(np.ones((30, 30, 30)), coarsest).tets) for coarsest in (1, 2, 4, 8)]
    [334800, 158208, 148848, 148800]
    """
    lattice = bcc_lattice(level)
    interior = coarse_interior(lattice, coarsest)
    warped = warp(lattice, interior.buried(lattice))
    nodes = _number_nodes(lattice, warped, interior)
    bundles = _solid_bundles(lattice, warped.sign, interior)
    filled = (_fill_bundles(some, warped.sign, nodes) for some in bundles)
    tets = np.concatenate([*filled, nodes.of_point[interior.tets]], dtype=np.int64)
    # Nodes from number `num_inside` on lie on the surface; only tetrahedra with three such nodes have a face there.
    facets = boundary_facets(tets[(tets >= nodes.num_inside).sum(axis=1) >= 3])
    facets = facets[facets.min(axis=1) >= nodes.num_inside]
    on_box = boundary_tags(facets, nodes.points, tuple(n + 1 for n in level.shape)) == FACET_BOX
    return StuffedSolid(nodes.points, tets, facets, on_box)


@dataclass(frozen=True)
class _Nodes:
    """Nodes of the mesh in this order: inner points with cut edges, other inner points, points on the surface, cuts."""

    points: FloatArray  # positions, shape (n, 3)
    of_point: npt.NDArray[np.integer]  # node number of every lattice point, -1 for points that are no node
    of_cut: npt.NDArray[np.integer]  # node number of the cut on each edge of each of `cut_points`, (s, 14); -1 if uncut
    num_inside: int  # number of nodes strictly inside; they are the first nodes


def _number_nodes(lattice: BccLattice, warped: WarpedLattice, interior: CoarseInterior) -> _Nodes:
    inner, sign = warped.inner, warped.sign
    # A point on the surface is a node if a neighbour is inside, because the two points share a tetrahedron.
    touched = np.zeros(len(sign), dtype=bool)
    for neighbour in lattice.each_neighbour(inner):
        touched[neighbour[sign[neighbour] == 0]] = True
    plain = np.zeros(len(sign), dtype=bool)
    plain[inner] = True
    plain[warped.cut_points] = False
    plain[interior.tets] = True
    kept = np.concatenate([warped.cut_points, np.flatnonzero(plain), np.flatnonzero(touched)])
    row, direction = np.nonzero(np.isfinite(warped.cuts))

    total = len(kept) + len(row)
    integer = np.int32 if total < 2**31 else np.int64
    of_point = np.full(len(sign), -1, dtype=integer)
    of_point[kept] = np.arange(len(kept))
    of_cut = np.full(warped.cuts.shape, -1, dtype=integer)
    of_cut[row, direction] = np.arange(len(kept), total)

    points = np.empty((total, 3))
    points[: len(kept)] = lattice.positions(kept)
    moved = touched[warped.moved]
    points[of_point[warped.moved[moved]]] = warped.moved_to[moved]
    points[len(kept) :] = points[row] + warped.cuts[row, direction, None] * DIRECTIONS[direction]
    return _Nodes(points, of_point, of_cut, int(np.count_nonzero(sign[kept] > 0)))


@dataclass(frozen=True)
class _Bundles:
    """Bundles of one axis: each bundle is the four tetrahedra at a voxel face across the axis, see `stencil_table`."""

    points: IntArray  # flat lattice indices of the six points of each bundle, shape (6, b)
    directions: IntArray  # row in `DIRECTIONS` of each edge as seen from its first and from its second end, (13, 2)


def _solid_bundles(lattice: BccLattice, sign: npt.NDArray[np.int8], interior: CoarseInterior) -> Iterator[_Bundles]:
    """Yield in chunks all bundles that have a point inside the solid and do not lie in or between larger cubes."""
    inner = sign > 0
    first, second = np.array(BUNDLE_EDGES).T
    for axis in range(3):
        # `BUNDLE_POINTS` are given for the x axis; for another axis the coordinates are rotated cyclically.
        strides = np.roll(lattice.strides, -axis)
        corners = np.where(BUNDLE_POINTS[2:] > 0.0, 0, -1) @ strides + lattice.num_centres
        offsets = np.concatenate([[0, strides[0]], corners])
        steps = np.roll(BUNDLE_POINTS[second] - BUNDLE_POINTS[first], axis, axis=1)
        ways = np.stack([steps, -steps], axis=1)
        directions = np.argmin(np.abs(ways[:, :, None, :] - DIRECTIONS).max(axis=-1), axis=-1)

        # A step that leaves a row, a layer or a block ends in the padding, where nothing is inside.
        active = np.zeros(lattice.num_centres, dtype=bool)
        for offset in offsets:
            active |= inner[offset : offset + len(active)]
        active &= ~interior.covered
        active[: -strides[0]] &= ~interior.covered[strides[0] :]
        below = np.flatnonzero(active)
        for start in range(0, len(below), _CHUNK):
            yield _Bundles(below[start : start + _CHUNK] + offsets[:, None], directions)


def _fill_bundles(bundles: _Bundles, sign: npt.NDArray[np.int8], nodes: _Nodes) -> npt.NDArray[np.integer]:
    """Return the tetrahedra that fill the solid part of the bundles, as node numbers, shape (t, 4)."""
    stencils, start = stencil_table()
    count = bundles.points.shape[1]
    signs = sign[bundles.points]
    code = CODE_WEIGHTS @ (signs + np.int16(1))

    number = np.empty((NUM_BUNDLE_NODES, count), dtype=nodes.of_point.dtype)
    number[:6] = nodes.of_point[bundles.points]
    for edge, (a, b) in enumerate(BUNDLE_EDGES):
        cut = np.flatnonzero(signs[a] * signs[b] < 0)
        from_a = signs[a, cut] > 0
        row = np.where(from_a, number[a, cut], number[b, cut])
        number[6 + edge, cut] = nodes.of_cut[row, np.where(from_a, *bundles.directions[edge])]

    # For every new tetrahedron: the bundle that it is in, and its row in the table of stencils.
    counts = start[code + 1] - start[code]
    bundle = np.repeat(np.arange(count), counts)
    row = np.arange(len(bundle)) + (start[code] + counts - np.cumsum(counts))[bundle]
    return number[stencils[row], bundle[:, None]]


@cache
def stencil_table() -> tuple[IntArray, IntArray]:
    """Return the tetrahedra of all bundle codes (`CODE_WEIGHTS`), (t, 4), and the first row of each code, (3^6 + 1,).

    The tetrahedra are positively oriented. A bundle is the four lattice tetrahedra around the long edge from the voxel
    centre below a voxel face to the centre above it. Each of them contains one side of the face. Points and cuts of a
    bundle are numbered

        0, 1           centre below and above the face
        2 .. 5         the face's corners, counter-clockwise seen from above
        6              the cut of edge 0-1
        7 .. 10        the cuts of edges 0-2, 0-3, 0-4, 0-5
        11 .. 14       the cuts of edges 1-2, 1-3, 1-4, 1-5
        15 .. 18       the cuts of the face's sides 2-3, 3-4, 4-5, 5-2

    The table is valid for faces across all three axes, because the lattice is the same after x, y, z become y, z, x.
    """
    tets, start = [], [0]
    # The first sign varies fastest, as in `CODE_WEIGHTS`.
    for reversed_signs in product((-1, 0, 1), repeat=6):
        signs = reversed_signs[::-1]
        for side in range(4):
            points = (0, 1, 2 + side, 2 + (side + 1) % 4)
            tets += _fill_tet(points, tuple(signs[v] for v in points))
        start.append(len(tets))
    return np.array(tets, dtype=np.int64), np.array(start, dtype=np.int64)


@cache
def _fill_tet(points: _Tet, signs: tuple[int, ...]) -> list[_Tet]:
    """Return tetrahedra that fill the solid part of a lattice tetrahedron (stencils of Labelle and Shewchuk 2007).
    `points` are four points of a bundle; `signs` are their signs: 1 inside the solid, 0 on its surface, -1 outside."""
    plus = [v for v, sign in zip(points, signs) if sign > 0]
    zero = [v for v, sign in zip(points, signs) if sign == 0]
    minus = [v for v, sign in zip(points, signs) if sign < 0]
    if not plus:
        return []
    if not minus:
        return [points]
    if len(plus) == 1:
        return [_oriented((plus[0], *zero, *(_CUT[plus[0], v] for v in minus)))]
    if len(plus) == 2 and zero:
        # The solid part is a pyramid: its tip is the point on the surface, its base the rest of the opposite face.
        first, second = _diagonal_first(plus[0], plus[1], minus[0])
        near, far = _CUT[first, minus[0]], _CUT[second, minus[0]]
        return [_oriented((first, second, far, zero[0])), _oriented((first, far, near, zero[0]))]
    if len(plus) == 2:
        a, b = plus
        top, bottom = (a, *(_CUT[a, v] for v in minus)), (b, *(_CUT[b, v] for v in minus))
        before = {(0, n) if _diagonal_first(a, b, v)[0] == a else (n, 0) for n, v in enumerate(minus, start=1)}
    else:
        top, bottom = tuple(plus), tuple(_CUT[v, minus[0]] for v in plus)
        pairs = ((0, 1), (0, 2), (1, 2))
        before = {(m, n) if _diagonal_first(plus[m], plus[n], minus[0])[0] == plus[m] else (n, m) for m, n in pairs}
    return _fill_prism(top, bottom, before)


def _fill_prism(top: tuple[int, ...], bottom: tuple[int, ...], before: set[tuple[int, int]]) -> list[_Tet]:
    """Return three tetrahedra that fill a prism between two triangles, `top` and `bottom`. A pair (m, n) in `before`
    says that the diagonal of a side goes from top corner m to bottom corner n."""
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
    """Return the inner points `a` and `b` of a face in the order in which the face's diagonal uses them.

    The diagonal goes from the first point to the cut between the second point and `outside`. The rule depends on the
    face alone, so both tetrahedra at the face agree (Labelle and Shewchuk 2007, section 3). If a short edge joins a and
    b, the diagonal ends at the cut of the long edge. If a long edge joins them, count the coordinates of `outside` that
    are above the lower end's: for an odd number the diagonal starts at the lower end, else at the upper end. The
    diagonals of a prism then never form a cycle.
    """
    along = BUNDLE_POINTS[b] - BUNDLE_POINTS[a]
    if np.abs(along).max() < 1.0:
        to_a = np.abs(BUNDLE_POINTS[outside] - BUNDLE_POINTS[a]).max()
        return (b, a) if to_a == 1.0 else (a, b)
    low, high = (a, b) if along.sum() > 0.0 else (b, a)
    odd = np.count_nonzero(BUNDLE_POINTS[outside] > BUNDLE_POINTS[low]) % 2 == 1
    return (low, high) if odd else (high, low)


def _oriented(tet: tuple[int, ...]) -> _Tet:
    """Return a tetrahedron with its last two nodes exchanged if its volume, with cuts in the middle, is negative."""
    middles = [0.5 * (BUNDLE_POINTS[a] + BUNDLE_POINTS[b]) for a, b in BUNDLE_EDGES]
    corners = np.concatenate([BUNDLE_POINTS, middles])[list(tet)]
    a, b, c, d = tet
    return (a, b, c, d) if np.linalg.det(corners[1:] - corners[0]) > 0.0 else (a, b, d, c)
