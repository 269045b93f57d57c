"""Operations on sets of voxels (True in boolean arrays): bodies, growing and shrinking, gaps, cavities, hulls."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import ConvexHull

from thermoxels_ns.core.arrays import BoolArray


def bounding_box(cells: BoolArray, margin: int = 0) -> tuple[slice, ...]:
    """Return slices of the bounding box of solid voxels, wider by `margin` on each side; empty if no voxel is solid.

    >>> bounding_box(np.array([[[False, False, True, True, False]]]), 1)
    (slice(0, 2, None), slice(0, 2, None), slice(1, 5, None))
    """
    found = ndimage.find_objects(cells.view(np.int8))
    if not found:
        return (slice(0, 0),) * 3
    return tuple(slice(max(part.start - margin, 0), part.stop + margin) for part in found[0])


def connected(cells: BoolArray, connectivity: int = 3) -> npt.NDArray[np.int32]:
    """Return the label of each voxel's connected body, from 1 in C order of the bodies' first voxels; 0 if empty.

    Voxels are connected if they share a face (`connectivity` 1), at least an edge (2) or at least a corner (3).
    """
    # Labels are found in the box of the solid only, because most of a lattice is empty.
    labels, box = np.zeros(cells.shape, dtype=np.int32), bounding_box(cells)
    inside = np.zeros(cells[box].shape, dtype=np.int32)
    ndimage.label(cells[box], ndimage.generate_binary_structure(3, connectivity), output=inside)
    labels[box] = inside
    return labels


def grow(cells: BoolArray, by: int) -> BoolArray:
    """Return all voxels that are at most `by` voxels from a solid voxel along every axis (a dilation by a cube).

    >>> grow(np.array([[[False, False, False, True]]]), 2)[0, 0].tolist()
    [False, True, True, True]
    """
    return np.asarray(ndimage.maximum_filter(cells, 2 * by + 1, mode="constant"), dtype=bool)


def shrink(cells: BoolArray, size: int | tuple[int, ...], origin: int | tuple[int, ...] = 0) -> BoolArray:
    """Return the voxels whose surrounding box of `size` voxels is completely solid and inside the array (an erosion).

    A box of even size is centred half a voxel below the voxel, or half a voxel above it if `origin` is -1.

    >>> shrink(np.array([[[True, True, True, True]]]), (1, 1, 3))[0, 0].tolist()
    [False, True, True, False]
    """
    return np.asarray(ndimage.minimum_filter(cells, size, mode="constant", origin=origin), dtype=bool)  # type: ignore[arg-type]


def close_gaps(cells: BoolArray, by: int) -> BoolArray:
    """Return the closing of solid voxels: gaps too narrow for an empty cube of edge 2 `by` + 1 voxels are filled.

    >>> close_gaps(np.array([[[True, False, True]]]), 1)[0, 0].tolist()
    [True, True, True]
    """
    if by == 0:
        return cells
    # Solid at the border of the lattice is continued outwards by `by` voxels.
    grown = grow(np.pad(cells, by, mode="edge"), by)
    closed = ~grow(~grown, by)
    return np.logical_or(closed[by:-by, by:-by, by:-by], cells)


def convex_hull(cells: BoolArray) -> BoolArray:
    """Return the voxels whose centres lie in the convex hull of the centres of the solid voxels.

    The hull meets each column of voxels in one interval; each hull plane is compared once with each column.
    """
    columns = np.argwhere(cells.any(axis=2))
    if len(columns) == 0:
        return np.zeros_like(cells)
    column = cells[columns[:, 0], columns[:, 1]]
    first = column.argmax(axis=1)
    last = column.shape[1] - column[:, ::-1].argmax(axis=1)
    steps = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    ends_of_columns = [np.column_stack((columns + step, ends)) for step in steps for ends in (first, last)]
    planes = ConvexHull(np.concatenate(ends_of_columns).astype(np.float64)).equations
    planes[:, 3] += 0.5 * np.abs(planes[:, :3]).sum(axis=1) - 1e-9  # moved to the hull of centres
    nx, ny, nz = cells.shape
    x, y = np.arange(nx)[:, None] + 0.5, np.arange(ny)[None, :] + 0.5
    low, high = np.full((nx, ny), -np.inf), np.full((nx, ny), np.inf)
    for a, b, c, d in planes:
        # Inside is a x + b y + c z + d <= 0. Planes parallel to the columns bound no z, but may exclude a column.
        rest = a * x + b * y + d
        if abs(c) < 1e-9:
            high[rest > 1e-9] = -np.inf
        elif c > 0.0:
            high = np.minimum(high, -rest / c)
        else:
            low = np.maximum(low, -rest / c)
    centre = np.arange(nz) + 0.5
    return (centre >= low[..., None] - 1e-9) & (centre <= high[..., None] + 1e-9)
