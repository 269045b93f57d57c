"""Backend reference: the volume rendering sum of the paper (eq. 1 and 2) in plain torch."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.field.interpolation import TrilinearPoints
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.ray_render import GridSamples, RayRender, RayRequest, RenderOptions


def intersect_box(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    lo: Float[Tensor, " 3"],
    hi: Float[Tensor, " 3"],
    near: float | Float[Tensor, " rays"] = 0.0,
    far: Float[Tensor, " rays"] | None = None,
) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"], Bool[Tensor, " rays"]]:
    """Return the distances at which rays enter and leave an axis-aligned box, [world units], and whether they hit it.

    All three have shape (rays,). Only the part of a ray from `near` to `far` (None: infinity) counts; a ray that misses
    the box has distances 0. This is the slab method (Kay and Kajiya 1986): a ray parallel to a slab (component of the
    direction below 1e-20) misses the box if its origin lies outside that slab.
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


OPAQUE_OPTICAL_DEPTH = 100.0
"""Largest optical depth of one step; light behind it is exp(-100): 4e-44, below the normal numbers of float32."""
SMALLEST_VARIATION = 1e-10  # Number added under the root of the total variation to keep its gradient finite


def ray_weights(density: Float[Tensor, "rays steps"], deltas: Float[Tensor, "rays steps"]) -> tuple[Tensor, Tensor]:
    """Return the weights w_i = exp(-sum_{j<i} s_j d_j) (1 - exp(-s_i d_i)) and the optical depth sum_i s_i d_i of rays.

    This is eq. 1 of the paper. Densities s, [1 / world unit], lengths d and weights have shape (rays, steps); optical
    depths have shape (rays,). Weights and exp(-optical depth) of a ray sum to 1. An infinite density is opaque, but a
    step of length 0 has no weight. Neither opaque rays nor small densities lose digits, because optical depths are
    summed and 1 - exp(-x) is computed as -expm1(-x). Raises `ThermoxelsError` if a density is NaN.
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
    return torch.exp(-before) * -torch.expm1(-optical_depth), total[:, -1]


def ray_distortion(
    weights: Float[Tensor, "rays steps"],
    t: Float[Tensor, "rays steps"],
    deltas: Float[Tensor, "rays steps"],
    scale: float,
) -> Float[Tensor, " rays"]:
    """Return the distortion of each ray: sum_ij w_i w_j |t_i - t_j| + 1/3 sum_i w_i^2 d_i (mip-NeRF 360, eq. 15).

    t_i is the distance and d_i the length of step i, both divided by `scale`; all three are in world units. The caller
    must pass ascending `t` along each ray. Distortion is small if the weight of a ray lies in one short interval. The
    sum is computed in the O(n) form of DVGOv2, eq. 6-7.
    """
    t, deltas = t / scale, deltas / scale
    moment = weights * t
    weight_before = torch.cumsum(weights, -1) - weights
    moment_before = torch.cumsum(moment, -1) - moment
    between = 2.0 * torch.sum(weights * (t * weight_before - moment_before), -1)
    return between + torch.sum(weights**2 * deltas, -1) / 3.0


@dataclass(frozen=True)
class Marched:
    """Samples of rays through the box, one in the middle of each step, with their weights. The lengths of a ray's steps
    sum to its length inside the box. Rays with fewer steps get steps of length 0 behind."""

    t: Float[Tensor, "rays steps"]  # Distance of each sample from the ray origin, world units
    deltas: Float[Tensor, "rays steps"]  # Length of each step, world units
    weights: Float[Tensor, "rays steps"]  # Share of its ray's light that ends in each step
    optical_depth: Float[Tensor, " rays"]  # exp(-optical_depth) is the share of light behind the last step
    active: Int64[Tensor, " n"]  # Flat indices (into rays x steps) of the samples in kept voxels, ascending
    ray: Int64[Tensor, " n"]  # Ray of each sample in `active`
    at: TrilinearPoints  # Voxel of each sample in `active`, and the place in the voxel


def march(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> Marched:
    """Return samples at equal steps along rays through a grid, with their weights."""
    origins, directions, lattice = request.origins, request.directions, grid.lattice
    lo = torch.tensor(lattice.lo, dtype=origins.dtype, device=origins.device)
    hi = torch.tensor(lattice.hi, dtype=origins.dtype, device=origins.device)
    step = lattice.voxel_size / options.steps_per_voxel
    t_enter, t_leave, _ = intersect_box(origins, directions, lo, hi, request.near, request.far)
    length = t_leave - t_enter
    num_steps = max(1, int(torch.ceil(length.amax() / step)) if len(length) else 1)
    starts = torch.arange(num_steps, dtype=origins.dtype, device=origins.device) * step
    deltas = torch.clamp(length[:, None] - starts, min=0.0, max=step)  # the last step of a ray may be shorter
    t = t_enter[:, None] + starts + 0.5 * deltas
    active = (deltas > 0).flatten().nonzero()[:, 0]
    ray = active // t.shape[1]
    positions = origins[ray] + directions[ray] * t.flatten()[active][:, None]
    at = grid.locate(positions)
    kept = at.kept()  # a point that rounding puts outside the box counts to the nearest voxel, as in the kernels
    active, ray, at = active[kept], ray[kept], at.select(kept)
    density = torch.zeros_like(t).flatten().index_put((active,), grid.density_at(at)).view_as(t)
    return Marched(t, deltas, *ray_weights(density, deltas), active, ray, at)


def render(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> RayRender:
    """Return what rays see of a grid, in plain torch; faster renderers are tested against this function."""
    marched = march(grid, request, options)
    weights, t, ray = marched.weights, marched.t, marched.ray
    weight = weights.flatten()[marched.active]

    def summed(values_at: Callable[..., Tensor], wants: Tensor | None, weight: Tensor, channels: int) -> Tensor:
        """Return sum_i w_i c_i over samples above the smallest weight of each ray that wants the value, else 0."""
        chosen = weight.detach() > options.smallest_weight
        chosen = (chosen if wants is None else chosen & wants[ray]).nonzero()[:, 0]
        values = values_at(marched.at.select(chosen), request.directions[ray[chosen]]) * weight[chosen][:, None]
        return values.new_zeros((len(t), channels)).index_add(0, ray[chosen], values)

    thermal_weight = weight if options.thermal_moves_density else weight.detach()
    opacity = -torch.expm1(-marched.optical_depth)
    depth = torch.where(opacity > 0, (weights * t).sum(-1) / opacity.clamp(min=1e-30), torch.inf)
    distortion = None
    if options.distortion_scale:
        distortion = ray_distortion(weights, t, marched.deltas, options.distortion_scale)
    corners, parameters = grid.voxels.tables(grid.density.device)[0], grid.row_parameters()
    variation = {
        name: total_variation(parameters[name], corners[a:b], options.colour_channels if name == "sh" else None)
        for name, (a, b) in options.variation.items()
    }
    return RayRender(
        summed(grid.rgb_at, request.rgb_rays, weight, 3) if grid.sh is not None else None,
        summed(grid.thermal_at, request.thermal_rays, thermal_weight, 1),
        torch.exp(-marched.optical_depth),
        opacity,
        depth,
        distortion,
        variation,
    )


def samples(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> GridSamples:
    """Return the samples of rays in kept voxels with their weights; neither colour nor temperature is read."""
    marched = march(grid, request, options)
    weights = marched.weights
    before = torch.cumsum(weights, -1) - weights
    weight, before = weights.flatten()[marched.active], before.flatten()[marched.active]
    return GridSamples(marched.ray, marched.at, weight, before, torch.exp(-marched.optical_depth))


def total_variation(
    rows: Float[Tensor, "rows c"], corners: Int64[Tensor, "voxels 8"], channels: int | None = None
) -> Float[Tensor, ""]:
    """Return the mean over voxels and channels of sqrt(dx^2 + dy^2 + dz^2) (Plenoxels, eq. 4).

    dx, dy, dz are the differences of `rows` between corner 0 of a voxel and its neighbours along x, y, z. `corners` has
    the rows of each voxel's corners in the order of `lattice.CORNER_OFFSETS`. The mean is over `channels` channels
    (None: the columns of `rows`); channels without a column are 0 everywhere.
    """
    columns = rows.shape[1]
    channels = columns if channels is None else channels
    here = rows[corners[:, 0]]
    dz, dy, dx = rows[corners[:, 1]] - here, rows[corners[:, 2]] - here, rows[corners[:, 4]] - here
    total = torch.sum(torch.sqrt(dx * dx + dy * dy + dz * dz + SMALLEST_VARIATION)) / (len(corners) * channels)
    return total + (1.0 - columns / channels) * math.sqrt(SMALLEST_VARIATION)
