"""The kept voxels of a lattice, the row in which each of their corners is stored, and the memory needed."""

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

    Only corners of kept voxels have a row, in ascending order of the flat corner index (Plenoxels, Fridovich-Keil et
    al. 2022). Two corners of a kept voxel that differ by one step along z have neighbouring rows, so that four row
    numbers give all eight. Voxels are looked up by blocks of 8^3 voxels; a block without kept voxels costs four bytes.

    Args:
        lattice: The lattice.
        cells: Flat indices of the kept voxels, ascending, each once; None: all.

    Attributes:
        cells: Flat indices of the kept voxels, ascending, shape (voxels,), int64. A voxel's number is its place here.
        corners: Flat index of the corner that each row holds, ascending, shape (rows,), int64.
        voxel_rows: Rows of the corners (0,0,0), (0,1,0), (1,0,0), (1,1,0) of each voxel, shape (voxels, 4), int32; the
            corner one step along z has the next row.
        block_slot: Slot of each block in `voxel_number`, -1 for a block without kept voxels, shape (blocks,), int32.
        voxel_number: Number of each voxel of the blocks that have a slot, slot after slot; -1 where a voxel is not
            kept, shape (slots * 512,), int32.
    """

    def __init__(self, lattice: Lattice, cells: npt.ArrayLike | None = None):
        self.lattice = lattice
        chosen = np.arange(np.prod(lattice.cell_shape)) if cells is None else cells
        self.cells: IntArray = np.ascontiguousarray(chosen, dtype=np.int64)
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
        """Number of rows, that is of corners of kept voxels."""
        return len(self.corners)

    def __len__(self) -> int:
        return len(self.cells)

    def corner_index(self) -> IntArray:
        """Return the lattice index (i, j, k) of the corner of each row, shape (rows, 3)."""
        return np.stack(np.unravel_index(self.corners, self.lattice.shape), axis=1)

    def dilated(self, chosen: BoolArray, by: int) -> BoolArray:
        """Return for each kept voxel whether a chosen one is at most `by` voxels away along every axis, (voxels,).
        `chosen` (voxels,) has one boolean per kept voxel too. The way between may lead through voxels not kept."""
        grown = np.zeros(self.lattice.cell_shape, dtype=bool)
        grown.reshape(-1)[self.cells[chosen]] = True
        return np.asarray(maximum_filter(grown, 2 * by + 1, mode="constant"), dtype=bool).reshape(-1)[self.cells]

    def tables(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """Return int64 tensors on `device`: rows of the eight corners (voxels, 8), `block_slot`, `voxel_number`."""
        if device not in self._tables:
            four = torch.from_numpy(self.voxel_rows).to(device, torch.int64)
            eight = torch.stack((four, four + 1), dim=-1).flatten(1)  # order of CORNER_OFFSETS
            slot = torch.from_numpy(self.block_slot).to(device, torch.int64)
            number = torch.from_numpy(self.voxel_number).to(device, torch.int64)
            self._tables[device] = (eight, slot, number)
        return self._tables[device]

    def number_at(self, voxel: Tensor) -> Tensor:
        """Return the numbers of voxels given by index (n, 3) inside the lattice; -1 for a voxel that is not kept."""
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
    """Predicted peak memory of training on a lattice, without photographs and programs."""

    voxels: int  # Number of kept voxels
    rows: int  # Number of their corners; predicted unless all voxels are kept
    gigabytes: float  # Parameters, optimiser state, gradients and tables together, [1e9 bytes]

    def __str__(self) -> str:
        return f"{self.gigabytes:.2f} GB for {self.voxels:,} voxels with {self.rows:,} corners"


def memory_need(lattice: Lattice, voxels: int, channels: int) -> MemoryNeed:
    """Return the predicted memory for training on `voxels` kept voxels of a lattice with `channels` numbers per corner.
    Each channel of a corner takes a value, two moments of the optimiser and a gradient, each of four bytes."""
    total = int(np.prod([float(n) for n in lattice.cell_shape]))
    rows = lattice.num_corners if voxels >= total else min(lattice.num_corners, int(_ROWS_PER_VOXEL * voxels))
    bytes_per_row = 4 * channels * (1 + 2 + 1) + 4 + 8
    # Two masks of the whole lattice, and eight corner numbers per row while values are interpolated.
    passing = 2 * lattice.num_corners + 8 * 8 * rows
    return MemoryNeed(voxels, rows, (rows * bytes_per_row + voxels * _BYTES_PER_VOXEL + passing) / 1e9)


def check_memory(lattice: Lattice, voxels: int, channels: int, budget_gb: float) -> MemoryNeed:
    """Return `memory_need`; raise `MemoryBudgetError` if it is above `budget_gb`, [1e9 bytes]."""
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
