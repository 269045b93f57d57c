"""Trilinear interpolation of values at the corners of kept voxels, one row per corner, and its gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from thermoxels_ns.field.kept_voxels import KeptVoxels


@dataclass(frozen=True)
class TrilinearPoints:
    """The places of points in a lattice: the voxel of each point, and the place of the point in its voxel."""

    voxels: KeptVoxels
    number: Int64[Tensor, " n"]
    """Number of the kept voxel in which each point lies; -1 where the voxel is not kept: such a point has no values."""
    fraction: Float[Tensor, "n 3"]  # Place in the voxel, each coordinate from 0 to 1

    @classmethod
    def of(cls, voxels: KeptVoxels, points: Float[Tensor, "n 3"]) -> TrilinearPoints:
        """Find the voxels of world positions; a point outside the lattice is moved to the nearest point of its box."""
        lattice = voxels.lattice
        lo = torch.tensor(lattice.lo, dtype=points.dtype, device=points.device)
        cells = torch.tensor(lattice.cell_shape, dtype=points.dtype, device=points.device)
        position = torch.clamp((points - lo) / lattice.voxel_size, min=torch.zeros_like(cells), max=cells)
        corner = torch.minimum(position.floor(), cells - 1)
        return cls(voxels, voxels.number_at(corner.long()), position - corner)

    def kept(self) -> Bool[Tensor, " n"]:
        """Return for each point whether it lies in a kept voxel."""
        return self.number >= 0

    def weights(self) -> Float[Tensor, "n 8"]:
        """Return the trilinear weights of the corners (see `CORNER_OFFSETS`) of each point's voxel, which sum to 1."""
        (x, y, z), (u, v, w) = self.fraction.unbind(-1), (1 - self.fraction).unbind(-1)
        face = torch.stack((v * w, v * z, y * w, y * z), -1)
        return torch.cat((face * u[:, None], face * x[:, None]), -1)

    def rows(self) -> Int64[Tensor, "n 8"]:
        """Return the row numbers of the voxel's corners in the order of `CORNER_OFFSETS`; for points in kept voxels."""
        return self.voxels.tables(self.number.device)[0][self.number]

    def select(self, chosen: Tensor | slice) -> TrilinearPoints:
        """Return a subset of the points, chosen by a boolean mask, indices or a slice."""
        return TrilinearPoints(self.voxels, self.number[chosen], self.fraction[chosen])


def interpolate(rows: Float[Tensor, "rows channels"], at: TrilinearPoints) -> Float[Tensor, "n channels"]:
    """Return values at points in kept voxels: the sum over the voxel's corners c of their weight w_c times rows[c].

    The gradient for `rows` is summed in the order of the points, so its bits do not depend on the number of threads.
    """
    return _Interpolate.apply(rows, at)  # type: ignore[return-value]


def splat(values: Float[Tensor, "n channels"], at: TrilinearPoints) -> Float[Tensor, "rows channels"]:
    """Return for each corner's row the sum of `values` of points times the corner's trilinear weight at the point."""
    total = values.new_zeros((at.voxels.num_rows, values.shape[1]))
    if values.shape[0] == 0:
        return total
    ordered, order = torch.sort(at.number, stable=True)
    numbers, counts = torch.unique_consecutive(ordered, return_counts=True)
    starts = torch.cumsum(counts, 0) - counts
    weights = at.weights().to(values.dtype)[order]
    rows = at.voxels.tables(at.number.device)[0][numbers]
    values = values.contiguous()
    for corner in range(8):
        per_voxel = F.embedding_bag(
            order, values, starts, mode="sum", per_sample_weights=weights[:, corner].contiguous()
        )
        total.index_add_(0, rows[:, corner], per_voxel)  # rows are distinct: no race
    return total


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows: Tensor, at: TrilinearPoints) -> Tensor:
        ctx.at = at
        if at.number.numel() == 0:
            return rows.new_zeros((0, rows.shape[1]))
        return F.embedding_bag(at.rows(), rows, mode="sum", per_sample_weights=at.weights().to(rows.dtype))

    @staticmethod
    def backward(ctx, *grad_outputs: Tensor):
        return splat(grad_outputs[0], ctx.at), None
