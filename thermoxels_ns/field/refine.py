"""Coarse to fine: split voxels, and drop those that no ray gives weight to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from thermoxels_ns.errors import PruningError, explain
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.lattice import Lattice


def resample_rows(rows: Float[Tensor, "old c"], lattice: Lattice, factor: int) -> Float[Tensor, "new c"]:
    """Trilinear values of `rows` on the corners of ``lattice.refined(factor)``; old corners keep theirs exactly."""
    nx, ny, nz = lattice.refined(factor).shape
    volume = rows.T.reshape(1, -1, *lattice.shape)
    fine = F.interpolate(volume, size=(nx, ny, nz), mode="trilinear", align_corners=True)
    return fine.reshape(rows.shape[1], -1).T.contiguous()


@torch.no_grad()
def refine(grid: VoxelGrid, factor: int = 2) -> None:
    """Split every voxel into factor^3 without changing the field where density is trilinear or exponential.

    Density is per world unit, so nothing is rescaled. A split voxel is kept if its parent was.
    """
    lattice = grid.lattice
    rows = {name: resample_rows(p.data, lattice, factor) for name, p in grid.row_parameters().items()}
    kept = grid.kept
    for axis in range(3):
        kept = kept.repeat_interleave(factor, dim=axis)
    grid.replace_lattice(lattice.refined(factor), rows, kept)


@dataclass(frozen=True)
class PruningReport:
    """What pruning did."""

    kept_voxels: int
    total_voxels: int
    threshold: float
    """Smallest largest weight of a voxel that was kept for its own sake."""
    lost_weight: float
    """Share of the training rays' total weight that lay in the voxels removed."""

    def __str__(self) -> str:
        share = self.kept_voxels / self.total_voxels
        return (
            f"kept {self.kept_voxels:,} of {self.total_voxels:,} voxels ({share:.1%}); "
            f"threshold {self.threshold:.2g}, {self.lost_weight:.2%} of the rays' weight lost"
        )


def dilate(voxels: Bool[Tensor, "x y z"], by: int) -> Bool[Tensor, "x y z"]:
    """Grow a set of voxels by `by` voxels in all 26 directions."""
    if by <= 0:
        return voxels
    grown = F.max_pool3d(voxels[None, None].float(), kernel_size=2 * by + 1, stride=1, padding=by)
    return grown[0, 0] > 0.5


@torch.no_grad()
def prune(
    grid: VoxelGrid,
    largest_weight: Float[Tensor, "x y z"],
    total_weight: Float[Tensor, "x y z"],
    threshold: float,
    dilation: int = 1,
    largest_loss: float = 0.01,
) -> PruningReport:
    """Keep voxels to which some training ray gave more than `threshold` of its weight, and their neighbours.

    Args:
        grid: The grid; its kept voxels can only become fewer.
        largest_weight: Largest weight any sample in each voxel had on any training ray.
        total_weight: Sum of the weights in each voxel over all training rays.
        threshold: Smallest `largest_weight` of a voxel that is kept.
        dilation: Voxels added around those.
        largest_loss: Largest share of the total weight that may go.

    Returns:
        What was kept and lost.

    Raises:
        PruningError: More than `largest_loss` of the weight would go; the grid is left as it was.
    """
    keep = dilate(largest_weight > threshold, dilation) & grid.kept
    total = float(total_weight.sum())
    lost = float(total_weight[~keep].sum()) / total if total > 0 else 1.0
    if lost > largest_loss:
        raise PruningError(
            explain(
                "pruning",
                expected=f"to remove at most {largest_loss:.0%} of the rays' weight",
                got=f"{lost:.1%} at threshold {threshold:g}",
                remedy="Lower --pipeline.model.prune-threshold, or prune later when surfaces have formed.",
            )
        )
    grid.kept = keep
    return PruningReport(int(keep.sum()), keep.numel(), threshold, lost)
