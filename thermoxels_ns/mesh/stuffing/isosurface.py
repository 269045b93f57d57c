"""Isosurface stuffing: tetrahedra that follow the zero level of a lattice of voxel centres."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_finite, check_shape
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import OUTWARD_FACES
from thermoxels_ns.mesh.stuffing.coarse_interior import CoarseInterior, coarse_interior
from thermoxels_ns.mesh.stuffing.lattice import DIRECTIONS, BccLattice, WarpedLattice, bcc_lattice, warp
from thermoxels_ns.mesh.tetrahedra import FACET_BOX
from thermoxels_ns.mesh.voxel_tets import boundary_tags

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

_CUT = {(a, b): 6 + e for e, (c, d) in enumerate(BUNDLE_EDGES) for a, b in ((c, d), (d, c))}  # edge to its cut
_Tet = tuple[int, int, int, int]
_CHUNK = 1 << 16


@dataclass(frozen=True)
class StuffedSolid:
    """Tetrahedra that fill a solid up to its surface, in fractional corner indices of the voxel lattice."""

    points: FloatArray
    """Nodes, shape (n, 3), all different and all used; each coordinate is from 0 to the number of voxels."""
    tets: IntArray  # node numbers, shape (t, 4), positively oriented
    facets: IntArray  # boundary triangles, shape (f, 3), right-hand normal out of the solid
    on_surface: BoolArray  # True for nodes of boundary triangles, shape (n,)
    on_box: BoolArray
    """True for boundary triangles on the border of the voxel lattice, exactly on its plane, shape (f,)."""


def stuff(level: npt.NDArray[np.floating], coarsest: int = 4) -> StuffedSolid:
    """Fill the part of a voxel lattice where the level is above 0 with tetrahedra up to the zero level.

    Isosurface stuffing (Labelle and Shewchuk 2007, ACM Transactions on Graphics 26(3), article 57) on a body-centred
    cubic lattice: of one voxel near the surface, of cubes that double in size from there on inwards. All dihedral
    angles are between 10.9 and 163.8 degrees, whatever the levels are, and between 45 and 120 away from the surface,
    which is the same to the last bit whatever the size of the cells inside.

    The surface is exact in the second order of the voxel size where the level is linear over the voxels next to it.
    Levels that stop at -1 and 1 should not do so closer than 1.5 voxels to the surface: at 0.5 voxels the area of a
    sphere is 1.5 % too large, and 13 % with -1 and 1 alone. Sharp edges become chamfers about half a voxel wide. Solid
    voxels that share a face stay in one piece, and walls and gaps of one voxel get no holes.

    Args:
        level: Levels at the voxel centres, above 0 in solid voxels, shape (cx, cy, cz). Only their ratios matter.
        coarsest: Edge of the largest cells inside the solid, [voxels], a power of two; 1 makes all cells alike. Larger
            cells than 4 hardly save anything, because most tetrahedra are at the surface.

    Returns:
        The mesh. Where solid voxels touch the border of the lattice, it ends on the border.

    Raises:
        MeshError: A level is NaN or infinite, none is above 0, or the largest edge is no power of two.

    >>> solid = stuff(np.ones((1, 1, 1)))
    >>> len(solid.points), len(solid.tets), len(solid.facets), bool(solid.on_box.all())
    (15, 24, 24, True)
    >>> [len(stuff(np.ones((30, 30, 30)), coarsest).tets) for coarsest in (1, 2, 4, 8)]
    [334800, 158208, 148848, 148800]
    """
    check_coarsest("coarsest", coarsest, "Pass 4, or 1 for cells of one voxel throughout.")
    level, remedy = np.asarray(level), "Pass one level for every voxel of the lattice."
    if level.dtype not in (np.float32, np.float64):
        level = level.astype(np.float64)
    check_shape("level", level, (None, None, None), remedy, MeshError)
    check_finite("level", level, remedy, MeshError)
    if not np.any(level > 0.0):
        expected = "solid voxels, with levels above 0"
        raise MeshError("level", expected=expected, got="none", remedy="Lower the threshold.")
    lattice = bcc_lattice(level)
    interior = coarse_interior(lattice, coarsest)
    warped = warp(lattice, None if interior is None else interior.buried(lattice))
    nodes = _number_nodes(lattice, warped, interior)
    filled = [_fill_bundles(bundles, warped.sign, nodes) for bundles in _solid_bundles(lattice, warped.sign, interior)]
    tets, facets = (list(arrays) for arrays in zip(*filled))
    if interior is not None:
        tets.append(nodes.of_point[interior.tets])
    tets, facets = (np.concatenate(arrays, dtype=np.int64) for arrays in (tets, facets))
    on_surface = np.zeros(len(nodes.points), dtype=bool)
    on_surface[facets] = True
    on_box = boundary_tags(facets, nodes.points, tuple(n + 1 for n in level.shape)) == FACET_BOX
    return StuffedSolid(nodes.points, tets, facets, on_surface, on_box)


def check_coarsest(name: str, value: int, remedy: str) -> None:
    """Raise `MeshError` unless the largest edge of cells is a power of two."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not (whole and value >= 1 and value & (value - 1) == 0):
        raise MeshError(name, expected="1, 2, 4, 8 or another power of two, [voxels]", got=repr(value), remedy=remedy)


