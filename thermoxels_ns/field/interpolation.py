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
    """Places of points in a lattice: for each point the number of its voxel and its coordinates in the voxel."""

    voxels: KeptVoxels
    number: Int64[Tensor, " n"]
    """Number of the kept voxel in which each point lies; -1: the voxel is not kept, so the point has no values."""
    fraction: Float[Tensor, "n 3"]  # Place in the voxel, each coordinate from 0 to 1

    @classmethod
    def of(cls, voxels: KeptVoxels, points: Float[Tensor, "n 3"]) -> TrilinearPoints:
        """Return the places of world positions; a point outside the lattice is moved to the nearest point inside."""
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
        """Return the trilinear weights of the corners of each point's voxel, in order of `CORNER_OFFSETS`; sum 1."""
        (x, y, z), (u, v, w) = self.fraction.unbind(-1), (1 - self.fraction).unbind(-1)
        face = torch.stack((v * w, v * z, y * w, y * z), -1)
        return torch.cat((face * u[:, None], face * x[:, None]), -1)

    def rows(self) -> Int64[Tensor, "n 8"]:
        """Return the rows of the corners of each point's voxel, which must be kept, in order of `CORNER_OFFSETS`."""
        return self.voxels.tables(self.number.device)[0][self.number]

    def select(self, chosen: Tensor | slice) -> TrilinearPoints:
        """Return a subset of the points, chosen by a boolean mask, indices or a slice."""
        return TrilinearPoints(self.voxels, self.number[chosen], self.fraction[chosen])


def interpolate(rows: Float[Tensor, "rows channels"], at: TrilinearPoints) -> Float[Tensor, "n channels"]:
    """Return interpolated values at points: the sum over the corners c of a point's voxel of weight w_c times rows[c].

    All points must lie in kept voxels. The gradient with respect to `rows` is summed in the order of the points: no bit
    of it depends on the number of threads.
    """
    return _Interpolate.apply(rows, at)  # type: ignore[return-value]


def splat(values: Float[Tensor, "n channels"], at: TrilinearPoints) -> Float[Tensor, "rows channels"]:
    """Return for each row the sum over points of `values` times the trilinear weight of the row's corner at the point.
    This is the transpose of `interpolate`. All points must lie in kept voxels."""
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
