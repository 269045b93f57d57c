"""The walk of a ray through the voxels of a lattice."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel


@kernel
def cells_crossed(origin, direction, longest, shape, cells, faces):
    """Write the voxels that a ray crosses, in order, to `cells` and return their number (Amanatides and Woo 1987).

    Coordinates are corner indices; lengths are in voxels.

    Args:
        origin: Start of the ray, inside or outside the lattice, shape (3,).
        direction: Unit vector, shape (3,).
        longest: Length at which the ray ends.
        shape: Number of voxels along each axis, shape (3,).
        cells: Receives the flat indices (C order) of the voxels, shape (m,) with m at least the sum of `shape`.
        faces: Receives the length at which the ray enters the first voxel, then at which it leaves each, (m + 1,).
    """
    voxel, step = np.empty(3, np.int64), np.empty(3, np.int64)
    next_face, across = np.empty(3), np.empty(3)
    first, last, count = 0.0, longest, 0
    for axis in range(3):
        if direction[axis] != 0.0:
            low, high = -origin[axis] / direction[axis], (shape[axis] - origin[axis]) / direction[axis]
            first, last = max(first, min(low, high)), min(last, max(low, high))
        elif not 0.0 <= origin[axis] < shape[axis]:
            return 0
    if first >= last:
        return 0
    for axis in range(3):
        ahead = direction[axis] > 0.0
        voxel[axis] = min(max(int(np.floor(origin[axis] + first * direction[axis])), 0), shape[axis] - 1)
        step[axis] = 1 if ahead else -1
        across[axis], next_face[axis] = np.inf, np.inf
        if direction[axis] != 0.0:
            across[axis] = 1.0 / abs(direction[axis])
            next_face[axis] = (voxel[axis] + (1 if ahead else 0) - origin[axis]) / direction[axis]
    faces[0] = first
    while faces[count] < last:
        axis = 0 if next_face[0] <= next_face[1] else 1
        if next_face[2] < next_face[axis]:
            axis = 2
        cells[count] = (voxel[0] * shape[1] + voxel[1]) * shape[2] + voxel[2]
        count += 1
        faces[count] = next_face[axis]
        voxel[axis] += step[axis]
        if not 0 <= voxel[axis] < shape[axis]:
            break
        next_face[axis] += across[axis]
    return count
