"""Raise the degree of stored colour: rows get columns for further harmonics, all 0, which changes no colour.

While colour is the same from all sides its further harmonics are 0 and no gradient moves them, so they need not be
stored, nor passed over by optimisers, total variation, refinement, pruning and checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from thermoxels_ns.core.buffer_pool import SCRATCH
from thermoxels_ns.field.harmonics import num_coefficients
from thermoxels_ns.field.voxel_grid import VoxelGrid

ColumnChange = Callable[[Tensor], Tensor]
"""Maps values with the old columns, shape (rows, old columns), to values with the new ones."""


@torch.no_grad()
def widen_colour(grid: VoxelGrid, degree: int) -> ColumnChange:
    """Store colour up to a higher degree without changing the field.

    Args:
        grid: A grid with colour of a lower degree; it gets a new parameter.
        degree: The new degree.

    Returns:
        How values of columns change: harmonics keep theirs, those that were not stored are 0.
    """
    assert grid.sh is not None and grid.sh_degree is not None and grid.sh_degree < degree
    SCRATCH.release()  # what steps on the narrow rows needed makes room for the wide ones
    few, many = num_coefficients(grid.sh_degree), num_coefficients(degree)

    def change(values: Tensor) -> Tensor:
        wide = values.new_zeros((len(values), 3, many))
        wide[..., :few] = values.view(len(values), 3, few)
        return wide.view(len(values), 3 * many)

    grid.sh = nn.Parameter(change(grid.sh.data))
    return change
