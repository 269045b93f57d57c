"""The body-centred cubic lattice of isosurface stuffing, which of its points move, and the cubes of its inside."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.mesh.solid.morphology import bounding_box, repeated, shrink

_AXES = np.eye(3)[[0, 0, 1, 1, 2, 2]] * np.array([1.0, -1.0] * 3)[:, None]
_DIAGONALS = (np.arange(8)[:, None] >> np.array([2, 1, 0]) & 1) - 0.5

DIRECTIONS: FloatArray = np.concatenate([_AXES, _DIAGONALS])
"""Steps to the 14 neighbours, shape (14, 3), [voxels]: +x, -x, +y, -y, +z, -z, then the diagonals (---) to (+++)."""
LENGTHS: FloatArray = np.linalg.norm(DIRECTIONS, axis=1)  # lengths of the 14 edges, [voxels]
OPPOSITE: IntArray = np.array([1, 0, 3, 2, 5, 4, 13, 12, 11, 10, 9, 8, 7, 6])
"""Number of the direction that points the other way, shape (14,)."""


@dataclass(frozen=True)
class BccLattice:
    """Levels on the points of the lattice around the solid part of a voxel lattice.

    The voxel centres and the voxel corners are a cubic lattice each. A point has 14 neighbours: six of its own lattice
    along the axes (long edges, 1 voxel) and eight of the other one along the space diagonals (short edges, sqrt(3)/2
    voxels). All points lie in one flat array, first the centres, then the corners, both padded to the same shape, so
    that a step along an edge is a constant offset of the flat index.
    """

    level: npt.NDArray[np.floating]  # level of every point; above 0 is solid, strictly inside of the array and the box
    shape: tuple[int, int, int]  # shape of each of the two padded blocks
    first_cell: IntArray  # index of the voxel whose centre has index (1, 1, 1) in its block

    @property
    def num_centres(self) -> int:
        """Return the number of points in the block of centres; flat indices from here on are corners."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    @property
    def strides(self) -> tuple[int, int, int]:
        """Return the flat steps along x, y, z within a block."""
        return (self.shape[1] * self.shape[2], self.shape[2], 1)

    @cached_property
    def offsets(self) -> IntArray:
        """Return the flat steps to the 14 neighbours, of a centre and of a corner, shape (2, 14)."""
        strides = np.array(self.strides)
        along = DIRECTIONS[:6].astype(np.int64) @ strides
        # Centre i lies half a voxel below corner i of its block.
        to_corner = np.where(_DIAGONALS > 0.0, 0, -1) @ strides + self.num_centres
        to_centre = np.where(_DIAGONALS > 0.0, 1, 0) @ strides - self.num_centres
        return np.stack([np.concatenate([along, to_corner]), np.concatenate([along, to_centre])])

    def is_corner(self, points: IntArray) -> IntArray:
        """Return 1 for voxel corners, 0 for voxel centres; same shape as `points`."""
        return (points >= self.num_centres).astype(np.int64)

    def neighbours(self, points: IntArray) -> IntArray:
        """Return the flat indices of the 14 neighbours, shape (n, 14)."""
        return points[:, None] + self.offsets[self.is_corner(points)]

    def each_neighbour(self, points: IntArray) -> Iterator[IntArray]:
        """Yield the flat indices of one neighbour of every point, shape (n,), for each of the 14 directions."""
        corner = self.is_corner(points)
        for step in self.offsets.T:
            yield points + step[corner]

    def block_index(self, points: IntArray) -> IntArray:
        """Return the index along x, y, z within the point's block, shape (n, 3)."""
        within = points - self.is_corner(points) * self.num_centres
        return np.stack(np.unravel_index(within, self.shape), axis=-1)

    def positions(self, points: IntArray) -> FloatArray:
        """Return the fractional corner indices of points in the whole voxel lattice, shape (n, 3)."""
        shift = self.first_cell + 0.5 * self.is_corner(points)[:, None] - 0.5
        return self.block_index(points) + shift


