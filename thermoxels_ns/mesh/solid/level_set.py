"""The level function whose zero is the surface, on voxel centres."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, Float32Array
from thermoxels_ns.mesh.solid.morphology import bounding_box
from thermoxels_ns.mesh.solid.surface_ramp import surface_ramp
from thermoxels_ns.mesh.solid.volume_keeping import keep_volume

DEEP_QUANTILE = 0.95  # before smoothing, a voxel as dense as this quantile of the dense ones has level 1 ..
DEEP_RATIOS = (2.0, 100.0)  # ... but that density is kept within these multiples of the threshold.
LEAST_LEVEL = 0.02
"""No voxel is nearer to 0 than this before smoothing: a surface never passes through a voxel's centre."""
LEAST_SMOOTH_LEVEL = 0.005  # the same where density is a smooth ramp
LEAST_SHARE = 0.25  # smoothing leaves at least this share of a voxel's level, with its sign
MARGIN = 4  # voxels farther from the solid than this, along an axis, have level -1 without a look at their density
LEAST_SHARE_THIN = 0.5  # the same in walls and gaps one voxel thick; they keep their thickness


def level_of(
    density: npt.NDArray[np.floating],
    threshold: float,
    dense: BoolArray,
    cells: BoolArray,
    *,
    makes_up_volume: bool = True,
) -> Float32Array:
    """Give every voxel a level in [-1, 1]: above 0 in solid voxels, below 0 in empty ones, 0 on the surface between.

    Where density falls smoothly across the surface (`surface_ramp`), the level is a function of density that is linear
    in the distance there; area and volume of a body are then of second order in the voxel size.

    Trained density jumps by orders of magnitude between neighbours, mostly from exactly 0. There the level is
    s = log(density / threshold) / log(deep / threshold), at most 1, where that is above 0, and exp(s) - 1 below; deep
    is the density of the densest part of the body. So it is 0 at the threshold and -1 where there is no density: the
    logarithm keeps what density says about the place of the surface. The weights 1 2 1 along each axis, over three
    voxels, take the noise out, and the level shifts where thin or small bodies would lose volume by that
    (`keep_volume`).

    Args:
        density: At voxel centres, at least 0, [1 / world unit].
        threshold: From which on a voxel counts as dense, at least 0, same unit.
        dense: Voxels that the threshold chose.
        cells: Solid voxels. Those that are not dense were made solid on purpose and lie deep inside; dense ones that
            are not solid were removed on purpose and lie far outside.
        makes_up_volume: Whether the level shifts in thin and small bodies so that its trilinear zero holds their
            volume. Not for voxels, which hold it as they are.
    """
    level = np.full(cells.shape, -1.0, dtype=np.float32)
    near = bounding_box(cells, MARGIN)
    deep_ratio = _deep_ratio(density[dense], threshold)
    around = density[near], threshold, deep_ratio, dense[near], cells[near]
    ramp = surface_ramp(*around) if threshold > 0.0 else None
    if ramp is None:
        level[near] = _smoothed(*around, makes_up_volume)
        return level
    found = ramp.level
    if ramp.belief.min() < 1.0:
        smoothed = _smoothed(*around, makes_up_volume)
        found = smoothed + ramp.belief * (found - smoothed)
    level[near] = _signed(found, np.float32(LEAST_SMOOTH_LEVEL), cells[near])
    return level


def _smoothed(
    density: npt.NDArray[np.floating],
    threshold: float,
    deep_ratio: float,
    dense: BoolArray,
    cells: BoolArray,
    makes_up_volume: bool,
) -> Float32Array:
    """The level where density jumps."""
    level = np.full(cells.shape, -1.0, dtype=np.float32)
    positive = density > 0.0
    # A threshold of 0 asks for any density at all; what has some is then deep inside.
    smallest = max(threshold, float(np.finfo(np.float64).tiny))
    share = (np.log(density[positive]) - math.log(smallest)) / math.log(deep_ratio)
    level[positive] = np.where(share < 0.0, np.expm1(share), share)
    np.clip(level, -1.0, 1.0, out=level)
    level[cells & ~dense] = 1.0
    level[dense & ~cells] = -1.0
    level = _signed(level, np.float32(LEAST_LEVEL), cells)

    smooth = level.copy()
    for axis in range(3):
        ndimage.convolve1d(smooth, [0.25, 0.5, 0.25], axis=axis, mode="nearest", output=smooth)
    least = np.abs(level)
    least *= np.where(_thin(cells) | _thin(~cells), np.float32(LEAST_SHARE_THIN), np.float32(LEAST_SHARE))
    smooth = np.clip(_signed(smooth, least, cells), np.float32(-1.0), np.float32(1.0))
    return keep_volume(smooth, level, least, cells) if makes_up_volume else smooth


def _deep_ratio(dense: npt.NDArray[np.floating], threshold: float) -> float:
    """How many times denser than the threshold the densest part of the body is, within `DEEP_RATIOS`."""
    if len(dense) == 0:
        return DEEP_RATIOS[1]
    # In a logarithm the ratio of the largest to the smallest number does not overflow.
    smallest = max(threshold, float(np.finfo(np.float64).tiny))
    logarithm = math.log(float(np.quantile(dense, DEEP_QUANTILE, method="higher"))) - math.log(smallest)
    low, high = map(math.log, DEEP_RATIOS)
    return math.exp(min(max(logarithm, low), high))


def _signed(level: Float32Array, least: Float32Array | np.float32, cells: BoolArray) -> Float32Array:
    """The level, raised to `least` in solid voxels and lowered to minus that in empty ones."""
    return np.where(cells, np.maximum(level, least), np.minimum(level, -least))


def _thin(cells: BoolArray) -> BoolArray:
    """Voxels of walls one voxel thick: without a neighbour on either side, and beside at least two others like it."""
    thin = np.zeros_like(cells)
    for axis in range(3):
        alone = cells & ~_beside(cells, axis, 1) & ~_beside(cells, axis, -1)
        beside = np.zeros(cells.shape, dtype=np.uint8)
        for across in {0, 1, 2} - {axis}:
            beside += _beside(alone, across, 1)
            beside += _beside(alone, across, -1)
        thin |= alone & (beside >= 2)
    return thin


def _beside(cells: BoolArray, axis: int, step: int) -> BoolArray:
    """The neighbour of every voxel along an axis; on the border of the lattice, where there is none, the voxel."""
    row = np.moveaxis(cells, axis, 0)
    return np.moveaxis(np.concatenate((row[1:], row[-1:]) if step > 0 else (row[:1], row[:-1])), 0, axis)
