"""The inside of a stuffed solid: an octree of larger and larger cubes as tetrahedra."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, IntArray
from thermoxels_ns.mesh.solid.morphology import bounding_box, grow, halved, repeated
from thermoxels_ns.mesh.stuffing.lattice import BccLattice

# The sides of a face lie between its corners 0-1, 1-2, 2-3 and 3-0, counter-clockwise seen from where its axis points.
_CORNERS = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]])
_OUTWARD = np.array([[0, 0, -1], [0, 1, 0], [0, 0, 1], [0, -1, 0]])


def eroded(cells: BoolArray, by: int) -> BoolArray:
    """Keep the voxels with nothing but voxels of the set in the cube of 2 `by` + 1 voxels around them.

    What lies beyond the array is not in the set.

    >>> np.count_nonzero(eroded(np.ones((5, 5, 5), dtype=bool), 1))
    27
    """
    grown = grow(np.pad(~cells, by, constant_values=True), by)
    return ~grown[by:-by, by:-by, by:-by]


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
        halves = whole if size == 1 else eroded(whole, 1)
        whole = halved(halves, np.logical_and)
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
    tets: IntArray
    """Flat lattice indices, shape (t, 4), positively oriented: everything that the larger cubes share a face with."""

    def buried(self, lattice: BccLattice) -> BoolArray:
        """True for points of the lattice around which there are only voxels in larger cubes: all but `tets` miss them.

        They and all their neighbours are inside the solid, and none of these neighbours is moved or has a cut.
        """
        corners = self.covered.reshape(lattice.shape).copy()
        for axis in range(3):
            row = np.moveaxis(corners, axis, 0)
            row[:-1] &= row[1:]
        return np.concatenate([self.covered, corners.reshape(-1)])


def coarse_interior(lattice: BccLattice, largest: int) -> CoarseInterior | None:
    """Build the inside of a solid from cubes of two to `largest` voxels; None if there are no such cubes.

    Every cube has nodes at its centre and its corners, points of the body-centred cubic lattice. Between two neighbours
    of the same size lie four tetrahedra, one for each side of their common face, around the edge that joins the
    centres; where smaller cubes touch a side it has a node in the middle, and its tetrahedron is cut in two there.
    Between two of different sizes lies the face of the smaller: the diagonal through the middle of the larger face cuts
    it into two triangles, and each makes a tetrahedron with either centre (Labelle and Shewchuk 2007). The octree
    begins at the lowest voxel that may be joined, so the solid's place in the lattice does not matter.
    """
    if largest == 1:
        return None
    deep = _far_from_surface(lattice)
    if not deep.any():
        return None
    box = bounding_box(deep)
    first = np.array([part.start for part in box])
    octree = balanced_octree(deep[box], largest)
    if not octree:
        return None
    covered = np.zeros(lattice.shape, dtype=bool)
    covered[box] = split_in_eight(octree[0], deep[box].shape)

    tets = []
    for cubes in _each_size(octree, deep[box].shape):
        for axis in range(3):
            points = _Points.around(lattice, first, axis, cubes.size)
            if cubes.size > 1:
                tets += _between_equals(cubes, axis, points)
            tets += _between_sizes(cubes, axis, points)
    return CoarseInterior(covered.reshape(-1), np.concatenate(tets))


def _far_from_surface(lattice: BccLattice) -> BoolArray:
    """Voxels on whose six faces no bundle has a point that moves or an edge with a cut; as the block of centres."""
    # A point of a cut edge has a neighbour outside. So the voxel's centre and corners and the centres next to it must
    # be inside, and no neighbour of these points outside: no centre next to a centre next to it, no corner of a voxel
    # next to it, and no centre at one of its own corners.
    centres, corners = lattice.level.reshape(2, *lattice.shape)
    inside = centres > 0.0
    deep = _with_next(_with_next(inside))
    if not deep.any():
        return deep
    deep &= eroded(inside, 1)
    deep &= _with_next(_at_all_corners(corners >= 0.0))
    deep &= _at_all_corners(corners > 0.0)
    return deep


def _with_next(centres: BoolArray) -> BoolArray:
    """True where a centre and the six next to it are in the set; nothing beyond the array is."""
    found = np.zeros_like(centres)
    inner = found[1:-1, 1:-1, 1:-1]
    inner[...] = centres[1:-1, 1:-1, 1:-1]
    for axis in range(3):
        row = np.moveaxis(centres, axis, 0)
        across = np.moveaxis(row[2:] & row[:-2], 0, axis)
        inner &= across[tuple(slice(None) if a == axis else slice(1, -1) for a in range(3))]
    return found


def _at_all_corners(corners: BoolArray) -> BoolArray:
    """True for the centres whose eight corners are in the set."""
    found = np.zeros_like(corners)
    for axis in range(3):
        row = np.moveaxis(corners, axis, 0)
        corners = np.moveaxis(row[1:] & row[:-1], 0, axis)
    found[1:, 1:, 1:] = corners
    return found


@dataclass(frozen=True)
class _Cubes:
    """The cubes of one size, in arrays with one more cube on each side."""

    size: int  # edge of a cube, [voxels]
    whole: BoolArray  # True where nothing inside the cube is smaller
    joined: BoolArray
    """True where the cube is part of a larger one, which is twice as large wherever a single one touches it."""
    single: BoolArray  # True where the cube is one of the octree: whole, but not joined


def _each_size(octree: tuple[BoolArray, ...], shape: tuple[int, ...]) -> Iterator[_Cubes]:
    """The cubes of every size, voxels first; those beyond the octree are single voxels."""
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
        """Cubes of `size` voxels; the first of them begins at the centre `first` of the lattice."""
        strides = np.array(lattice.strides)
        per_cube = size * strides
        centre = size // 2 * strides.sum() if size > 1 else strides.sum() - lattice.num_centres
        # Centre i lies half a voxel above corner i - 1 of its block.
        origin = lattice.num_centres + (first - 1) @ strides
        corners = _CORNERS @ np.roll(per_cube, -axis)
        return cls(int(origin), per_cube, int(centre), int(per_cube[axis]), corners)

    def of(self, cubes: IntArray) -> IntArray:
        """Flat indices of the lowest corners of cubes, given by their indices, shape (n, 3)."""
        return self.origin + cubes @ self.per_cube


def _between_equals(cubes: _Cubes, axis: int, points: _Points) -> Iterator[IntArray]:
    """Tetrahedra between each cube and the one ahead, if both are single."""
    pairs, whole = (_both(mask, axis) for mask in (cubes.single, cubes.whole))
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
    """Tetrahedra between each single cube and a larger one, ahead of it or behind it."""
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


def _both(mask: BoolArray, axis: int) -> BoolArray:
    """True where a cube and the one ahead are in the set."""
    both = mask.copy()
    row = np.moveaxis(both, axis, 0)
    row[:-1] &= row[1:]
    row[-1] = False
    return both
