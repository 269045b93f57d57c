"""The body-centred cubic lattice of isosurface stuffing: levels, points moved to the surface, larger cubes inside."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.mesh.solid.morphology import bounding_box, shrink

_AXES = np.eye(3)[[0, 0, 1, 1, 2, 2]] * np.array([1.0, -1.0] * 3)[:, None]
_DIAGONALS = (np.arange(8)[:, None] >> np.array([2, 1, 0]) & 1) - 0.5

DIRECTIONS: FloatArray = np.concatenate([_AXES, _DIAGONALS])
"""Steps to the 14 neighbours, shape (14, 3), [voxels]: +x, -x, +y, -y, +z, -z, then the diagonals (---) to (+++)."""
LENGTHS: FloatArray = np.linalg.norm(DIRECTIONS, axis=1)  # lengths of the 14 edges, [voxels]
OPPOSITE: IntArray = np.array([1, 0, 3, 2, 5, 4, 13, 12, 11, 10, 9, 8, 7, 6])
"""Row of `DIRECTIONS` that points opposite to each row, shape (14,)."""


@dataclass(frozen=True)
class BccLattice:
    """A body-centred cubic lattice over the solid part of a voxel lattice, with a level at every point.

    The points are the voxel centres and the voxel corners. Each point has 14 neighbours. Six are of its own kind, along
    the axes (long edges, 1 voxel). Eight are of the other kind, along the space diagonals (short edges, sqrt(3)/2
    voxels). Points have a flat index: first a block of centres, then a block of corners, both padded to the same shape.
    A step along an edge therefore adds one number to the flat index of all centres, and one to that of all corners.
    """

    level: npt.NDArray[np.floating]  # level of every point, flat, above 0 in the solid; the padding is never solid
    shape: tuple[int, int, int]  # shape of each of the two padded blocks, centres and corners
    first_cell: IntArray  # index of the voxel whose centre has index (1, 1, 1) in its block

    @property
    def num_centres(self) -> int:
        """Number of points in the block of centres; also the flat index of the first corner."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    @property
    def strides(self) -> tuple[int, int, int]:
        """Numbers that a step of one voxel along x, y and z adds to the flat index."""
        return (self.shape[1] * self.shape[2], self.shape[2], 1)

    @cached_property
    def offsets(self) -> IntArray:
        """Numbers that a step to each neighbour adds to the flat index of a centre and of a corner, shape (2, 14)."""
        strides = np.array(self.strides)
        along = DIRECTIONS[:6].astype(np.int64) @ strides
        # Centre i of the first block lies half a voxel below corner i of the second, along each axis.
        to_corner = np.where(_DIAGONALS > 0.0, 0, -1) @ strides + self.num_centres
        to_centre = np.where(_DIAGONALS > 0.0, 1, 0) @ strides - self.num_centres
        return np.stack([np.concatenate([along, to_corner]), np.concatenate([along, to_centre])])

    def is_corner(self, points: IntArray) -> IntArray:
        """Return 1 for voxel corners, 0 for voxel centres; same shape as `points`."""
        return (points >= self.num_centres).astype(np.int64)

    def neighbours(self, points: IntArray) -> IntArray:
        """Return the flat indices of the 14 neighbours of each point, shape (n, 14)."""
        return points[:, None] + self.offsets[self.is_corner(points)]

    def each_neighbour(self, points: IntArray) -> Iterator[IntArray]:
        """Yield, for each of the 14 directions, the flat index of the neighbour of every point, shape (n,)."""
        corner = self.is_corner(points)
        for step in self.offsets.T:
            yield points + step[corner]

    def block_index(self, points: IntArray) -> IntArray:
        """Return the index of each point along x, y, z within its block of centres or corners, shape (n, 3)."""
        within = points - self.is_corner(points) * self.num_centres
        return np.stack(np.unravel_index(within, self.shape), axis=-1)

    def positions(self, points: IntArray) -> FloatArray:
        """Return the positions of points as fractional corner indices of the whole voxel lattice, shape (n, 3)."""
        shift = self.first_cell + 0.5 * self.is_corner(points)[:, None] - 0.5
        return self.block_index(points) + shift


