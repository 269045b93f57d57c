"""Trilinear interpolation of rows stored on lattice corners, and its exact gradient.

Forward is one weighted gather per point (`torch.nn.functional.embedding_bag`, which never materialises the
points x 8 corners x channels values). Backward sorts the points by voxel, sums each voxel's contributions and
adds eight duplicate-free sets of rows, so that the result does not depend on thread count or on a race.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Tensor

from thermoxels_ns.lattice import CORNER_OFFSETS, Lattice


class TrilinearPoints:
    """Where points lie in a lattice: their voxel, its eight corners and the trilinear weights.

    Made once per set of points and used for density, colour and temperature alike.

    Args:
        lattice: The corner lattice.
        points: World positions, shape (n, 3). Points outside the lattice take the value of the nearest face.
    """

    def __init__(self, lattice: Lattice, points: Float[Tensor, "n 3"]):
        lo = torch.tensor(lattice.lo, dtype=points.dtype, device=points.device)
        cells = torch.tensor(lattice.cell_shape, dtype=points.dtype, device=points.device)
        position = torch.clamp((points - lo) / lattice.voxel_size, min=torch.zeros_like(cells), max=cells)
        corner = torch.minimum(position.floor(), cells - 1)
        self.fraction: Float[Tensor, "n 3"] = position - corner
        index = corner.long()
        _, ny, nz = lattice.shape
        self.first_corner: Int64[Tensor, " n"] = (index[:, 0] * ny + index[:, 1]) * nz + index[:, 2]
        dx, dy, dz = CORNER_OFFSETS.T
        self.corner_steps = torch.as_tensor((dx * ny + dy) * nz + dz, device=points.device)

    def weights(self) -> Float[Tensor, "n 8"]:
        """Trilinear weights in the corner order of `CORNER_OFFSETS`; they sum to 1."""
        (x, y, z), (u, v, w) = self.fraction.unbind(-1), (1 - self.fraction).unbind(-1)
        face = torch.stack((v * w, v * z, y * w, y * z), -1)
        return torch.cat((face * u[:, None], face * x[:, None]), -1)

    def corners(self) -> Int64[Tensor, "n 8"]:
        """Flat corner indices in the order of `CORNER_OFFSETS`."""
        return self.first_corner[:, None] + self.corner_steps

    def select(self, chosen: Tensor) -> TrilinearPoints:
        """The same for a subset of the points (boolean mask or indices)."""
        subset = object.__new__(TrilinearPoints)
        subset.fraction = self.fraction[chosen]
        subset.first_corner = self.first_corner[chosen]
        subset.corner_steps = self.corner_steps
        return subset


def interpolate(rows: Float[Tensor, "corners channels"], at: TrilinearPoints) -> Float[Tensor, "n channels"]:
    """Interpolate `rows` at points: f(p) = sum over the voxel's corners of w_c(p) rows[c].

    Args:
        rows: One row of values per lattice corner.
        at: The points.

    Returns:
        Interpolated rows; differentiable with respect to `rows`.
    """
    return _Interpolate.apply(rows, at)  # type: ignore[return-value]


def splat(values: Float[Tensor, "n channels"], at: TrilinearPoints, num_corners: int) -> Float[Tensor, "c channels"]:
    """Add values at points to their voxels' corners with trilinear weights: the transpose of `interpolate`."""
    return _splat(values, at, num_corners)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows: Tensor, at: TrilinearPoints) -> Tensor:
        ctx.at, ctx.num_corners = at, rows.shape[0]
        if at.first_corner.numel() == 0:
            return rows.new_zeros((0, rows.shape[1]))
        return F.embedding_bag(at.corners(), rows, mode="sum", per_sample_weights=at.weights().to(rows.dtype))

    @staticmethod
    def backward(ctx, *grad_outputs: Tensor):
        return _splat(grad_outputs[0], ctx.at, ctx.num_corners), None


def _splat(values: Tensor, at: TrilinearPoints, num_corners: int) -> Tensor:
    total = values.new_zeros((num_corners, values.shape[1]))
    if values.shape[0] == 0:
        return total
    ordered, order = torch.sort(at.first_corner, stable=True)
    cells, counts = torch.unique_consecutive(ordered, return_counts=True)
    starts = torch.cumsum(counts, 0) - counts
    weights = at.weights().to(values.dtype)[order]
    values = values.contiguous()
    for corner, step in enumerate(at.corner_steps.tolist()):
        per_cell = F.embedding_bag(
            order, values, starts, mode="sum", per_sample_weights=weights[:, corner].contiguous()
        )
        total.index_add_(0, cells + step, per_cell)  # rows are distinct: no race
    return total
