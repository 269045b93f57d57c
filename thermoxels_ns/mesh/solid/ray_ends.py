"""The surface where training rays end, and the voxels in front of it."""

from __future__ import annotations

import math

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, Float32Array, IntArray
from thermoxels_ns.core.snapshot import RayEvidence

REACH = 1.5
"""Distance from where a ray ends, [voxels], up to which it tells voxels how far away the surface is, and behind it
within which it has to meet solid. 1 and 2.5 gave the same F-score within 0.0005 (wild-3, wild-12)."""
_STEP = 0.5  # Distance of the points along a ray whose voxels it tells, [voxels]


def distance_to_ends(evidence: RayEvidence, shape: tuple[int, ...]) -> Float32Array:
    """Return how far in front of the surface each voxel's centre lies, shape `shape`, [voxels]; NaN where not known.

    The distance is that along a ray from the centre to the ray's end, negative behind it, as a mean over the rays that
    cross the voxel within `REACH` of their ends (truncated signed distances, Curless and Levoy 1996).
    """
    assert evidence.ends is not None and evidence.directions is not None
    size = math.prod(shape)
    total, count = np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.int32)
    for off in np.arange(-REACH, REACH + _STEP, _STEP, dtype=np.float32):
        voxel, inside = _voxels_at(evidence.ends + off * evidence.directions, shape)
        along = ((evidence.ends[inside] - voxel - 0.5) * evidence.directions[inside]).sum(axis=1)
        number = np.ravel_multi_index(tuple(voxel.T), shape)
        total += np.bincount(number, along, size)
        count += np.bincount(number, minlength=size)
    with np.errstate(invalid="ignore"):
        total /= count
    return total.reshape(shape)


def without_front(cells: BoolArray, evidence: RayEvidence, distance: Float32Array) -> BoolArray:
    """Return the solid voxels without those whose centres lie in front of the surface where rays end.

    Rays end in each voxel that holds a piece of the surface; with all of these, a body would be too large by half a
    voxel. A voxel in front stays if a ray that ends in it would otherwise meet no solid within `REACH` behind its end,
    as at a sheet thinner than a voxel. All stay if none would. `cells`, shape (nx-1, ny-1, nz-1), are the solid voxels;
    `distance` is the result of `distance_to_ends`.
    """
    assert evidence.ends is not None and evidence.directions is not None
    with np.errstate(invalid="ignore"):
        kept = cells & ~(distance > 0.0)
    met = np.zeros(len(evidence.ends), dtype=bool)
    for off in np.arange(0.0, REACH + _STEP, _STEP, dtype=np.float32):
        voxel, inside = _voxels_at(evidence.ends + off * evidence.directions, cells.shape)
        met[inside] |= kept[tuple(voxel.T)]
    needed = tuple(_voxels_at(evidence.ends[~met], cells.shape)[0].T)
    kept[needed] = cells[needed]
    return kept if kept.any() else cells


def ends_in_voxels(evidence: RayEvidence, shape: tuple[int, ...]) -> IntArray:
    """Return the number of rays that end in each voxel, shape `shape`."""
    assert evidence.ends is not None
    number = np.ravel_multi_index(tuple(_voxels_at(evidence.ends, shape)[0].T), shape)
    return np.bincount(number, minlength=math.prod(shape)).reshape(shape)


def _voxels_at(points: Float32Array, shape: tuple[int, ...]) -> tuple[IntArray, BoolArray]:
    """Return the voxels (m, 3) of those points (n, 3) that lie in the lattice, and which points do, (n,)."""
    voxel = np.floor(points).astype(np.int64)
    inside = ((voxel >= 0) & (voxel < shape)).all(axis=1)
    return voxel[inside], inside