def bcc_lattice(level: npt.NDArray[np.floating]) -> BccLattice:
    """Return the body-centred lattice of levels at voxel centres, shape (cx, cy, cz); at least one must be above 0.

    A corner gets the mean level of the eight centres around it (the trilinear value), or 0 if the mean would make a
    hole in a layer of one voxel. If solid touches the border of the voxel lattice, the surface lies on the border: each
    centre in the padding gets -|level| of the centre inside, and corners on the border are at most 0. The lattice
    covers the bounding box of the solid voxels and two voxels more on each side.
    """
    box = bounding_box(level > 0.0, margin=2)
    first, inner = np.array([part.start for part in box]), level[box]

    nx, ny, nz = (n + 2 for n in inner.shape)
    blocks = np.full((2, nx, ny, nz), -1.0, dtype=level.dtype)
    centres, corners = blocks
    centres[1:-1, 1:-1, 1:-1] = inner
    for axis in range(3):
        padded, within = np.moveaxis(centres, axis, 0), np.moveaxis(inner, axis, 0)
        padded[0, 1:-1, 1:-1] = -np.abs(within[0])
        padded[-1, 1:-1, 1:-1] = -np.abs(within[-1])

    mean = np.pad(inner, 1, mode="edge")
    for axis in range(3):
        mean = np.moveaxis(mean, axis, 0)
        mean = np.moveaxis(0.5 * (mean[1:] + mean[:-1]), 0, axis)
    for axis in range(3):
        border = np.moveaxis(mean, axis, 0)[[0, -1]]
        np.moveaxis(mean, axis, 0)[[0, -1]] = np.minimum(border, 0.0)
    corners[:-1, :-1, :-1] = mean
    _keep_sheets(centres, corners)
    return BccLattice(blocks.reshape(-1), (nx, ny, nz), first)


def _keep_sheets(centres: npt.NDArray[np.floating], corners: npt.NDArray[np.floating]) -> None:
    """Set corners to 0, in place, that would make a hole in a solid layer, or a bridge over a gap, one voxel thick.

    The middle of a square of four solid centres lies on the long edge between the corners above and below. If neither
    corner is above 0, the square is a hole unless both are exactly 0. Squares of empty centres in a gap are treated
    alike, with the opposite sign.
    """
    solid = centres > 0.0
    for layer, side in ((~solid, -1.0), (solid, 1.0)):
        for axis in range(3):
            flat = np.moveaxis(layer, axis, 0)[1:-1]
            square = flat[:, 1:, 1:] & flat[:, :-1, 1:]
            square &= flat[:, 1:, :-1]
            square &= flat[:, :-1, :-1]
            facing = np.moveaxis(corners, axis, 0)[:-1, :-1, :-1]
            below, above = facing[:-1], facing[1:]
            square &= side * below <= 0.0
            square &= side * above <= 0.0
            for corner in (below, above):
                corner[square] = 0.0


ALPHA_INSIDE = np.where(LENGTHS == 1.0, 0.272, 0.397)
"""Largest distance of a cut that moves a point inside the solid onto the surface, as a share of the edge, (14,)."""
ALPHA_OUTSIDE = np.where(LENGTHS == 1.0, 0.282, 0.369)
"""The same for points outside the solid, shape (14,).

With these four numbers all dihedral angles are between 10.94 and 163.74 degrees, the extremes over all stencils with
each cut and moved point at each end of its range. Labelle and Shewchuk (2007) give one pair of numbers for both sides.
"""


