"""The surface where training rays end, and the voxels in front of it."""

from __future__ import annotations

import math

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, Float32Array, IntArray
from thermoxels_ns.core.snapshot import RayEvidence
from thermoxels_ns.mesh.solid.morphology import bounding_box

REACH = 1.5
"""Distance from where a ray ends, [voxels], up to which it tells voxels how far away the surface is, and behind it
within which it has to meet solid. 1 and 2.5 gave the same F-score within 0.0005 (wild-3, wild-12)."""
_STEP = 0.5  # Distance of the points along a ray whose voxels it tells, [voxels]


def without_front(cells: BoolArray, evidence: RayEvidence) -> BoolArray:
    """Return the solid voxels without those whose centres lie in front of the surface where rays end.

    Rays end in each voxel that holds a piece of the surface; with all of these, a body would be too large by half a
    voxel. A voxel's distance to the surface is the mean, over the rays that cross it within `REACH` of their ends, of
    the distance along the ray from its centre to the end (truncated signed distances, Curless and Levoy 1996). A voxel
    in front stays if a ray that ends in it would otherwise meet no solid within `REACH` behind its end, as at a sheet
    thinner than a voxel. `cells` are the solid voxels, shape (nx-1, ny-1, nz-1), of which at least one is solid. All
    stay if none would.
    """
    assert evidence.ends is not None and evidence.directions is not None
    near = bounding_box(cells)
    solid, directions = cells[near], evidence.directions
    ends = evidence.ends - np.array([side.start for side in near], dtype=np.float32)
    distance = np.zeros(solid.size, dtype=np.float32)  # the sum has the sign of the mean
    for off in np.arange(-REACH, REACH + _STEP, _STEP, dtype=np.float32):
        voxel, inside = _voxels_at(ends + off * directions, solid.shape)
        along = ((ends[inside] - voxel - 0.5) * directions[inside]).sum(axis=1)
        distance += np.bincount(np.ravel_multi_index(tuple(voxel.T), solid.shape), along, solid.size)
    kept = solid & (distance <= 0.0).reshape(solid.shape)
    met = np.zeros(len(ends), dtype=bool)
    for off in np.arange(0.0, REACH + _STEP, _STEP, dtype=np.float32):
        voxel, inside = _voxels_at(ends + off * directions, solid.shape)
        met[inside] |= kept[tuple(voxel.T)]
    needed = tuple(_voxels_at(ends[~met], solid.shape)[0].T)
    kept[needed] = solid[needed]
    result = np.zeros_like(cells)
    result[near] = kept if kept.any() else solid
    return result


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