@dataclass(frozen=True)
class _Nodes:
    """The nodes: points inside that have cuts, other points inside, points on the surface, cuts."""

    points: FloatArray  # positions, shape (n, 3)
    of_point: npt.NDArray[np.integer]  # node number of every lattice point, -1 where it is no node
    of_cut: npt.NDArray[np.integer]  # node numbers of the cuts on the 14 edges of the first nodes, -1 where no cut is


def _number_nodes(lattice: BccLattice, warped: WarpedLattice, interior: CoarseInterior | None) -> _Nodes:
    inner, sign = warped.inner, warped.sign
    # A point on the surface is a node if one of its neighbours is inside: they share a tetrahedron.
    touched = np.zeros(len(sign), dtype=bool)
    for neighbour in lattice.each_neighbour(inner):
        touched[neighbour[sign[neighbour] == 0]] = True
    plain = np.zeros(len(sign), dtype=bool)
    plain[inner] = True
    plain[warped.cut_points] = False
    if interior is not None:
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
    return _Nodes(points, of_point, of_cut)


@dataclass(frozen=True)
class _Bundles:
    """Some of the voxel faces of one axis, each with the four lattice tetrahedra around it."""

    points: IntArray  # flat lattice indices of the six points of each bundle, shape (6, b)
    sides: IntArray  # flat steps from a centre to the one beyond each side of the face, shape (4,)
    directions: IntArray  # lattice direction of each edge of a bundle, there and back, shape (13, 2)


def _solid_bundles(
    lattice: BccLattice, sign: npt.NDArray[np.int8], interior: CoarseInterior | None
) -> Iterator[_Bundles]:
    """All bundles with a point inside the solid but none in larger cubes, a chunk at a time."""
    inner = sign > 0
    first, second = np.array(BUNDLE_EDGES).T
    for axis in range(3):
        # Bundles are written for the x axis; x, y, z turn into the axes from here on in their order.
        strides = np.roll(lattice.strides, -axis)
        corners = np.where(BUNDLE_POINTS[2:] > 0.0, 0, -1) @ strides + lattice.num_centres
        offsets = np.concatenate([[0, strides[0]], corners])
        steps = np.roll(BUNDLE_POINTS[second] - BUNDLE_POINTS[first], axis, axis=1)
        ways = np.stack([steps, -steps], axis=1)
        directions = np.argmin(np.abs(ways[:, :, None, :] - DIRECTIONS).max(axis=-1), axis=-1)

        # Where a step leaves a row, a layer or a block it ends in the padding, where nothing is inside.
        active = np.zeros(lattice.num_centres, dtype=bool)
        for offset in offsets:
            active |= inner[offset : offset + len(active)]
        if interior is not None:
            active &= ~interior.covered
            active[: -strides[0]] &= ~interior.covered[strides[0] :]
        below = np.flatnonzero(active)
        for start in range(0, len(below), _CHUNK):
            yield _Bundles(below[start : start + _CHUNK] + offsets[:, None], SIDES_OUTWARD @ strides, directions)


def _fill_bundles(
    bundles: _Bundles, sign: npt.NDArray[np.int8], nodes: _Nodes
) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]:
    """Tetrahedra and boundary triangles in the bundles."""
    table = stencil_table()
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
    number = number.reshape(-1)

    bundle, row = _rows(table.tet_start, code)
    tets = number[table.tets[row] * count + bundle[:, None]]

    bundle, row = _rows(table.facet_start, code)
    behind = table.facet_behind[row]
    asks = np.flatnonzero(behind >= 0)
    centre, side = np.divmod(behind[asks], 4)
    beyond = bundles.points[centre, bundle[asks]] + bundles.sides[side]
    keep = np.ones(len(row), dtype=bool)
    keep[asks] = sign[beyond] <= 0
    facets = number[table.facets[row[keep]] * count + bundle[keep, None]]
    return tets, facets


def _rows(start: IntArray, code: npt.NDArray[np.int16]) -> tuple[IntArray, IntArray]:
    """Bundle and table row of everything that the codes of the bundles call for."""
    counts = start[code + 1] - start[code]
    bundle = np.repeat(np.arange(len(code)), counts)
    shift = start[code] + counts - np.cumsum(counts)
    return bundle, np.arange(len(bundle)) + shift[bundle]


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
        return [_oriented((plus[0], *zero, *(_CUT[plus[0], v] for v in minus)))]
    if len(plus) == 2 and zero:
        # A pyramid over the quadrilateral that is left of the face without the point on the surface.
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


def _oriented(tet: tuple[int, ...]) -> _Tet:
    """Turn a tetrahedron so that its volume is above 0, with all cuts in the middle of their edges."""
    middles = [0.5 * (BUNDLE_POINTS[a] + BUNDLE_POINTS[b]) for a, b in BUNDLE_EDGES]
    corners = np.concatenate([BUNDLE_POINTS, middles])[list(tet)]
    a, b, c, d = tet
    return (a, b, c, d) if np.linalg.det(corners[1:] - corners[0]) > 0.0 else (a, b, d, c)
