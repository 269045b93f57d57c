"""The level function at voxel centres, whose zero is the surface; thin and small bodies keep their volume."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, Float32Array, IntArray
from thermoxels_ns.mesh.solid.morphology import bounding_box

DEEP_QUANTILE = 0.95  # quantile of the dense voxels' density at which the level is 1 before smoothing
DEEP_RATIOS = (2.0, 100.0)  # lowest and highest ratio of this density to the threshold
LEAST_LEVEL = 0.02
"""Least distance of levels from 0 before smoothing, so that the surface never passes through a voxel's centre."""
LEAST_SHARE = 0.25  # smoothing leaves at least this share of a voxel's level, and keeps its sign
LEAST_SHARE_THIN = 0.5  # the same share in walls and gaps one voxel thick, so that they keep their thickness
MARGIN = 4  # voxels farther than this outside the bounding box of the solid have level -1, whatever their density
UNNOTICED = 0.12
"""Share of the solid (for gaps: of the empty space) around a voxel that smoothing may remove without correction, as it
does at edges of large bodies and single bumps of noise."""

_ROUNDS = 5  # number of rounds in which missing volume is found and restored
_RATE = 1.5  # share of the missing volume that one round restores if all of the surface moves alike
_LEAST_SLOPE = 0.6  # least change of the level per voxel of shift, [1 / voxel]; less would not restore small specks
_CHUNK = 1 << 14  # number of voxels worked on at a time, so that their data stay in the processor's cache
_AROUND = np.indices((3, 3, 3)).reshape(3, 27).T - 1
_WINDOW = np.array([0.25, 0.5, 0.25], dtype=np.float32)[_AROUND + 1].prod(axis=1)


def level_of(
    density: npt.NDArray[np.floating],
    threshold: float,
    dense: BoolArray,
    cells: BoolArray,
    distance: Float32Array | None = None,
) -> Float32Array:
    """Return the level of every voxel, in [-1, 1]: above 0 in solid voxels, below 0 in empty voxels, 0 on the surface.

    Let s = log(density / threshold) / log(deep / threshold). Here, deep is the density at `DEEP_QUANTILE` of the dense
    voxels, kept within `DEEP_RATIOS`. The level is min(s, 1) for s above 0, else exp(s) - 1: it is 0 at the threshold
    and -1 without density. The logarithm suits trained density, which jumps by orders of magnitude between neighbours.
    The levels are then smoothed with weights 1 2 1 along each axis against noise. Where smoothing takes volume from
    thin or small bodies, the levels are shifted to restore it. All arrays have one shape (nx-1, ny-1, nz-1).

    Args:
        density: Density at voxel centres, at least 0, [1 / world unit].
        threshold: Least density of a dense voxel, at least 0, [1 / world unit].
        dense: True for voxels that the threshold chose.
        cells: True for solid voxels. Solid voxels that are not dense were added by a later step and get level 1 before
            smoothing; dense voxels that are not solid were removed by a later step and get level -1.
        distance: Result of `distance_to_ends`; if not NaN, its negative is the level before smoothing. None: all NaN.
    """
    result = np.full(cells.shape, -1.0, dtype=np.float32)
    near, threshold = bounding_box(cells, MARGIN), max(threshold, float(np.finfo(np.float64).tiny))
    low, high = map(math.log, DEEP_RATIOS)
    logarithm = high  # logarithm of the ratio of the deep density to the threshold
    if dense.any():
        deep = float(np.quantile(density[dense], DEEP_QUANTILE, method="higher"))
        logarithm = min(max(math.log(deep) - math.log(threshold), low), high)
    density, dense, cells = density[near], dense[near], cells[near]
    level, positive = np.full(cells.shape, -1.0, dtype=np.float32), density > 0.0
    share = (np.log(density[positive]) - math.log(threshold)) / logarithm
    level[positive] = np.where(share < 0.0, np.expm1(share), share)
    np.clip(level, -1.0, 1.0, out=level)
    level[cells & ~dense] = 1.0
    level[dense & ~cells] = -1.0
    if distance is not None:
        known = np.isfinite(distance[near])
        level[known] = np.clip(-distance[near][known], -1.0, 1.0)
    level = _signed(level, np.float32(LEAST_LEVEL), cells)

    smooth = level.copy()
    for axis in range(3):
        ndimage.convolve1d(smooth, [0.25, 0.5, 0.25], axis=axis, mode="nearest", output=smooth)
    least = np.abs(level)
    least *= np.where(_thin(cells) | _thin(~cells), np.float32(LEAST_SHARE_THIN), np.float32(LEAST_SHARE))
    smooth = np.clip(_signed(smooth, least, cells), np.float32(-1.0), np.float32(1.0))
    result[near] = _keep_volume(smooth, level, least, cells)
    return result


