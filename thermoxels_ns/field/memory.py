"""What a voxel grid will take in memory, said before it is taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.errors import MemoryBudgetError
from thermoxels_ns.core.lattice import Lattice

_ROWS_PER_VOXEL = 1.5
"""Corners per kept voxel of a body a few voxels thick (1 in the bulk, 2 for a single layer)."""
_BYTES_PER_VOXEL = 4 * 4 + 8 + 2 * 4
"""Row numbers, index, and the voxel's part of its block (which is about half full)."""


@dataclass(frozen=True)
class MemoryNeed:
    """Predicted peak memory of training on a lattice, beside photographs and programs."""

    voxels: int
    """Kept voxels."""
    rows: int
    """Stored corners."""
    gigabytes: float
    """Parameters, optimiser state, gradients and tables together, [1e9 bytes]."""

    def __str__(self) -> str:
        return f"{self.gigabytes:.2f} GB for {self.voxels:,} voxels with {self.rows:,} corners"


def memory_need(lattice: Lattice, voxels: int, channels: int) -> MemoryNeed:
    """Predict what training on `voxels` kept voxels of a lattice needs.

    Each stored corner has a value, two moments and at most one gradient per channel in single precision, and each is
    there twice for a moment while voxels are split.
    """
    total = int(np.prod([float(n) for n in lattice.cell_shape]))
    rows = lattice.num_corners if voxels >= total else min(lattice.num_corners, int(_ROWS_PER_VOXEL * voxels))
    bytes_per_row = 4 * channels * (1 + 2 + 1) + 4 + 8
    # Two masks of the whole lattice, and eight corner numbers per row while values are interpolated.
    passing = 2 * lattice.num_corners + 8 * 8 * rows
    return MemoryNeed(voxels, rows, (rows * bytes_per_row + voxels * _BYTES_PER_VOXEL + passing) / 1e9)


def check_memory(lattice: Lattice, voxels: int, channels: int, budget_gb: float) -> MemoryNeed:
    """Predict the memory of a lattice and refuse one that exceeds the budget.

    Raises:
        MemoryBudgetError: It does.
    """
    need = memory_need(lattice, voxels, channels)
    if need.gigabytes > budget_gb:
        raise MemoryBudgetError(
            "memory",
            expected=f"at most the budget of {budget_gb:g} GB",
            got=f"a lattice of {' x '.join(map(str, lattice.cell_shape))} voxels that needs {need}",
            remedy="Lower the last of --pipeline.model.resolutions, prune more "
            "(--pipeline.model.prune-threshold 0.05), or raise --pipeline.model.memory-budget-gb.",
        )
    return need