def _contractible_links() -> BoolArray:
    """Return whether each set of a point's neighbours can be shrunk to a point, (2^14,); bit d is neighbour d."""
    # The neighbours of a point span a sphere of 24 triangles. A part of a sphere can be shrunk to a point if both the
    # part and the rest of the sphere are one piece, and neither is empty.
    steps = DIRECTIONS[:, None, :] - DIRECTIONS[None, :, :]
    joined = (np.abs(steps[:, :, None, :] - DIRECTIONS).max(axis=-1) < 0.25).any(axis=-1)
    around = joined @ (1 << np.arange(14))
    sets = np.arange(1 << 14)

    def in_one_piece(members: IntArray) -> BoolArray:
        reached = members & -members
        for _ in range(14):
            for d in range(14):
                reached |= np.where(reached >> d & 1, around[d], 0) & members
        return (reached == members) & (members != 0)

    return in_one_piece(sets) & in_one_piece(sets ^ sets[-1])


_CONTRACTIBLE = _contractible_links()


@dataclass(frozen=True)
class WarpedLattice:
    """A lattice whose points close to the surface were moved onto it, and the cuts that are left on its edges."""

    sign: npt.NDArray[np.int8]  # +1 inside the solid, 0 on its surface, -1 outside, one per point of the lattice
    moved: IntArray  # points that moved, shape (m,)
    moved_to: FloatArray  # new positions of the `moved` points, fractional corner indices, shape (m, 3)
    inner: IntArray  # points with sign +1 that are not buried, ascending; shape (p,)
    cut_points: IntArray  # points of `inner` with at least one cut edge, ascending; shape (s,)
    cuts: FloatArray
    """Distance from each cut point to the cut of each edge, as a share of the edge; NaN on uncut edges, (s, 14)."""


def warp(lattice: BccLattice, buried: BoolArray) -> WarpedLattice:
    """Return the lattice with points close to the surface moved onto it, and the cuts that are left on edges.

    The cut of an edge between a point inside and a point outside is the zero of the linearly interpolated level. A
    point that has cuts nearer than alpha (`ALPHA_INSIDE`, `ALPHA_OUTSIDE`) times the edge moves to the nearest cut and
    gets sign 0; its edges are then uncut (Labelle and Shewchuk 2007, section 3). `buried` is True for points that are
    inside together with all their neighbours; they are skipped.

    Beyond the paper, thin parts are kept. An inside point does not move if its neighbour opposite to the nearest cut is
    not inside, or if the move could split, close or remove the solid there. Outside points and gaps are treated alike.
    The cuts that are left are then moved to at least alpha edge lengths from both ends, within the bounds on angles.
    """
    level = lattice.level
    sign = (level > 0.0).astype(np.int8)
    sign -= level < 0.0
    inner = np.flatnonzero((sign > 0) & ~buried)
    touches, touched = np.zeros(len(inner), dtype=bool), np.zeros(len(sign), dtype=bool)
    for neighbour in lattice.each_neighbour(inner):
        crosses = sign[neighbour] < 0
        touches |= crosses
        touched[neighbour[crosses]] = True
    # These are the points inside with a neighbour outside, and the points outside with a neighbour inside.
    inside, outside = inner[touches], np.flatnonzero(touched)

    moved, moved_to = [], []
    for points, own, alpha in ((inside, 1, ALPHA_INSIDE), (outside, -1, ALPHA_OUTSIDE)):
        share = _cut_shares(lattice, sign, points)
        reach = np.where(share < alpha, share * LENGTHS, np.inf)
        nearest = np.argmin(reach, axis=1)
        near = np.flatnonzero(np.isfinite(reach[np.arange(len(points)), nearest]))
        points, nearest, share = points[near], nearest[near], share[near, nearest[near]]
        behind = points + lattice.offsets[lattice.is_corner(points), OPPOSITE[nearest]]
        thick = sign[behind] == own
        points, nearest, share = points[thick], nearest[thick], share[thick]
        # Moving a point keeps the topology if its neighbours of the same sign can be shrunk to a point. Points form
        # four classes: centre or corner, with an even or odd sum of indices. No two points of one class are neighbours,
        # so all points of a class may be decided at once.
        free = np.zeros(len(points), dtype=bool)
        group = 2 * lattice.is_corner(points) + lattice.block_index(points).sum(axis=1) % 2
        for number in range(4):
            members = np.flatnonzero(group == number)
            alike = sign[lattice.neighbours(points[members])] == own
            free[members] = _CONTRACTIBLE[alike @ (1 << np.arange(14))]
            sign[points[members[free[members]]]] = 0
        moved.append(points[free])
        moved_to.append(lattice.positions(points[free]) + share[free, None] * DIRECTIONS[nearest[free]])

    inner = inner[sign[inner] > 0]
    inside = inside[sign[inside] > 0]
    share = _cut_shares(lattice, sign, inside)
    is_cut = np.isfinite(share)
    has_cut = is_cut.any(axis=1)
    held = np.clip(share, ALPHA_INSIDE, 1.0 - ALPHA_OUTSIDE)
    return WarpedLattice(
        sign=sign,
        moved=np.concatenate(moved),
        moved_to=np.concatenate(moved_to),
        inner=inner,
        cut_points=inside[has_cut],
        cuts=np.where(is_cut, held, np.nan)[has_cut],
    )


