"""How far a surface with holes surrounds a place: the generalised winding number, from one potential problem."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import numpy.typing as npt
from scipy import fft

BoolArray = npt.NDArray[np.bool_]

_fast_length = cast(Callable[[int], int], fft.next_fast_len)

MARGIN = 0.25
"""The potential is zero this share of the lattice's size beyond it, on each side."""


def winding_number(solid: BoolArray, air: BoolArray) -> npt.NDArray[np.float32]:
    """Find how far the voxel faces between solid and air surround each voxel, those faces taken from their back.

    It is 1 within a closed surface and 0 outside of it. Where the surface has a hole, it goes from one to the other
    smoothly, and one half is a film across the hole; before a surface that is open it may be below 0. Faces with solid
    on both sides, or next to voxels that are neither, are no surface; the two sides of a leaf cancel from afar. For
    surfaces given as triangles: Jacobson, Kavan and Sorkine-Hornung 2013, Robust inside-outside segmentation using
    generalized winding numbers, equation 5. Here it is the function that jumps by one across the surface and is
    harmonic elsewhere, solved for with sine transforms in blocks of 2^3 voxels: Lap w = div J, where J holds the jumps.

    Args:
        solid: Voxels behind the surface, shape (nx, ny, nz).
        air: Voxels before it, of the same shape; none of them is solid.

    Returns:
        The winding number, shape (nx, ny, nz); all voxels of a block have the same.
    """
    shape = solid.shape
    # Lengths for which the transforms are fast, with the lattice about in the middle.
    blocks = [_fast_length(int(np.ceil((0.5 + MARGIN) * n)) + 3) - 1 for n in shape]
    before = [(count - (n + 1) // 2) // 2 for count, n in zip(blocks, shape)]
    pads = [(2 * b, 2 * count - n - 2 * b) for b, count, n in zip(before, blocks, shape)]
    side = np.pad(solid.astype(np.int8) - air.astype(np.int8), pads)
    sources = np.zeros(blocks, dtype=np.float32)
    for axis in range(3):
        jumps = _jumps(side, axis)
        near, far = [slice(None)] * 3, [slice(None)] * 3
        near[axis], far[axis] = slice(None, -1), slice(1, None)
        sources += jumps
        sources[tuple(far)] -= jumps[tuple(near)]
    waves = np.asarray(fft.dstn(sources, type=1, overwrite_x=True), dtype=np.float32)
    stiffness = [2.0 - 2.0 * np.cos(np.pi * np.arange(1, n + 1) / (n + 1)) for n in blocks]
    waves /= np.add.outer(np.add.outer(stiffness[0], stiffness[1]), stiffness[2]).astype(np.float32)
    winding = np.asarray(fft.idstn(waves, type=1, overwrite_x=True), dtype=np.float32)
    winding = winding[tuple(slice(b, b + (n + 1) // 2) for b, n in zip(before, shape))]
    for axis in range(3):
        winding = np.repeat(winding, 2, axis=axis)
    return winding[tuple(slice(n) for n in shape)]


def _jumps(side: npt.NDArray[np.int8], axis: int) -> npt.NDArray[np.float32]:
    """Jump from each block to the next along an axis: 1 where all faces are solid before air, -1 if air before solid.

    A face in the middle of a block counts half at each of the block's ends.
    """
    near, far = [slice(None)] * 3, [slice(None)] * 3
    near[axis], far[axis] = slice(None, -1), slice(1, None)
    first, second = side[tuple(near)], side[tuple(far)]
    jump = np.zeros_like(side)
    jump[tuple(near)] = np.where(first * second == -1, first, 0)
    nx, ny, nz = (n // 2 for n in side.shape)
    others = tuple(2 * other + 1 for other in range(3) if other != axis)
    pairs = jump.reshape(nx, 2, ny, 2, nz, 2).sum(axis=others, dtype=np.float32) * np.float32(0.25)
    middle, end = np.moveaxis(pairs, axis + 1, 0)
    total = end + 0.5 * middle
    total[tuple(near)] += 0.5 * middle[tuple(far)]
    return total
