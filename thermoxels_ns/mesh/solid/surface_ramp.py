"""A level that is linear in the distance, where density falls smoothly across the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray

LEAST_STRAIGHTNESS = 0.5
"""Least mean slope of the density beside the surface, as a share of its slope at the surface, that makes it a ramp.
A jump has 0. A density that is the share of each voxel inside the body has a quarter, too little: a level made of it
would end half a voxel from the surface, and the mesh would be rough."""
ROUGHNESS = (0.04, 0.08)
"""Noise, as a shift of the surface, [voxels]: a voxel counts as smooth up to the first, as rough from the second on."""
ROUGH_SHARE = (0.5, 0.8)
"""A ramp is believed where fewer of the voxels around than the first share are rough, not at all from the second on.
At sharp edges some always are."""
WINDOW = 7  # edge of the cube in which they are counted, [voxels]
REACH = 1.5  # the level reaches 1 no nearer to the surface than this, [voxels]; what ends nearer makes the mesh rough

_FULLER = 0.01  # the logarithm is taken unless the density itself bends less by more than this


@dataclass(frozen=True)
class SurfaceRamp:
    """A level taken from a smooth ramp of density, and where to believe it."""

    level: Float32Array
    """In [-1, 1], about linear in the distance to the surface; its sign may be wrong where there is no ramp."""
    belief: Float32Array  # from 0, where the density is rough or jumps, to 1


@dataclass(frozen=True)
class _Crossings:
    """How a function of the density runs through the surface: medians over all pairs of a solid and an empty voxel."""

    bend: float  # how much steeper it is outside than inside, as a share of its slope between the two, without its sign
    straightness: float  # mean slope on either side, as a share of the slope between the two


def surface_ramp(
    density: npt.NDArray[np.floating], threshold: float, deep_ratio: float, dense: BoolArray, cells: BoolArray
) -> SurfaceRamp | None:
    """Level and where to believe it, if density falls smoothly across most of the surface; None if it jumps there.

    Where density passes the threshold along a smooth ramp over a few voxels, a function of it that is linear in the
    distance is a level that needs no smoothing. Where it jumps, or is noisy, there is no such function.

    Two functions of the density are tried: its logarithm, linear where density is exponential in the distance, and
    density itself, linear where it falls off evenly or is a blurred step whose half is the threshold. The one that
    bends less at the surface is taken.

    Args:
        density: At voxel centres, at least 0.
        threshold: From which on a voxel is dense, above 0.
        deep_ratio: How many times denser than the threshold the body is where the logarithm's level reaches 1.
        dense: Voxels that the threshold chose.
        cells: Solid voxels; where they are not the dense ones, density says nothing.
    """
    with np.errstate(divide="ignore"):
        logarithm = np.log(np.asarray(density, dtype=np.float64) / threshold)
    linear = np.asarray(density, dtype=np.float64) / threshold - 1.0
    for values in (logarithm, linear):
        values[cells != dense] = np.nan
    runs = [_crossings(values, cells) for values in (logarithm, linear)]
    is_linear = runs[1].bend + _FULLER < runs[0].bend
    values, run = ((logarithm, runs[0]), (linear, runs[1]))[is_linear]
    if not run.straightness >= LEAST_STRAIGHTNESS:
        return None
    near = np.flatnonzero(near_surface(cells))
    rough, slope = _roughness(values, near)
    belief, smooth = _belief(rough, near, cells.shape)
    if not smooth.any():
        return None
    scale = REACH * float(np.median(slope[smooth]))
    if not is_linear:
        scale = max(scale, float(np.log(deep_ratio)))
    level = np.clip(values / scale, -1.0, 1.0)
    unknown = np.isnan(level)
    level[unknown] = np.where(cells[unknown], 1.0, -1.0)
    belief[unknown] = 0.0
    return SurfaceRamp(level.astype(np.float32), belief)


def near_surface(cells: BoolArray) -> BoolArray:
    """True for voxels with solid and empty ones among themselves and their 26 neighbours."""
    some = ndimage.maximum_filter(cells, 3, mode="nearest")
    every = ndimage.minimum_filter(cells, 3, mode="nearest")
    return np.not_equal(some, every)


def _crossings(values: FloatArray, cells: BoolArray) -> _Crossings:
    bends, straight = [np.empty(0)], [np.empty(0)]
    for axis in range(3):
        along, solid = np.moveaxis(values, axis, 0), np.moveaxis(cells, axis, 0)
        if len(solid) < 4:
            continue
        first, *across = np.nonzero(solid[1:-2] != solid[2:-1])
        before, low, high, after = (along[(first + step, *across)] for step in range(4))
        outward = np.where(solid[(first + 1, *across)], 1.0, -1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            bend = outward * ((after - high) - (low - before)) / (high - low)
            run = 0.5 * ((after - high) + (low - before)) / (high - low)
        bends.append(np.where(np.isfinite(bend), bend, 1.0))
        straight.append(np.where(np.isfinite(run), run, 0.0))
    bends, straight = np.concatenate(bends), np.concatenate(straight)
    if len(bends) == 0:
        return _Crossings(np.inf, 0.0)
    return _Crossings(abs(float(np.median(bends))), float(np.median(straight)))


def _roughness(values: FloatArray, near: IntArray) -> tuple[FloatArray, FloatArray]:
    """Noise at some voxels, as a shift of the surface, [voxels], and the slope there, [1 / voxel], each shape (n,).

    Third differences are 0 along straight and evenly bent ramps. Of the three stencils of four voxels that hold a
    voxel and its neighbour the smoothest counts, so that an edge of the body beside them does no harm; of the pairs to
    both sides the rougher. Noise of size 1 has third differences of root mean square sqrt(20).
    """
    index = np.array(np.unravel_index(near, values.shape))
    flat = values.reshape(-1)
    squared, slope = np.zeros(len(near)), np.zeros(len(near))
    for axis in range(3):
        size, stride = values.shape[axis], int(np.prod(values.shape[axis + 1 :]))
        steps = [np.clip(index[axis] + step, 0, size - 1) - index[axis] for step in range(-3, 4)]
        line = np.stack([flat[near + step * stride] for step in steps])
        with np.errstate(invalid="ignore"):
            first = np.diff(line, axis=0)
            third = np.abs(np.diff(first, n=2, axis=0))
        third[~np.isfinite(third)] = np.inf
        squared += np.maximum(third[:3].min(axis=0), third[1:].min(axis=0)) ** 2
        beside = np.abs(first[2:4])
        slope += np.where(np.isfinite(beside), beside, 0.0).max(axis=0) ** 2
    slope = np.sqrt(slope)
    with np.errstate(over="ignore"):  # infinitely rough, where nothing rises
        return np.sqrt(squared / 60.0) / np.maximum(slope, np.finfo(np.float64).tiny), slope


def _belief(rough: FloatArray, near: IntArray, shape: tuple[int, ...]) -> tuple[Float32Array, BoolArray]:
    """How far to believe the ramp everywhere, and which of the voxels near the surface are in places believed in."""
    low, high = ROUGHNESS
    share, count = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    share.reshape(-1)[near] = np.clip((rough - low) / (high - low), 0.0, 1.0)
    count.reshape(-1)[near] = 1.0
    share, count = (ndimage.uniform_filter(values, WINDOW, mode="constant") for values in (share, count))
    # Where no surface is around, nothing depends on it; it only must not be taken for rough.
    share /= np.maximum(count, np.float32(0.5 / WINDOW**3))
    few, many = ROUGH_SHARE
    belief = np.clip((many - share) / (many - few), 0.0, 1.0).astype(np.float32)
    return belief, belief.reshape(-1)[near] > 0.0