def _cut_shares(lattice: BccLattice, sign: npt.NDArray[np.int8], points: IntArray) -> FloatArray:
    """Return the distance from points to the cuts of their edges, as a share of the edge, (n, 14); inf if uncut."""
    neighbours = lattice.neighbours(points)
    own = lattice.level[points].astype(np.float64)
    other = lattice.level[neighbours].astype(np.float64)
    # A ratio that overflows is infinite and puts the cut at the point itself, which is right.
    with np.errstate(over="ignore", divide="ignore"):
        share = 1.0 / (1.0 - other / own[:, None])
    share[sign[neighbours] != -sign[points][:, None]] = np.inf
    return share


# Corners of a face across x, counter-clockwise seen from +x, and outward directions of its sides 0-1, 1-2, 2-3, 3-0.
_CORNERS = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]])
_OUTWARD = np.array([[0, 0, -1], [0, 1, 0], [0, 0, 1], [0, -1, 0]])


def balanced_octree(cells: BoolArray, largest: int) -> tuple[BoolArray, ...]:
    """Return a balanced octree: the cubes of 2, 4, 8, ... `largest` voxels into which the voxels of a set are joined.

    Entry n is a mask over all cubes of edge 2^(n + 1) voxels, True for cubes that hold no smaller cube. Cube (i, j, k)
    of edge s begins at voxel (i s, j s, k s). Cubes that touch, if only at a corner, differ at most by a factor 2 in
    size, and are as large as this allows. Voxels outside the set count as cubes of one voxel.

    >>> [np.count_nonzero(level) for level in balanced_octree(np.ones((12, 12, 12), dtype=bool), 8)]
    [216, 1]
    """
    levels: list[BoolArray] = []
    size, whole = 1, cells
    while size < largest:
        # A cube of two voxels may touch single voxels; larger cubes need neighbours of at least half their size.
        halves = whole if size == 1 else shrink(whole, 3)
        halves = np.pad(halves, [(0, n % 2) for n in halves.shape])
        nx, ny, nz = (n // 2 for n in halves.shape)
        whole = halves.reshape(nx, 2, ny, 2, nz, 2).all(axis=(1, 3, 5))
        if not whole.any():
            break
        levels.append(whole)
        size *= 2
    return tuple(levels)


def split_in_eight(level: BoolArray, shape: tuple[int, ...]) -> BoolArray:
    """Return the values `level` of cubes copied to the eight half-size cubes in each, cropped to `shape`."""
    return np.kron(level, np.ones((2, 2, 2), dtype=bool))[tuple(slice(n) for n in shape)]


@dataclass(frozen=True)
class CoarseInterior:
    """Tetrahedra of cubes of at least two voxels, which replace those of single voxels deep inside a solid."""

    covered: BoolArray  # True for voxels inside a larger cube, one entry per point of the block of centres, flat
    tets: IntArray  # all tetrahedra at faces of larger cubes, as flat indices of points, (t, 4), positively oriented

    def buried(self, lattice: BccLattice) -> BoolArray:
        """Return True for lattice points around which all voxels belong to larger cubes, shape (points,).

        These points and their neighbours are inside the solid; `warp` moves none of them and cuts none of their edges.
        """
        corners = shrink(self.covered.reshape(lattice.shape), 2, -1)
        return np.concatenate([self.covered, corners.reshape(-1)])


def coarse_interior(lattice: BccLattice, largest: int) -> CoarseInterior:
    """Return tetrahedra from cubes with edges of two to `largest` voxels, which fill the deep inside of a solid.

    The nodes are centres and corners of cubes, which are points of the body-centred cubic lattice (Labelle and Shewchuk
    2007). Two neighbours of the same size share a face. Each of the face's four sides makes a tetrahedron with the edge
    between the two centres. If smaller cubes touch a side, the node in its middle divides this tetrahedron in two. Two
    neighbours of different sizes share the smaller cube's face. The face's diagonal through the middle of the larger
    face cuts it into two triangles, and each triangle makes a tetrahedron with each centre. The octree begins at the
    lowest voxel that may be joined, so results do not depend on the position of the solid in the lattice.
    """
    deep = _far_from_surface(lattice)
    box = bounding_box(deep)
    first = np.array([part.start for part in box])
    octree = balanced_octree(deep[box], largest)
    covered, tets = np.zeros(lattice.shape, dtype=bool), [np.zeros((0, 4), dtype=np.int64)]
    if octree:
        covered[box] = split_in_eight(octree[0], deep[box].shape)
    for size, whole, joined in _each_size(octree, deep[box].shape) if octree else ():
        for axis in range(3):
            points = _Points.around(lattice, first, axis, size)
            if size > 1:
                tets += _between_equals(whole, whole & ~joined, axis, points)
            tets += _between_sizes(whole & ~joined, joined, axis, points)
    return CoarseInterior(covered.reshape(-1), np.concatenate(tets))


def _far_from_surface(lattice: BccLattice) -> BoolArray:
    """Return a mask of voxels whose faces' tetrahedra have no moved point and no cut edge, shape `lattice.shape`."""
    # A point of a cut edge has a neighbour outside. So the voxel's centre and corners and the six centres next to it
    # must be inside, and all neighbours of these points must not be outside: the centres two steps along faces away,
    # the corners of the six voxels beside it, and the centres of all voxels that touch it.
    centres, corners = lattice.level.reshape(2, *lattice.shape)
    inside = centres > 0.0
    deep = shrink(inside, 3) & shrink(corners > 0.0, 2)
    deep &= np.asarray(ndimage.binary_erosion(inside, iterations=2), dtype=bool)
    return deep & np.asarray(ndimage.binary_erosion(shrink(corners >= 0.0, 2)), dtype=bool)


def _each_size(octree: tuple[BoolArray, ...], shape: tuple[int, ...]) -> Iterator[tuple[int, BoolArray, BoolArray]]:
    """Yield for each size of cubes, from single voxels up, the edge, [voxels], and two masks of the cubes.

    The first mask is True for cubes that hold no smaller cube (whole), the second for cubes that are part of a larger
    one (joined). Cubes of the octree are whole and not joined (single). Masks have one more place on each side; places
    outside the octree count as single voxels.
    """
    whole = np.ones([n + 2 for n in shape], dtype=bool)
    for number in range(len(octree) + 1):
        joined = np.zeros_like(whole)
        if number < len(octree):
            inner = joined[1:-1, 1:-1, 1:-1]
            inner[...] = split_in_eight(octree[number], inner.shape)
        yield 1 << number, whole, joined
        if number < len(octree):
            whole = np.pad(octree[number], 1)


@dataclass(frozen=True)
class _Points:
    """Flat lattice indices of the points of cubes of one size, and of the corners of their faces across one axis."""

    origin: int  # flat index of the lowest corner of cube (0, 0, 0)
    per_cube: IntArray  # flat steps from a cube to the next along x, y, z
    centre: int  # flat step from a cube's lowest corner to its centre
    ahead: int  # flat step from a cube to its next neighbour along the axis
    corners: IntArray  # flat steps from a cube's lowest corner to the corners of its low face across the axis, (4,)

    @classmethod
    def around(cls, lattice: BccLattice, first: IntArray, axis: int, size: int) -> _Points:
        """Return the points of cubes of `size` voxels; cube (0, 0, 0) begins at the voxel with block index `first`."""
        strides = np.array(lattice.strides)
        per_cube = size * strides
        centre = size // 2 * strides.sum() if size > 1 else strides.sum() - lattice.num_centres
        # Centre i lies half a voxel above corner i - 1 of its block.
        origin = lattice.num_centres + (first - 1) @ strides
        corners = _CORNERS @ np.roll(per_cube, -axis)
        return cls(int(origin), per_cube, int(centre), int(per_cube[axis]), corners)

    def of(self, cubes: IntArray) -> IntArray:
        """Return the flat indices (n,) of the lowest corners of cubes with the indices `cubes`, shape (n, 3)."""
        return self.origin + cubes @ self.per_cube


def _between_equals(whole: BoolArray, single: BoolArray, axis: int, points: _Points) -> Iterator[IntArray]:
    """Yield the tetrahedra (t, 4) between each two neighbours along the axis that are both True in `single`."""
    two, ahead = [1, 1, 1], [0, 0, 0]  # a box of a cube and the next along the axis
    two[axis], ahead[axis] = 2, -1
    pairs, whole = (shrink(mask, tuple(two), tuple(ahead)) for mask in (single, whole))
    pair = np.flatnonzero(pairs)
    lowest = points.of(np.stack(np.unravel_index(pair, pairs.shape), axis=-1) - 1)
    steps = np.array([pairs.shape[1] * pairs.shape[2], pairs.shape[2], 1])
    aside = _OUTWARD @ np.roll(steps, -axis)
    centres = [points.centre, points.centre + points.ahead]
    corners = points.corners + points.ahead
    for side, (a, b) in enumerate(zip(corners, np.roll(corners, -1))):
        # A pair of cubes beside this side of the face that is not whole has cubes of half the size along the side.
        is_plain = whole.reshape(-1)[pair + aside[side]]
        middle = (a + b) // 2
        for which, tet in (
            (is_plain, [*centres, a, b]),
            (~is_plain, [*centres, a, middle]),
            (~is_plain, [*centres, middle, b]),
        ):
            yield lowest[which, None] + np.array(tet)


def _between_sizes(single: BoolArray, joined: BoolArray, axis: int, points: _Points) -> Iterator[IntArray]:
    """Yield the tetrahedra (t, 4) between each single cube and a larger cube before or after it along the axis."""
    for larger_ahead in (True, False):
        # No cube at the border of the mask is joined, so that nothing comes in from the other end.
        cube = np.argwhere(single & np.roll(joined, -1 if larger_ahead else 1, axis)) - 1
        lowest = points.of(cube)
        is_high = np.roll(cube, -axis, axis=1)[:, 1:] & 1
        face = points.corners + (points.ahead if larger_ahead else 0)
        beyond = points.ahead if larger_ahead else -points.ahead
        for number in range(4):
            # Of two small cubes beside one larger face, the lower one has the middle of this face at its high side.
            here = lowest[np.all(is_high == 1 - _CORNERS[number, 1:], axis=1), None]
            middle, first, opposite, last = np.roll(face, -number)
            below, above = (points.centre, middle + beyond) if larger_ahead else (middle + beyond, points.centre)
            for a, b, c in ((middle, first, opposite), (middle, opposite, last)):
                yield here + np.array([a, b, c, above])
                yield here + np.array([a, c, b, below])
