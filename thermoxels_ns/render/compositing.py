"""The volume rendering sum of the paper (eq. 1 and 2) and its samples, in plain torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from thermoxels_ns.core.errors import ThermoxelsError


@dataclass(frozen=True)
class RaySteps:
    """Samples along rays, padded to the longest ray."""

    t: Float[Tensor, "rays steps"]  # Distance of each sample (the middle of its step) from the ray origin, world units
    deltas: Float[Tensor, "rays steps"]
    """Length of each step; 0 for padding. Sums to the length of the ray inside the box."""


def intersect_box(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    lo: Float[Tensor, " 3"],
    hi: Float[Tensor, " 3"],
    near: float | Float[Tensor, " rays"] = 0.0,
    far: Float[Tensor, " rays"] | None = None,
) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"], Bool[Tensor, " rays"]]:
    """Intersect rays with an axis-aligned box by slabs (Kay and Kajiya 1986), each axis guarded.

    An axis along which the direction is 0 (below 1e-20, whose inverse would overflow) constrains nothing if the
    origin lies in the closed slab and misses otherwise; no direction is ever shifted away from 0. A camera inside
    the box starts at `near`. Gives entry, exit and whether there is a length
    above 0 between them; a miss has both distances 0.
    """
    parallel = directions.abs() < 1e-20
    inverse = 1.0 / torch.where(parallel, torch.ones_like(directions), directions)
    t_lo, t_hi = (lo - origins) * inverse, (hi - origins) * inverse
    inside = (origins >= lo) & (origins <= hi)
    infinity = torch.full_like(t_lo, torch.inf)
    enter = torch.where(parallel, torch.where(inside, -infinity, infinity), torch.minimum(t_lo, t_hi))
    leave = torch.where(parallel, torch.where(inside, infinity, -infinity), torch.maximum(t_lo, t_hi))
    t_enter = torch.maximum(enter.amax(-1), torch.as_tensor(near, dtype=origins.dtype, device=origins.device))
    t_leave = leave.amin(-1) if far is None else torch.minimum(leave.amin(-1), far)
    hit = (t_leave > t_enter) & torch.isfinite(t_leave)
    zero = torch.zeros_like(t_enter)
    return torch.where(hit, t_enter, zero), torch.where(hit, t_leave, zero), hit


def sample_box(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    lo: Float[Tensor, " 3"],
    hi: Float[Tensor, " 3"],
    step: float,
    near: float | Float[Tensor, " rays"] = 0.0,
    far: Float[Tensor, " rays"] | None = None,
) -> RaySteps:
    """Cut each ray's chord through the box into steps of length `step`; the last step takes what is left."""
    t_enter, t_leave, _ = intersect_box(origins, directions, lo, hi, near, far)
    length = t_leave - t_enter
    num_steps = max(1, int(torch.ceil(length.amax() / step)) if len(length) else 1)
    starts = torch.arange(num_steps, dtype=origins.dtype, device=origins.device) * step
    deltas = torch.clamp(length[:, None] - starts, min=0.0, max=step)
    return RaySteps(t=t_enter[:, None] + starts + 0.5 * deltas, deltas=deltas)


OPAQUE_OPTICAL_DEPTH = 100.0
"""Optical depth of one step from which it counts as opaque: exp(-100) is 0 in float32, 4e-44 in float64."""

RowsFn = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class RayWeights:
    """What density makes of a ray's steps."""

    weights: Float[Tensor, "rays steps"]  # Share of the pixel that each step fills
    transmittance: Float[Tensor, " rays"]  # Share of the background that is left behind the last step
    accumulation: Float[Tensor, " rays"]  # 1 - transmittance, with all digits when it is small


@dataclass(frozen=True)
class Composite:
    """What a bundle of rays sees."""

    rgb: Float[Tensor, "rays 3"] | None  # Colour in [0, 1]; None if no colour was asked for
    thermal: Float[Tensor, "rays 1"] | None  # Normalised temperature; None if none was asked for
    accumulation: Float[Tensor, " rays"]  # Opacity of the whole ray, in [0, 1]
    depth: Float[Tensor, " rays"]  # Expected distance of what was hit, world units; infinite where nothing was