def bcc_lattice(level: npt.NDArray[np.floating]) -> BccLattice:
    """Put levels of voxel centres, above 0 somewhere, on the lattice and close it where the solid touches the border.

    A corner gets the mean of the eight centres around it, which is the trilinear value, or 0 where that would break a
    layer of one voxel. Beyond the border every centre has the level -|level| of the centre inside, and corners on the
    border are at most 0: linear interpolation is then 0 exactly on the border where solid touches it, and nothing above
    0 lies on the border or beyond. What is farther than two voxels from all solid voxels is left out.
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

    # Halved before each sum: the sum of two levels may be too large for the number type, their mean is not.
    mean = 0.5 * np.pad(inner, 1, mode="edge")
    for axis in range(3):
        mean = np.moveaxis(mean, axis, 0)
        mean = np.moveaxis(mean[1:] + mean[:-1], 0, axis)
        if axis < 2:
            mean *= 0.5
    for axis in range(3):
        border = np.moveaxis(mean, axis, 0)[[0, -1]]
        np.moveaxis(mean, axis, 0)[[0, -1]] = np.minimum(border, 0.0)
    corners[:-1, :-1, :-1] = mean
    _keep_sheets(centres, corners)
    return BccLattice(blocks.reshape(-1), (nx, ny, nz), first)


def _keep_sheets(centres: npt.NDArray[np.floating], corners: npt.NDArray[np.floating]) -> None:
    """Raise corners to 0 where a solid layer of one voxel would have holes, and lower them where a gap of one would.

    The middle of a square of four solid centres is solid too, but no point of the lattice: it is on the long edge
    between the corners above and below. If neither of them is above 0, the square is a hole, unless both are 0.
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
"""Share of each of the 14 edges within which a cut pulls a point inside the solid onto the surface."""
ALPHA_OUTSIDE = np.where(LENGTHS == 1.0, 0.282, 0.369)
"""The same for a point outside.

With these four numbers all dihedral angles are between 10.94 and 163.74 degrees: the extremes over all stencils, with
every cut and every moved point at every end of its range. Labelle and Shewchuk (2007) give one pair for both sides.
"""


def _contractible_links() -> BoolArray:
    """Tell for every set of neighbours, as 14 bits, whether the lattice between them is one piece without holes."""
    # The neighbours of a point span a sphere of 24 triangles. A part of a sphere can be shrunk to a point if neither it
    # nor the rest of the sphere is empty or in several pieces.
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
    """The lattice with its near points moved onto the surface, and the cuts that are left."""

    sign: npt.NDArray[np.int8]  # +1 inside the solid, 0 on its surface, -1 outside, one per point of the lattice
    moved: IntArray  # points that moved, shape (m,)
    moved_to: FloatArray  # where they are now, fractional corner indices, shape (m, 3)
    inner: IntArray  # points with sign +1 that are not buried, ascending; shape (p,)
    cut_points: IntArray  # those of them that have a cut edge, ascending; shape (s,)
    cuts: FloatArray
    """How far along each of their edges the surface is, as a share of the edge, NaN where no cut is; shape (s, 14)."""


