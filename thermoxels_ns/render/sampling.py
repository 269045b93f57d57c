"""Where a ray meets the box, and where it is sampled there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class RaySteps:
    """Samples along rays, padded to the longest ray."""

    t: Float[Tensor, "rays steps"]
    """Distance of each sample (the middle of its step) from the ray origin, world units."""
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
    the box starts at `near`.

    Args:
        origins: Ray origins, world units.
        directions: Unit directions.
        lo: Lower corner of the box.
        hi: Upper corner of the box.
        near: Smallest distance from the origin, >= 0.
        far: Largest distance from the origin; None: none.

    Returns:
        Entry distance, exit distance and whether the ray meets the box over a length above 0; a miss has both
        distances 0.
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
    """Cut each ray's chord through the box into steps of length `step`; the last step takes what is left.

    Args:
        origins: Ray origins, world units.
        directions: Unit directions.
        lo: Lower corner of the box.
        hi: Upper corner of the box.
        step: Step length, world units (the paper: half a voxel).
        near: Distance in front of the camera where sampling starts.
        far: Distance where it ends; None: at the box.

    Returns:
        Samples in the middle of their steps.
    """
    t_enter, t_leave, _ = intersect_box(origins, directions, lo, hi, near, far)
    length = t_leave - t_enter
    num_steps = max(1, int(torch.ceil(length.amax() / step)) if len(length) else 1)
    starts = torch.arange(num_steps, dtype=origins.dtype, device=origins.device) * step
    deltas = torch.clamp(length[:, None] - starts, min=0.0, max=step)
    return RaySteps(t=t_enter[:, None] + starts + 0.5 * deltas, deltas=deltas)
