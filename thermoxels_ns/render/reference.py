"""The plain twin of the compiled renderer: the volume rendering sum of the paper (eq. 1 and 2) in torch."""

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
    """Intersect rays with an axis-aligned box by slabs (Kay and Kajiya 1986): entry, exit, and whether a ray hits.

    An axis along which the direction is 0 (below 1e-20, whose inverse would overflow) constrains nothing if the
    origin lies in the closed slab and misses otherwise. A camera inside the box starts at `near`; a miss has both
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
    """Cut each ray's chord through the box into steps of length `step`; the last step takes what is left."""
    t_enter, t_leave, _ = intersect_box(origins, directions, lo, hi, near, far)
    length = t_leave - t_enter
    num_steps = max(1, int(torch.ceil(length.amax() / step)) if len(length) else 1)
    starts = torch.arange(num_steps, dtype=origins.dtype, device=origins.device) * step
    deltas = torch.clamp(length[:, None] - starts, min=0.0, max=step)
    return RaySteps(t=t_enter[:, None] + starts + 0.5 * deltas, deltas=deltas)


OPAQUE_OPTICAL_DEPTH = 100.0
"""Optical depth of one step from which it counts as opaque: exp(-100) is 0 in float32, 4e-44 in float64."""
SMALLEST_VARIATION = 1e-10  # Added under the root of the total variation, whose gradient is finite then


@dataclass(frozen=True)
class RayWeights:
    """What density makes of a ray's steps."""

    weights: Float[Tensor, "rays steps"]  # Share of the pixel that each step fills
    transmittance: Float[Tensor, " rays"]  # Share of the background that is left behind the last step
    accumulation: Float[Tensor, " rays"]  # 1 - transmittance, with all digits when it is small


def ray_weights(density: Float[Tensor, "rays steps"], deltas: Float[Tensor, "rays steps"]) -> RayWeights:
    """Turn densities [1 / world unit] into weights: w_i = exp(-sum_{j<i} s_j d_j) (1 - exp(-s_i d_i)) (paper, eq. 1).

    Optical depths are summed, so that deep rays keep their digits; 1 - exp(-x) is computed as -expm1(-x), so that
    vanishing density keeps its value and its gradient. Infinite density is opaque, but a step of length 0 has no
    weight. Weights and transmittance sum to 1.

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


@dataclass(frozen=True)
class Marched:
    """Samples of rays through the box, and what density makes of them."""

    steps: RaySteps
    density: Float[Tensor, "rays steps"]  # Density at the samples, 0 where nothing was asked, [1 / world unit]
    along: RayWeights
    active: Int64[Tensor, " n"]  # Flat indices (into rays x steps) of the samples in kept voxels, ascending
    ray: Int64[Tensor, " n"]  # The ray of each of them
    at: TrilinearPoints  # Where they lie


def march(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> Marched:
    """Sample rays through the kept voxels and weigh the samples."""
    origins, directions, lattice = request.origins, request.directions, grid.lattice
    lo = torch.tensor(lattice.lo, dtype=origins.dtype, device=origins.device)
    hi = torch.tensor(lattice.hi, dtype=origins.dtype, device=origins.device)
    step = lattice.voxel_size / options.steps_per_voxel
    steps = sample_box(origins, directions, lo, hi, step, request.near, request.far)
    active = (steps.deltas > 0).flatten().nonzero()[:, 0]
    ray = active // steps.t.shape[1]
    positions = origins[ray] + directions[ray] * steps.t.flatten()[active][:, None]
    at = grid.locate(positions)
    kept = at.kept()  # of a point that rounding puts outside the box, the nearest voxel counts, as in the kernels
    active, ray, at = active[kept], ray[kept], at.select(kept)
    density = torch.zeros_like(steps.t).flatten().index_put((active,), grid.density_at(at)).view_as(steps.t)
    return Marched(steps, density, ray_weights(density, steps.deltas), active, ray, at)


def render(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> RayRender:
    """Render rays in plain torch: what every faster renderer is tested against."""
    marched = march(grid, request, options)
    steps, along, ray = marched.steps, marched.along, marched.ray
    weight = along.weights.flatten()[marched.active]

    def summed(values_at: Callable[..., Tensor], wants: Tensor | None, weight: Tensor, channels: int) -> Tensor:
        """Sum values over the samples with a weight that counts, on rays that want them: C = sum_i w_i c_i."""
        chosen = weight.detach() > options.smallest_weight
        chosen = (chosen if wants is None else chosen & wants[ray]).nonzero()[:, 0]
        values = values_at(marched.at.select(chosen), request.directions[ray[chosen]]) * weight[chosen][:, None]
        return values.new_zeros((len(steps.t), channels)).index_add(0, ray[chosen], values)

    thermal_weight = weight if options.thermal_moves_density else weight.detach()
    expected = (along.weights * steps.t).sum(-1)
    depth = torch.where(along.accumulation > 0, expected / along.accumulation.clamp(min=1e-30), torch.inf)
    distortion = sparsity = None
    if options.distortion_scale:
        distortion = ray_distortion(along.weights, steps.t, steps.deltas, options.distortion_scale)
    if options.sparsity:
        sparsity = ray_sparsity(marched.density, steps.deltas)
    corners, parameters = grid.voxels.tables(grid.density.device)[0], grid.row_parameters()
    variation = {
        name: total_variation(parameters[name], corners[a:b], options.colour_channels if name == "sh" else None)
        for name, (a, b) in options.variation.items()
    }
    return RayRender(
        summed(grid.rgb_at, request.rgb_rays, weight, 3) if grid.sh is not None else None,
        summed(grid.thermal_at, request.thermal_rays, thermal_weight, 1),
        along.transmittance,
        along.accumulation,
        depth.detach(),
        distortion,
        sparsity,
        variation,
    )


def samples(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> GridSamples:
    """March rays and list their samples; neither colour nor temperature is read."""
    marched = march(grid, request, options)
    weights = marched.along.weights
    before = torch.cumsum(weights, -1) - weights
    weight, before = weights.flatten()[marched.active], before.flatten()[marched.active]
    return GridSamples(marched.ray, marched.at, weight, before, marched.along.transmittance)


def total_variation(
    rows: Float[Tensor, "rows c"],
    corners: Int64[Tensor, "voxels 8"],
    channels: int | None = None,
) -> Float[Tensor, ""]:
    """Mean over voxels and channels of sqrt(dx^2 + dy^2 + dz^2), differences from corner 0 (Plenoxels, eq. 4).

    `corners` are rows of voxels in the order of `lattice.CORNER_OFFSETS`; `channels` are those of which the mean is
    taken, 0 where they have no column, by default the columns.
    """
    columns = rows.shape[1]
    channels = columns if channels is None else channels
    here = rows[corners[:, 0]]
    dz, dy, dx = rows[corners[:, 1]] - here, rows[corners[:, 2]] - here, rows[corners[:, 4]] - here
    total = torch.sum(torch.sqrt(dx * dx + dy * dy + dz * dz + SMALLEST_VARIATION)) / (len(corners) * channels)
    return total + (1.0 - columns / channels) * math.sqrt(SMALLEST_VARIATION)
