"""Which voxels are kept, in which row their corners are stored, and the memory they need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from thermoxels_ns.core.arrays import BoolArray, IntArray
from thermoxels_ns.core.errors import MemoryBudgetError
from thermoxels_ns.core.lattice import Lattice

BLOCK = 8  # Voxels along the side of a block


class KeptVoxels:
    """The kept voxels of a lattice and the rows of their corners.

    Rows exist for corners of kept voxels only (Plenoxels, Fridovich-Keil et al. 2022), in the order of their flat
    corner index. Corners k and k + 1 of a kept voxel stand in neighbouring rows, so four row numbers per voxel find all
    eight. The voxel under a point is found through blocks of 8^3 voxels; an empty block costs four bytes.

    Args:
        lattice: The lattice.
        cells: Flat indices of the kept voxels, ascending, each once; None: all.

    Attributes:
        cells: Flat voxel indices, ascending, shape (voxels,), int64. The place in this list is the voxel's number.
        corners: Flat index of the corner that each row holds, ascending, shape (rows,), int64.
        voxel_rows: Rows of the corners (0,0,0), (0,1,0), (1,0,0), (1,1,0) of each voxel, shape (voxels, 4), int32; the
            corner one step along z stands in the next row.
        block_slot: Place of each block's table, -1 for a block without kept voxels, shape (blocks,), int32.
        voxel_number: Tables of the blocks, one after the other: number of each voxel, -1 where it is not kept,
            shape (slots * 512,), int32.
    """

    def __init__(self, lattice: Lattice, cells: npt.ArrayLike | None = None):
        self.lattice = lattice
        total = int(np.prod(lattice.cell_shape))
        self.cells: IntArray = np.arange(total) if cells is None else np.ascontiguousarray(cells, dtype=np.int64)
        self.all_kept = len(self.cells) == total
        place = np.unravel_index(self.cells, lattice.cell_shape)
        first = np.ravel_multi_index(place, lattice.shape)
        _, cy, cz = lattice.shape
        steps = (0, cz, cy * cz, cy * cz + cz)
        used = np.zeros(lattice.num_corners, dtype=bool)
        for step in steps:
            used[first + step] = True
            used[first + step + 1] = True
        self.corners: IntArray = np.flatnonzero(used)
        del used
        self.voxel_rows = np.empty((len(first), 4), dtype=np.int32)
        for column, step in enumerate(steps):
            self.voxel_rows[:, column] = np.searchsorted(self.corners, first + step)
        self.block_shape = tuple(-(-n // BLOCK) for n in lattice.cell_shape)
        block = np.ravel_multi_index(tuple(along // BLOCK for along in place), self.block_shape)
        self.block_slot = np.full(int(np.prod(self.block_shape)), -1, dtype=np.int32)
        self.block_slot[block] = 0
        occupied = np.flatnonzero(self.block_slot == 0)
        self.block_slot[occupied] = np.arange(len(occupied), dtype=np.int32)
        self.voxel_number = np.full(len(occupied) * BLOCK**3, -1, dtype=np.int32)
        within = np.ravel_multi_index(tuple(along % BLOCK for along in place), (BLOCK,) * 3)
        self.voxel_number[self.block_slot[block].astype(np.int64) * BLOCK**3 + within] = np.arange(len(self.cells))
        self._tables: dict[torch.device, tuple[Tensor, Tensor, Tensor]] = {}

    @property
    def num_rows(self) -> int:
        """Number of stored corners."""
        return len(self.corners)

    def __len__(self) -> int:
        return len(self.cells)

    def mask(self) -> BoolArray:
        """Kept voxels as a dense array, shape of the lattice's voxels."""
        kept = np.zeros(self.lattice.cell_shape, dtype=bool)
        kept.reshape(-1)[self.cells] = True
        return kept

    def corner_index(self) -> IntArray:
        """Lattice index (i, j, k) of every stored corner, shape (rows, 3)."""
        return np.stack(np.unravel_index(self.corners, self.lattice.shape), axis=1)

    def dilated(self, chosen: BoolArray, by: int) -> BoolArray:
        """Grow a subset of the kept voxels by `by` voxels in all 26 directions, one boolean per kept voxel.

        Growth may pass through voxels that are not kept.
        """
        grown = np.zeros(self.lattice.cell_shape, dtype=bool)
        grown.reshape(-1)[self.cells[chosen]] = True
        return np.asarray(maximum_filter(grown, 2 * by + 1, mode="constant"), dtype=bool).reshape(-1)[self.cells]

    def tables(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """`voxel_rows` of all eight corners (voxels, 8), `block_slot` and `voxel_number` as int64 tensors."""
        if device not in self._tables:
            four = torch.from_numpy(self.voxel_rows).to(device, torch.int64)
            eight = torch.stack((four, four + 1), dim=-1).flatten(1)  # order of CORNER_OFFSETS
            slot = torch.from_numpy(self.block_slot).to(device, torch.int64)
            number = torch.from_numpy(self.voxel_number).to(device, torch.int64)
            self._tables[device] = (eight, slot, number)
        return self._tables[device]

    def number_at(self, voxel: Tensor) -> Tensor:
        """Number of voxels given by their lattice index (n, 3), inside the lattice; -1 where it is not kept."""
        _, slot, number = self.tables(voxel.device)
        if len(number) == 0:
            return torch.full_like(voxel[:, 0], -1)
        block, within = voxel // BLOCK, voxel % BLOCK
        _, by, bz = self.block_shape
        at = slot[(block[:, 0] * by + block[:, 1]) * bz + block[:, 2]]
        place = (within[:, 0] * BLOCK + within[:, 1]) * BLOCK + within[:, 2]
        return torch.where(at >= 0, number[at.clamp(min=0) * BLOCK**3 + place], at)


_ROWS_PER_VOXEL = 1.5  # Corners per kept voxel of a body a few voxels thick (1 in the bulk, 2 for a single layer)
_BYTES_PER_VOXEL = 4 * 4 + 8 + 2 * 4  # Row numbers, index, and the voxel's part of its block (which is about half full)


@dataclass(frozen=True)
class MemoryNeed:
    """Predicted peak memory of training on a lattice, beside photographs and programs."""

    voxels: int  # Kept voxels
    rows: int  # Stored corners
    gigabytes: float  # Parameters, optimiser state, gradients and tables together, [1e9 bytes]

    def __str__(self) -> str:
        return f"{self.gigabytes:.2f} GB for {self.voxels:,} voxels with {self.rows:,} corners"


def memory_need(lattice: Lattice, voxels: int, channels: int) -> MemoryNeed:
    """Predict what training on `voxels` kept voxels of a lattice needs.

    Each stored corner has a value, two moments and at most one gradient per channel in single precision.
    """
    total = int(np.prod([float(n) for n in lattice.cell_shape]))
    rows = lattice.num_corners if voxels >= total else min(lattice.num_corners, int(_ROWS_PER_VOXEL * voxels))
    bytes_per_row = 4 * channels * (1 + 2 + 1) + 4 + 8
    # Two masks of the whole lattice, and eight corner numbers per row while values are interpolated.
    passing = 2 * lattice.num_corners + 8 * 8 * rows
    return MemoryNeed(voxels, rows, (rows * bytes_per_row + voxels * _BYTES_PER_VOXEL + passing) / 1e9)


def check_memory(lattice: Lattice, voxels: int, channels: int, budget_gb: float) -> MemoryNeed:
    """Predict the memory of a lattice; raises `MemoryBudgetError` if it exceeds the budget."""
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
