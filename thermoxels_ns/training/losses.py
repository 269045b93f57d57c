"""Loss terms: the paper's eq. 3 and 4, Plenoxels' sparsity and beta terms, and distortion. All plain torch.

Each is a mean, so weights mean the same for every batch size and resolution. The model computes only those whose
weight is not 0.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor


def rgb_loss(predicted: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean squared error of colour (paper, eq. 3)."""
    return torch.mean((predicted - target) ** 2)


def thermal_loss(
    predicted: Float[Tensor, "n 1"], target: Float[Tensor, "n 1"], l2_share: float = 0.5
) -> Float[Tensor, ""]:
    """lambda L2 + (1 - lambda) L1 of normalised temperature (paper, eq. 4, lambda = 1/2)."""
    error = predicted - target
    return l2_share * torch.mean(error**2) + (1.0 - l2_share) * torch.mean(error.abs())


def total_variation(
    rows: Float[Tensor, "rows c"],
    corners: Int64[Tensor, "voxels 8"],
    smallest: float = 1e-10,
    channels: int | None = None,
) -> Float[Tensor, ""]:
    """Mean over voxels and channels of sqrt(dx^2 + dy^2 + dz^2), differences from corner 0 (Plenoxels, eq. 4).

    Args:
        rows: Corner values.
        corners: Rows of the corners of the voxels to look at, in the order of `lattice.CORNER_OFFSETS`.
        smallest: Added under the root so that its gradient is finite where the field is flat.
        channels: Channels of which the mean is taken, those without a column being 0; None: the columns.
    """
    columns = rows.shape[1]
    channels = columns if channels is None else channels
    here = rows[corners[:, 0]]
    dz, dy, dx = rows[corners[:, 1]] - here, rows[corners[:, 2]] - here, rows[corners[:, 4]] - here
    total = torch.sum(torch.sqrt(dx * dx + dy * dy + dz * dz + smallest)) / (len(corners) * channels)
    return total + (1.0 - columns / channels) * math.sqrt(smallest)


def random_block(voxels: int, share: float, generator: torch.Generator) -> tuple[int, int]:
    """A contiguous part of a list of `voxels` kept voxels, about `share` of it, at a random place: first, behind last.

    Kept voxels are listed slab by slab along x, so the part is contiguous in space too.
    """
    length = min(voxels, max(1, math.ceil(share * voxels)))
    first = int(torch.randint(voxels - length + 1, (), generator=generator))
    return first, first + length


def ray_sparsity(density: Float[Tensor, "rays steps"], deltas: Float[Tensor, "rays steps"]) -> Float[Tensor, " rays"]:
    """Cauchy sparsity of each ray: sum_i log(1 + 2 s_i^2) over real steps (Plenoxels, eq. 5; SNeRG)."""
    terms = torch.log1p(2.0 * density.clamp(max=1e9) ** 2)
    return torch.sum(torch.where(deltas > 0, terms, torch.zeros_like(terms)), -1)


def beta_loss(accumulation: Float[Tensor, " rays"], guard: float = 1e-3) -> Float[Tensor, ""]:
    """Push rays to be opaque or empty: mean of log(A + guard) + log(1 - A + guard) (Neural Volumes; Plenoxels).

    Shifted so that a fully decided ray costs 0.
    """
    decided = math.log(guard) + math.log(1.0 + guard)
    return torch.mean(torch.log(accumulation + guard) + torch.log(1.0 - accumulation + guard)) - decided


def ray_distortion(
    weights: Float[Tensor, "rays steps"],
    t: Float[Tensor, "rays steps"],
    deltas: Float[Tensor, "rays steps"],
    scale: float,
) -> Float[Tensor, " rays"]:
    """How far each ray's weight is spread (mip-NeRF 360, eq. 15, in the O(n) form of DVGOv2, eq. 6-7).

    sum_ij w_i w_j |t_i - t_j| + 1/3 sum_i w_i^2 d_i, lengths divided by `scale`; its mean gathers the weight of rays
    in one short interval.

    Args:
        weights: Weights of the steps.
        t: Step middles, ascending along each ray.
        deltas: Step lengths.
        scale: Length that counts as 1, world units (the diagonal of the box).
    """
    t, deltas = t / scale, deltas / scale
    moment = weights * t
    weight_before = torch.cumsum(weights, -1) - weights
    moment_before = torch.cumsum(moment, -1) - moment
    between = 2.0 * torch.sum(weights * (t * weight_before - moment_before), -1)
    return between + torch.sum(weights**2 * deltas, -1) / 3.0