def _signed(level: Float32Array, least: Float32Array | np.float32, cells: BoolArray) -> Float32Array:
    """Return the level, raised to at least `least` in solid voxels and lowered to at most -`least` in empty ones."""
    return np.where(cells, np.maximum(level, least), np.minimum(level, -least))


def _thin(cells: BoolArray) -> BoolArray:
    """Return a mask of voxels of walls one voxel thick: they have no solid neighbour along one axis, and at least two
    of their neighbours along the other axes have none along this axis either."""
    thin = np.zeros_like(cells)
    for axis in range(3):
        alone = cells & (_beside(cells, axis) == 0)
        first, second = {0, 1, 2} - {axis}
        thin |= alone & (_beside(alone, first) + _beside(alone, second) >= 2)
    return thin


def _beside(cells: BoolArray, axis: int) -> npt.NDArray[np.uint8]:
    """Return the number (0 to 2) of each voxel's solid neighbours along an axis; border voxels repeat outwards."""
    return np.asarray(ndimage.convolve1d(cells.view(np.uint8), [1, 0, 1], axis=axis, mode="nearest"), dtype=np.uint8)


def _keep_volume(level: Float32Array, sharp: Float32Array, least: Float32Array, cells: BoolArray) -> Float32Array:
    """Return the smoothed `level`, shifted so that the solid volume around each voxel is about that of `sharp`.

    Smoothing alone shrinks a one-voxel bar to a third. For each voxel near the surface, the solid share is found
    from the trilinear level, and the wanted share from the sign changes of the sharp level along the axes. The
    difference of the shares is averaged with weights 1 4 6 4 1 along each axis. This average divided by the area of the
    surface around the voxel is the distance by which the surface should move. Averages below `UNNOTICED` times the
    volume around are ignored, which keeps faces and long edges of large bodies in place. Levels keep their sign, and
    their distance from 0 is at least `least`. All arrays have the same shape; `cells` is True for solid voxels.
    """
    some, every = (look(cells, 3, mode="nearest") for look in (ndimage.maximum_filter, ndimage.minimum_filter))
    near = np.pad(np.not_equal(some, every), 1)
    index = np.flatnonzero(near)
    if len(index) == 0:
        return level
    strides = np.array([near.shape[1] * near.shape[2], near.shape[2], 1])
    steps = _AROUND @ strides
    wanted, sides = _wanted(np.pad(sharp, 1, mode="edge").reshape(-1), index, strides)
    solid, lowest = np.pad(cells, 1, mode="edge").reshape(-1)[index], np.pad(least, 1).reshape(-1)[index]
    volume = _windowed(np.pad(cells, 1, mode="edge").astype(np.float32).reshape(-1), wanted, index, steps)
    buffer = np.zeros(near.size, dtype=np.float32)
    area = np.maximum(_windowed(buffer, 0.5 * sides, index, steps), np.finfo(np.float32).tiny)

    padded = np.pad(level, 1, mode="edge")
    levels = padded.reshape(-1)
    share, slope = _found(levels, index, steps)
    changed = np.zeros(len(levels), dtype=bool)
    for _ in range(_ROUNDS):
        missing = _windowed(buffer, wanted - share, index, steps)
        noticed = np.abs(missing) - UNNOTICED * np.where(missing > 0.0, volume, 1.0 - volume)
        moves = np.flatnonzero(noticed > 0.0)
        if len(moves) == 0:
            break
        shift = _RATE * np.sign(missing[moves]) * noticed[moves] / area[moves]
        moved = levels[index[moves]] + shift * np.maximum(slope[moves], np.float32(_LEAST_SLOPE))
        low = lowest[moves]
        moved = np.where(solid[moves], np.maximum(moved, low), np.minimum(moved, -low))
        levels[index[moves]] = np.clip(moved, -1.0, 1.0)
        changed[:] = False
        for step in steps:
            changed[index[moves] + step] = True
        again = np.flatnonzero(changed[index])
        share[again], slope[again] = _found(levels, index[again], steps)
    return np.ascontiguousarray(padded[1:-1, 1:-1, 1:-1])