def warp(lattice: BccLattice, buried: BoolArray) -> WarpedLattice:
    """Find where the surface cuts edges, and move points that are too close to a cut onto the surface.

    A cut is where linear interpolation along an edge between two opposite signs is 0. A point with cuts within alpha
    times the edge length moves to the nearest of them and has sign 0 from then on; its edges are cut no more (Labelle
    and Shewchuk 2007, section 3). `buried` points and all their neighbours are inside.

    Beyond the paper, nothing thin is lost: a point stays if the solid is not on its other side, seen from the cut, or
    if the solid (for a point outside: the empty space) would fall apart, close up or vanish with it. Its cuts are then
    held at alpha times the edge length, which the bounds on the angles allow.
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
    # Points inside with a neighbour outside, and points outside with one inside.
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
        # Taking a point away leaves the topology as it is if its neighbours of the same sign can be shrunk to a point.
        # No two points of one of the four classes (centre or corner, even or odd sum of indices) are neighbours, so
        # each class may be decided at once.
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
    """Return the share of each edge from the point to its cut, infinite where none is; shape (n, 14)."""
    neighbours = lattice.neighbours(points)
    own = lattice.level[points].astype(np.float64)
    other = lattice.level[neighbours].astype(np.float64)
    # Where levels differ by more than the number type holds, the ratio is infinite and the cut at the point: right.
    with np.errstate(over="ignore", divide="ignore"):
        share = 1.0 / (1.0 - other / own[:, None])
    share[sign[neighbours] != -sign[points][:, None]] = np.inf
    return share


# The sides of a face lie between its corners 0-1, 1-2, 2-3 and 3-0, counter-clockwise seen from where its axis points.
_CORNERS = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]])
_OUTWARD = np.array([[0, 0, -1], [0, 1, 0], [0, 0, 1], [0, -1, 0]])


def balanced_octree(cells: BoolArray, largest: int) -> tuple[BoolArray, ...]:
    """Join voxels into cubes of 2, 4, 8, ... `largest` voxels along an edge that only hold voxels of the set.

    Cube (i, j, k) of edge s begins at voxel (i s, j s, k s). Cubes that touch, if only at a corner, differ at most by
    a factor 2 in size; voxels outside the set count as cubes of one voxel. Under these rules every cube is as large as
    it can be. Entry n of the result is for cubes of 2^(n + 1) voxels along an edge: True where nothing is smaller.

    >>> [np.count_nonzero(level) for level in balanced_octree(np.ones((12, 12, 12), dtype=bool), 8)]
    [216, 1]
    """
    levels: list[BoolArray] = []
    size, whole = 1, cells
    while size < largest:
        # A cube of one voxel touches any cube of two; larger ones need neighbours of at least half their size.
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
    """Give each of the eight halves of a cube its value, and cut the array to the shape of the level below."""
    return repeated(level, 2)[tuple(slice(n) for n in shape)]


@dataclass(frozen=True)
class CoarseInterior:
    """Tetrahedra that take the place of those of the uniform lattice inside a solid."""

    covered: BoolArray  # True for the centres of voxels inside a larger cube, in the order of the lattice's centres
    tets: IntArray  # flat lattice indices, shape (t, 4), positively oriented: all that larger cubes share a face with

    def buried(self, lattice: BccLattice) -> BoolArray:
        """Return True for points of the lattice around which there are only voxels in larger cubes.

        They and all their neighbours are inside the solid, and none of these neighbours is moved or has a cut.
        """
        corners = shrink(self.covered.reshape(lattice.shape), 2, -1)
        return np.concatenate([self.covered, corners.reshape(-1)])


def coarse_interior(lattice: BccLattice, largest: int) -> CoarseInterior:
    """Build the inside of a solid from cubes of two to `largest` voxels, where there is room for them.

    Every cube has nodes at its centre and its corners, points of the body-centred cubic lattice. Between two neighbours
    of the same size lie four tetrahedra, one for each side of their common face, around the edge that joins the
    centres; where smaller cubes touch a side it has a node in the middle, and its tetrahedron is cut in two there.
    Between two of different sizes lies the face of the smaller: the diagonal through the middle of the larger face cuts
    it into two triangles, and each makes a tetrahedron with either centre (Labelle and Shewchuk 2007). The octree
    begins at the lowest voxel that may be joined, so the solid's place in the lattice does not matter.
    """
    deep = _far_from_surface(lattice)
    box = bounding_box(deep)
    first = np.array([part.start for part in box])
    octree = balanced_octree(deep[box], largest)
    covered, tets = np.zeros(lattice.shape, dtype=bool), [np.zeros((0, 4), dtype=np.int64)]
    if octree:
        covered[box] = split_in_eight(octree[0], deep[box].shape)
    for cubes in _each_size(octree, deep[box].shape) if octree else ():
        for axis in range(3):
            points = _Points.around(lattice, first, axis, cubes.size)
            if cubes.size > 1:
                tets += _between_equals(cubes, axis, points)
            tets += _between_sizes(cubes, axis, points)
    return CoarseInterior(covered.reshape(-1), np.concatenate(tets))


def _far_from_surface(lattice: BccLattice) -> BoolArray:
    """Return the voxels on whose faces no bundle has a point that moves or an edge with a cut; as block of centres."""
    # A point of a cut edge has a neighbour outside. So the voxel's centre and corners and the centres next to it must
    # be inside, and no neighbour of these points outside: no centre next to a centre next to it, no corner of a voxel
    # next to it, and no centre at one of its own corners.
    centres, corners = lattice.level.reshape(2, *lattice.shape)
    inside = centres > 0.0
    deep = shrink(inside, 3) & shrink(corners > 0.0, 2)
    deep &= np.asarray(ndimage.binary_erosion(inside, iterations=2), dtype=bool)
    return deep & np.asarray(ndimage.binary_erosion(shrink(corners >= 0.0, 2)), dtype=bool)


@dataclass(frozen=True)
class _Cubes:
    """The cubes of one size, in arrays with one more cube on each side."""

    size: int  # edge of a cube, [voxels]
    whole: BoolArray  # True where nothing inside the cube is smaller
    joined: BoolArray  # True where the cube is part of a larger one, twice as large wherever a single one touches it
    single: BoolArray  # True where the cube is one of the octree: whole, but not joined


def _each_size(octree: tuple[BoolArray, ...], shape: tuple[int, ...]) -> Iterator[_Cubes]:
    """Yield the cubes of every size, voxels first; those beyond the octree are single voxels."""
    whole = np.ones([n + 2 for n in shape], dtype=bool)
    for number in range(len(octree) + 1):
        joined = np.zeros_like(whole)
        if number < len(octree):
            inner = joined[1:-1, 1:-1, 1:-1]
            inner[...] = split_in_eight(octree[number], inner.shape)
        yield _Cubes(1 << number, whole, joined, whole & ~joined)
        if number < len(octree):
            whole = np.pad(octree[number], 1)


@dataclass(frozen=True)
class _Points:
    """Where in the lattice the points of cubes of one size are, and those of their faces across one axis."""

    origin: int  # flat index of the lowest corner of cube (0, 0, 0)
    per_cube: IntArray  # flat steps from a cube to the next along x, y, z
    centre: int  # flat step from a cube's lowest corner to its centre
    ahead: int  # flat step from a cube to the one ahead: one edge along the axis
    corners: IntArray  # flat steps from a cube's lowest corner to the corners of the face behind, shape (4,)

    @classmethod
    def around(cls, lattice: BccLattice, first: IntArray, axis: int, size: int) -> _Points:
        """Make it for cubes of `size` voxels; the first of them begins at the centre `first` of the lattice."""
        strides = np.array(lattice.strides)
        per_cube = size * strides
        centre = size // 2 * strides.sum() if size > 1 else strides.sum() - lattice.num_centres
        # Centre i lies half a voxel above corner i - 1 of its block.
        origin = lattice.num_centres + (first - 1) @ strides
        corners = _CORNERS @ np.roll(per_cube, -axis)
        return cls(int(origin), per_cube, int(centre), int(per_cube[axis]), corners)

    def of(self, cubes: IntArray) -> IntArray:
        """Return the flat indices of the lowest corners of cubes, given by their indices, shape (n, 3)."""
        return self.origin + cubes @ self.per_cube


def _between_equals(cubes: _Cubes, axis: int, points: _Points) -> Iterator[IntArray]:
    """Yield the tetrahedra between each cube and the one ahead, if both are single."""
    two, ahead = [1, 1, 1], [0, 0, 0]  # a cube and the one ahead
    two[axis], ahead[axis] = 2, -1
    pairs, whole = (shrink(mask, tuple(two), tuple(ahead)) for mask in (cubes.single, cubes.whole))
    pair = np.flatnonzero(pairs)
    lowest = points.of(np.stack(np.unravel_index(pair, pairs.shape), axis=-1) - 1)
    steps = np.array([pairs.shape[1] * pairs.shape[2], pairs.shape[2], 1])
    aside = _OUTWARD @ np.roll(steps, -axis)
    centres = [points.centre, points.centre + points.ahead]
    corners = points.corners + points.ahead
    for side, (a, b) in enumerate(zip(corners, np.roll(corners, -1))):
        # Pairs that are not whole on the other side of the face's side have cubes of half the size along it.
        is_plain = whole.reshape(-1)[pair + aside[side]]
        middle = (a + b) // 2
        for which, tet in (
            (is_plain, [*centres, a, b]),
            (~is_plain, [*centres, a, middle]),
            (~is_plain, [*centres, middle, b]),
        ):
            yield lowest[which, None] + np.array(tet)


def _between_sizes(cubes: _Cubes, axis: int, points: _Points) -> Iterator[IntArray]:
    """Yield the tetrahedra between each single cube and a larger one, ahead of it or behind it."""
    single, joined = (np.moveaxis(mask, axis, 0) for mask in (cubes.single, cubes.joined))
    for larger_ahead in (True, False):
        found = np.zeros_like(cubes.single)
        if larger_ahead:
            np.moveaxis(found, axis, 0)[:-1] = single[:-1] & joined[1:]
        else:
            np.moveaxis(found, axis, 0)[1:] = single[1:] & joined[:-1]
        cube = np.argwhere(found) - 1
        lowest = points.of(cube)
        is_high = np.roll(cube, -axis, axis=1)[:, 1:] & 1
        face = points.corners + (points.ahead if larger_ahead else 0)
        beyond = points.ahead if larger_ahead else -points.ahead
        for number in range(4):
            # The low one of two cubes has the middle of the larger face at its high side.
            here = lowest[np.all(is_high == 1 - _CORNERS[number, 1:], axis=1), None]
            middle, first, opposite, last = np.roll(face, -number)
            below, above = (points.centre, middle + beyond) if larger_ahead else (middle + beyond, points.centre)
            for a, b, c in ((middle, first, opposite), (middle, opposite, last)):
                yield here + np.array([a, b, c, above])
                yield here + np.array([a, c, b, below])
