"""Octrees over a set of voxels: cubes as large as the set allows, next to cubes at most twice as large or small."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

BoolArray = npt.NDArray[np.bool_]


def eroded(cells: BoolArray, by: int) -> BoolArray:
    """Keep the voxels with nothing but voxels of the set in the cube of 2 `by` + 1 voxels around them.

    What lies beyond the array is not in the set.

    >>> np.count_nonzero(eroded(np.ones((5, 5, 5), dtype=bool), 1))
    27
    """
    for axis in range(3):
        row = np.moveaxis(cells, axis, 0)
        width, end = 1, 2 * by + 1
        # From here on an entry stands for the `width` voxels that begin with it.
        while width < end:
            step = min(width, end - width)
            row = row[:-step] & row[step:]
            width += step
        cells = np.zeros_like(cells)
        np.moveaxis(cells, axis, 0)[by : by + len(row)] = row
    return cells


def balanced_octree(cells: BoolArray, largest: int) -> tuple[BoolArray, ...]:
    """Join voxels into cubes of 2, 4, 8, ... voxels along an edge that only hold voxels of the set.

    Cube (i, j, k) of edge s begins at voxel (i s, j s, k s). Cubes that touch, if only at a corner, differ at most by
    a factor 2 in size; voxels outside the set, beyond the array too, count as cubes of one voxel. Under these rules
    every cube is as large as it can be, which no choice elsewhere can change.

    Args:
        cells: The voxels that may be joined, shape (cx, cy, cz).
        largest: No edge is longer than this, [voxels]; a power of two.

    Returns:
        Entry n is for cubes of 2^(n + 1) voxels along an edge: True where the cube is one cube or part of a larger one,
        so that nothing in it is smaller. Its shape is half that before, rounded up. Sizes without any cube are left
        out at the end.

    >>> [np.count_nonzero(level) for level in balanced_octree(np.ones((12, 12, 12), dtype=bool), 8)]
    [216, 1]
    """
    levels: list[BoolArray] = []
    size, whole = 1, cells
    while size < largest:
        # A cube of one voxel touches any cube of two; larger ones need neighbours of at least half their size.
        halves = whole if size == 1 else eroded(whole, 1)
        whole = _all_of_eight(halves)
        if not whole.any():
            break
        levels.append(whole)
        size *= 2
    return tuple(levels)


def split_in_eight(level: BoolArray, shape: tuple[int, ...]) -> BoolArray:
    """Give each of the eight halves of a cube its value, and cut the array to the shape of the level below."""
    for axis in range(3):
        level = np.repeat(level, 2, axis=axis)
    return level[tuple(slice(n) for n in shape)]


def _all_of_eight(level: BoolArray) -> BoolArray:
    level = np.pad(level, [(0, n % 2) for n in level.shape])
    for axis in range(3):
        row = np.moveaxis(level, axis, 0)
        level = np.moveaxis(row[0::2] & row[1::2], 0, axis)
    return level