def ray_weights(density: Float[Tensor, "rays steps"], deltas: Float[Tensor, "rays steps"]) -> RayWeights:
    """Turn densities into weights: w_i = exp(-sum_{j<i} s_j d_j) (1 - exp(-s_i d_i)) (paper, eq. 1).

    Optical depths are summed, never multiplied as transmittances, so that deep rays keep their digits;
    1 - exp(-x) is computed as -expm1(-x), so that vanishing density keeps its value and its gradient; an
    infinite density is opaque, also over a tiny step.

    Args:
        density: >= 0, may be infinite, [1 / world unit].
        deltas: Step lengths, [world unit]; a step of length 0 has no weight whatever its density.

    Returns:
        Weights and what is left for the background; they sum to 1.

    Raises:
        ThermoxelsError: A density is NaN.
    """
    if torch.isnan(density).any():
        remedy = "Lower the density learning rate and resume from the last checkpoint."
        got = f"{int(torch.isnan(density).sum())} NaN"
        raise ThermoxelsError("density", expected="numbers >= 0", got=got, remedy=remedy)
    optical_depth = torch.where(
        deltas > 0, (density * deltas).clamp(min=0.0, max=OPAQUE_OPTICAL_DEPTH), torch.zeros_like(deltas)
    )
    total = torch.cumsum(optical_depth, dim=-1)
    before = torch.cat((torch.zeros_like(total[:, :1]), total[:, :-1]), dim=-1)
    return RayWeights(
        weights=torch.exp(-before) * -torch.expm1(-optical_depth),
        transmittance=torch.exp(-total[:, -1]),
        accumulation=-torch.expm1(-total[:, -1]),
    )


def composite(
    steps: RaySteps,
    along: RayWeights,
    rgb_at: RowsFn | None = None,
    thermal_at: RowsFn | None = None,
    rgb_rays: Bool[Tensor, " rays"] | None = None,
    thermal_rays: Bool[Tensor, " rays"] | None = None,
    thermal_moves_density: bool = False,
    smallest_weight: float = 0.0,
) -> Composite:
    """Sum colour and temperature along rays (paper, eq. 1 and 2), without the background: C = sum_i w_i c_i.

    Appearance is asked for only at steps whose weight exceeds `smallest_weight` on rays that want it.

    Args:
        steps: Samples.
        along: Their weights.
        rgb_at: Maps the flat indices (into rays x steps) of samples to colours (n, 3); None: no colour.
        thermal_at: Maps flat indices of samples to normalised temperatures (n, 1); None: no temperature.
        rgb_rays: Rays that want colour; None: all. The others get 0.
        thermal_rays: Rays that want temperature; None: all. The others get 0.
        thermal_moves_density: Let the thermal sum carry gradients into the weights (off: temperature never
            moves geometry).
        smallest_weight: Steps of at most this weight add no colour and no temperature; the error of a pixel is
            at most `smallest_weight` times its number of steps. 0 is exact.

    Returns:
        The composite; a ray that misses is 0, with depth infinite.
    """
    accumulation = along.accumulation
    expected = (along.weights * steps.t).sum(-1)
    depth = torch.where(
        accumulation > 0, expected / accumulation.clamp(min=1e-30), torch.full_like(expected, torch.inf)
    )
    thermal_weights = along.weights if thermal_moves_density else along.weights.detach()
    rgb = _sum_rows(along.weights, rgb_at, rgb_rays, 3, smallest_weight)
    thermal = _sum_rows(thermal_weights, thermal_at, thermal_rays, 1, smallest_weight)
    return Composite(rgb=rgb, thermal=thermal, accumulation=accumulation, depth=depth)


def _sum_rows(
    weights: Tensor, rows_at: RowsFn | None, rays: Tensor | None, channels: int, smallest_weight: float
) -> Tensor | None:
    if rows_at is None:
        return None
    num_rays, num_steps = weights.shape
    wanted = weights.detach() > smallest_weight
    if rays is not None:
        wanted &= rays[:, None]
    flat = wanted.flatten().nonzero()[:, 0]
    rows = rows_at(flat) * weights.flatten()[flat][:, None]
    return rows.new_zeros((num_rays, channels)).index_add(0, flat // num_steps, rows)


def ray_sparsity(density: Float[Tensor, "rays steps"], deltas: Float[Tensor, "rays steps"]) -> Float[Tensor, " rays"]:
    """Cauchy sparsity of each ray: sum_i log(1 + 2 s_i^2) over real steps (Plenoxels, eq. 5; SNeRG)."""
    terms = torch.log1p(2.0 * density.clamp(max=1e9) ** 2)
    return torch.sum(torch.where(deltas > 0, terms, torch.zeros_like(terms)), -1)


def ray_distortion(
    weights: Float[Tensor, "rays steps"],
    t: Float[Tensor, "rays steps"],
    deltas: Float[Tensor, "rays steps"],
    scale: float,
) -> Float[Tensor, " rays"]:
    """How far each ray's weight is spread (mip-NeRF 360, eq. 15, in the O(n) form of DVGOv2, eq. 6-7).

    sum_ij w_i w_j |t_i - t_j| + 1/3 sum_i w_i^2 d_i, lengths divided by `scale` [world units]; its mean gathers the
    weight of rays in one short interval. Step middles `t` ascend along each ray.
    """
    t, deltas = t / scale, deltas / scale
    moment = weights * t
    weight_before = torch.cumsum(weights, -1) - weights
    moment_before = torch.cumsum(moment, -1) - moment
    between = 2.0 * torch.sum(weights * (t * weight_before - moment_before), -1)
    return between + torch.sum(weights**2 * deltas, -1) / 3.0
