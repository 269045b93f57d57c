"""Change what a voxel grid stores: split voxels, drop voxels, add colour harmonics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from thermoxels_ns.core.arrays import BoolArray, IntArray
from thermoxels_ns.field.harmonics import num_coefficients
from thermoxels_ns.field.interpolation import TrilinearPoints, interpolate
from thermoxels_ns.field.kept_voxels import KeptVoxels
from thermoxels_ns.field.voxel_grid import VoxelGrid

GridChange = Callable[[Tensor], Tensor]
"""A function that maps values of a grid's rows before a change to values after it, both (rows, columns); it applies to
a parameter and to an optimiser's state of this parameter."""
ROWS_AT_ONCE = 1 << 17  # Rows interpolated at once, which limits the memory for corner numbers and weights


def split_voxels(voxels: KeptVoxels, factor: int) -> KeptVoxels:
    """Return the kept voxels of the lattice that is refined by `factor`: `factor`^3 for each voxel of `voxels`."""
    fine = voxels.lattice.refined(factor)
    index = np.unravel_index(voxels.cells, voxels.lattice.cell_shape)
    first = np.ravel_multi_index(tuple(along * factor for along in index), fine.cell_shape)
    steps = np.ravel_multi_index(tuple(np.indices((factor,) * 3).reshape(3, -1)), fine.cell_shape)
    cells = (first[:, None] + steps).reshape(-1)
    cells.sort()
    return KeptVoxels(fine, cells)


def parents_of_corners(old: KeptVoxels, new: KeptVoxels, factor: int) -> TrilinearPoints:
    """Return the places in the voxels `old` of the corners of ``new = split_voxels(old, factor)``, one per new row."""
    index = new.corner_index()
    number = torch.full((len(index),), -1, dtype=torch.int64)
    fraction = torch.zeros(len(index), 3, dtype=torch.float64)
    limit = np.asarray(old.lattice.cell_shape)
    for back in np.ndindex(2, 2, 2):
        # A corner on the face between two old voxels belongs to both; perhaps only one of the two is kept.
        missing = (number < 0).nonzero()[:, 0].numpy()
        voxel = index[missing] // factor - np.asarray(back)
        possible = ((index[missing] % factor == 0) | (np.asarray(back) == 0)).all(1)
        possible &= ((voxel >= 0) & (voxel < limit)).all(1)
        missing, voxel = missing[possible], voxel[possible]
        found = old.number_at(torch.from_numpy(voxel))
        number[missing] = torch.where(found >= 0, found, number[missing])
        place = torch.from_numpy(index[missing] / factor - voxel)
        fraction[missing] = torch.where((found >= 0)[:, None], place, fraction[missing])
    assert bool((number >= 0).all()), "every corner of a split voxel lies in its parent"
    return TrilinearPoints(old, number, fraction)


@torch.no_grad()
def refine(grid: VoxelGrid, factor: int = 2) -> GridChange:
    """Split every kept voxel of `grid` into factor^3, in place; return the interpolation from old rows to new rows. The
    field does not change: new corners get interpolated raw values, and old corners keep their exact values."""
    new = split_voxels(grid.voxels, factor)
    at = parents_of_corners(grid.voxels, new, factor)

    def change(rows: Tensor) -> Tensor:
        moved = TrilinearPoints(at.voxels, at.number.to(rows.device), at.fraction.to(rows.device))
        split = rows.new_empty((len(at.number), rows.shape[1]))
        for first in range(0, len(split), ROWS_AT_ONCE):
            part = slice(first, first + ROWS_AT_ONCE)
            split[part] = interpolate(rows, moved.select(part))
        return split

    grid.replace_voxels(new, {name: change(p.data) for name, p in grid.row_parameters().items()})
    return change


@torch.no_grad()
def prune(grid: VoxelGrid, keep: BoolArray) -> GridChange:
    """Drop the voxels that are False in `keep` (voxels,) from `grid`, in place; return the `GridChange` of its rows."""
    voxels = grid.voxels
    new = KeptVoxels(voxels.lattice, voxels.cells[keep])
    stay: IntArray = np.searchsorted(voxels.corners, new.corners)

    def change(rows: Tensor) -> Tensor:
        return rows[torch.from_numpy(stay).to(rows.device)]

    grid.replace_voxels(new, {name: change(p.data) for name, p in grid.row_parameters().items()})
    return change


@torch.no_grad()
def widen_colour(grid: VoxelGrid, degree: int) -> GridChange:
    """Raise the degree of the colour harmonics of `grid`, in place; return the function that adds columns of zeros.

    `degree` must be above the stored degree. The field does not change, because harmonics with coefficient 0 add
    nothing. The returned function does not change values with one column, such as numbers of updates.
    """
    assert grid.sh is not None and grid.sh_degree is not None and grid.sh_degree < degree
    few, many = num_coefficients(grid.sh_degree), num_coefficients(degree)

    def change(values: Tensor) -> Tensor:
        if values.shape[1] == 1:
            return values
        wide = values.new_zeros((len(values), 3, many))
        wide[..., :few] = values.view(len(values), 3, few)
        return wide.view(len(values), 3 * many)

    grid.sh = nn.Parameter(change(grid.sh.data))
    return change