def _wanted(sharp: Float32Array, index: IntArray, strides: IntArray) -> tuple[Float32Array, Float32Array]:
    """Return the wanted solid share of the voxels `index`, and the number (0 to 6) of neighbours across the surface.
    `sharp` is a flat array of levels, `index` (n,) holds positions in it, `strides` (3,) the steps along the axes."""
    # Along each axis, a voxel reaches from its centre to the surface on each side, but at most half a voxel.
    own = sharp[index]
    share, sides = np.ones(len(index), dtype=np.float32), np.zeros(len(index), dtype=np.float32)
    for stride in strides:
        width = np.zeros(len(index), dtype=np.float32)
        for step in (stride, -stride):
            other = sharp[index + step]
            across = (other > 0.0) != (own > 0.0)
            # The two levels are never 0.
            width += np.where(across, np.minimum(np.abs(own) / (np.abs(own) + np.abs(other)), 0.5), 0.5)
            sides += across
        share *= width
    return np.where(own > 0.0, share, 1.0 - share), sides


def _octant_weights() -> tuple[Float32Array, Float32Array]:
    """Return weights of 27 levels around a voxel that give value (8, 27) and gradient (3, 8, 27) at octant centres."""
    side = np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1
    towards = _AROUND[None] == side[:, None]
    share = np.where(_AROUND[None] == 0, 0.75, np.where(towards, 0.25, 0.0))
    change = np.where(_AROUND[None] == 0, -side[:, None], np.where(towards, side[:, None], 0.0))
    slopes = [np.where(np.arange(3) == axis, change, share).prod(axis=2) for axis in range(3)]
    return share.prod(axis=2).astype(np.float32), np.array(slopes, dtype=np.float32)


_VALUES, _SLOPES = _octant_weights()


def _found(levels: Float32Array, index: IntArray, steps: IntArray) -> tuple[Float32Array, Float32Array]:
    """Return the solid share and the mean slope, [1 / voxel], of the voxels `index` for a level linear in each octant.

    `steps` (27,) lead from a voxel to its neighbours in the flat array `levels`. If the surface is a plane at distance
    d [voxels] from an octant's middle, the share 1/2 + 2 d of the octant is solid (on average over directions).
    """
    share, slope = np.empty(len(index), dtype=np.float32), np.empty(len(index), dtype=np.float32)
    for start in range(0, len(index), _CHUNK):
        part = slice(start, start + _CHUNK)
        around = levels[index[part] + steps[:, None]]
        slopes = np.sqrt(sum((weights @ around) ** 2 for weights in _SLOPES))
        distance = (_VALUES @ around) / np.maximum(slopes, np.float32(1e-6))
        share[part] = np.clip(0.5 + 2.0 * distance, 0.0, 1.0).mean(axis=0)
        slope[part] = slopes.mean(axis=0)
    return share, slope


def _windowed(values: Float32Array, at_index: Float32Array, index: IntArray, steps: IntArray) -> Float32Array:
    """Return weighted means of `values` (flat) around the voxels `index`, weights 1 4 6 4 1 along each axis, (n,).

    Before each pass, the values at `index` are replaced, in place, by `at_index` (n,).
    """
    for _ in range(2):
        values[index] = at_index
        at_index = np.empty(len(index), dtype=np.float32)
        for start in range(0, len(index), _CHUNK):
            part = slice(start, start + _CHUNK)
            at_index[part] = _WINDOW @ values[index[part] + steps[:, None]]
    return at_index
