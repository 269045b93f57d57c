"""The lattice of voxels and their corners: the only module that converts between indices and world positions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import check_array
from thermoxels_ns.core.errors import CheckpointError, ThermoxelsError

CORNER_OFFSETS: IntArray = np.array(
    [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1], [1, 0, 0], [1, 0, 1], [1, 1, 0], [1, 1, 1]], dtype=np.int64
)
"""Offsets of a voxel's eight corners from its lowest corner, shape (8, 3); the last axis varies fastest (C order)."""


@dataclass(frozen=True)
class Lattice:
    """A regular lattice of cubic voxels with values on their corners.

    Corner (i, j, k) is at ``lo + (i, j, k) * voxel_size``; N corners along an axis span N - 1 voxels. The flat index of
    a corner is ``(i * ny + j) * nz + k`` (C order). For a cell (a voxel), `cell_shape` takes the place of `shape`.
    """

    lo: tuple[float, float, float]  # World position of corner (0, 0, 0)
    voxel_size: float  # Edge length of a voxel, [world units]
    shape: tuple[int, int, int]  # Number of corners along x, y, z; at least 2 each

    def __post_init__(self) -> None:
        assert all(map(math.isfinite, (*self.lo, self.voxel_size))) and self.voxel_size > 0, self
        assert len(self.shape) == 3 and min(self.shape) >= 2, self

    @classmethod
    def covering(cls, box_lo: npt.ArrayLike, box_hi: npt.ArrayLike, resolution: int) -> Lattice:
        """Return the lattice that covers a box with `resolution` voxels along its longest side.

        A shorter side gets the fewest voxels that cover it; they exceed the box by the same length at both ends.
        Raises `ThermoxelsError` unless all sides are finite and above 0 and `resolution` is at least 1.

        >>> Lattice.covering((0, 0, 0), (2, 1, 0.9), 4)
        Lattice(lo=(0.0, 0.0, -0.05), voxel_size=0.5, shape=(5, 3, 3))
        """
        lo, hi = np.asarray(box_lo, dtype=np.float64), np.asarray(box_hi, dtype=np.float64)
        size = hi - lo
        if resolution < 1 or not np.all(np.isfinite(size)) or not np.all(size > 0):
            expected = "three finite sides longer than 0 and a resolution of at least 1"
            got = f"sides {size.tolist()}, resolution {resolution}"
            remedy = "Correct the scene box or the camera poses it comes from."
            raise ThermoxelsError("scene box", expected=expected, got=got, remedy=remedy)
        h = float(size.max()) / resolution
        cells = np.maximum(np.ceil(size / h - 1e-6).astype(int), 1)
        start = np.round(0.5 * (lo + hi) - 0.5 * cells * h, 12)
        return cls(tuple(start.tolist()), h, tuple((cells + 1).tolist()))

    def refined(self, factor: int) -> Lattice:
        """Return the lattice with every voxel split into `factor`^3 voxels; its corners include all old corners."""
        nx, ny, nz = ((n - 1) * factor + 1 for n in self.shape)
        return Lattice(self.lo, self.voxel_size / factor, (nx, ny, nz))

    @property
    def hi(self) -> tuple[float, float, float]:
        """World position of the last corner, with the highest indices."""
        x, y, z = self.index_to_world(np.array(self.shape) - 1).tolist()
        return (x, y, z)

    @property
    def cell_shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y, z."""
        nx, ny, nz = self.shape
        return (nx - 1, ny - 1, nz - 1)

    @property
    def num_corners(self) -> int:
        """Number of corners."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    def index_to_world(self, index: npt.ArrayLike) -> FloatArray:
        """Return the world positions (..., 3) of corner indices (..., 3), which may be fractional."""
        return np.asarray(self.lo) + np.asarray(index, dtype=np.float64) * self.voxel_size

    def world_to_index(self, point: npt.ArrayLike) -> FloatArray:
        """Return the fractional corner indices (..., 3) of world positions (..., 3)."""
        return (np.asarray(point, dtype=np.float64) - np.asarray(self.lo)) / self.voxel_size

    def corner_positions(self) -> FloatArray:
        """Return the world positions of all corners, shape (nx, ny, nz, 3)."""
        return self.index_to_world(np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1))

    def cell_centres(self) -> FloatArray:
        """Return the world positions of all voxel centres, shape (nx-1, ny-1, nz-1, 3)."""
        cells = np.stack(np.meshgrid(*map(np.arange, self.cell_shape), indexing="ij"), axis=-1)
        return self.index_to_world(cells + 0.5)


def input_from_world(transform: npt.ArrayLike, scale: float) -> FloatArray:
    """Return the matrix (4, 4) that maps world points to input points: the inverse of p = scale * (R p_input + t).

    `transform` is [R | t], (3, 4). Raises `CheckpointError` unless R is orthonormal and `scale` is above 0.

    >>> input_from_world([[1, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0]], 2.0) @ [12, 0, 4, 1]
    array([1., 0., 2., 1.])
    """
    remedy = "The checkpoint's dataparser is damaged; train again."
    matrix = check_array("dataparser_transform", np.asarray(transform, np.float64), (3, 4), remedy, CheckpointError)
    rotation, shift = matrix[:, :3], matrix[:, 3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not (orthonormal and np.isfinite(scale) and scale > 0):
        expected, got = "a rotation and a scale above 0", f"{matrix.tolist()}, scale {scale}"
        raise CheckpointError("dataparser_transform", expected=expected, got=got, remedy=remedy)
    inverse = np.eye(4)
    inverse[:3, :3] = np.linalg.inv(rotation) / scale
    inverse[:3, 3] = -np.linalg.inv(rotation) @ shift
    return inverse
