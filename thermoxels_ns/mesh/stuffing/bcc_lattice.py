"""The body-centred cubic lattice of isosurface stuffing: its points, edges and levels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.mesh.solid.morphology import bounding_box

_AXES = np.eye(3)[[0, 0, 1, 1, 2, 2]] * np.array([1.0, -1.0] * 3)[:, None]
_DIAGONALS = (np.arange(8)[:, None] >> np.array([2, 1, 0]) & 1) - 0.5

DIRECTIONS: FloatArray = np.concatenate([_AXES, _DIAGONALS])
"""Steps to the 14 neighbours, shape (14, 3), [voxels]: +x, -x, +y, -y, +z, -z, then the diagonals (---) to (+++)."""
LENGTHS: FloatArray = np.linalg.norm(DIRECTIONS, axis=1)  # lengths of the 14 edges, [voxels]
OPPOSITE: IntArray = np.array([1, 0, 3, 2, 5, 4, 13, 12, 11, 10, 9, 8, 7, 6])
"""Number of the direction that points the other way, shape (14,)."""
NUM_DIRECTIONS = 14

_OUTSIDE = -1.0


@dataclass(frozen=True)
class BccLattice:
    """Levels on the points of the lattice around the solid part of a voxel lattice.

    It is two cubic lattices, one voxel apart each: the voxel centres and, shifted by half a voxel along every axis, the
    voxel corners. A point has 14 neighbours: six of its own lattice along the axes (long edges, 1 voxel) and eight of
    the other one along the space diagonals (short edges, sqrt(3)/2 voxels). The edges cut space into congruent
    tetrahedra; each has one long edge of each lattice, opposite each other.

    All points lie in one flat array: first the centres, then the corners, both padded to the same shape, so that a step
    along an edge is a constant offset of the flat index.
    """

    level: npt.NDArray[np.floating]
    """Level of every point: the padded centres, then the padded corners; above 0 is solid. Points above 0 have all
    their neighbours in the array and lie strictly inside the box."""
    shape: tuple[int, int, int]  # shape of each of the two padded blocks
    first_cell: IntArray  # index of the voxel whose centre has index (1, 1, 1) in its block

    @property
    def num_centres(self) -> int:
        """Points in the block of centres; flat indices from here on are corners."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    @property
    def strides(self) -> tuple[int, int, int]:
        """Flat steps along x, y, z within a block."""
        return (self.shape[1] * self.shape[2], self.shape[2], 1)

    @cached_property
    def offsets(self) -> IntArray:
        """Flat steps to the 14 neighbours, of a centre and of a corner, shape (2, 14)."""
        strides = np.array(self.strides)
        along = DIRECTIONS[:6].astype(np.int64) @ strides
        # Centre i lies half a voxel below corner i of its block.
        to_corner = np.where(_DIAGONALS > 0.0, 0, -1) @ strides + self.num_centres
        to_centre = np.where(_DIAGONALS > 0.0, 1, 0) @ strides - self.num_centres
        return np.stack([np.concatenate([along, to_corner]), np.concatenate([along, to_centre])])

    def is_corner(self, points: IntArray) -> IntArray:
        """1 for voxel corners, 0 for voxel centres; same shape as `points`."""
        return (points >= self.num_centres).astype(np.int64)

    def neighbours(self, points: IntArray) -> IntArray:
        """Flat indices of the 14 neighbours, shape (n, 14)."""
        return points[:, None] + self.offsets[self.is_corner(points)]

    def each_neighbour(self, points: IntArray) -> Iterator[IntArray]:
        """Flat indices of one neighbour of every point, shape (n,), for each of the 14 directions in turn."""
        corner = self.is_corner(points)
        for step in self.offsets.T:
            yield points + step[corner]

    def block_index(self, points: IntArray) -> IntArray:
        """Index along x, y, z within the point's block, shape (n, 3)."""
        within = points - self.is_corner(points) * self.num_centres
        return np.stack(np.unravel_index(within, self.shape), axis=-1)

    def positions(self, points: IntArray) -> FloatArray:
        """Fractional corner indices of the points in the whole voxel lattice, shape (n, 3)."""
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
    blocks = np.full((2, nx, ny, nz), _OUTSIDE, dtype=level.dtype)
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
