"""The two renderers of a voxel grid: plain torch (reference) and compiled kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.field.interpolation import TrilinearPoints
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.compositing import (
    RaySteps,
    RayWeights,
    composite,
    ray_distortion,
    ray_sparsity,
    ray_weights,
    sample_box,
)
from thermoxels_ns.render.ray_render import RayRender, RayRequest, RenderOptions

Backend = Literal["auto", "reference", "fused"]


def choose_backend(backend: Backend, device: torch.device) -> Literal["reference", "fused"]:
    """Turn auto into the fastest backend of a device: the compiled kernels on a CPU, else the reference.

    Raises:
        ThermoxelsError: The compiled kernels are asked for on another device than the CPU.
    """
    if backend == "fused" and device.type != "cpu":
        remedy = "Pass --pipeline.model.backend auto, or --machine.device-type cpu."
        got = "fused, whose kernels run on the CPU"
        raise ThermoxelsError("backend", expected=f"auto or reference on {device.type}", got=got, remedy=remedy)
    if backend == "auto":
        return "fused" if device.type == "cpu" else "reference"
    return backend


def render_rays(grid: VoxelGrid, request: RayRequest, options: RenderOptions, backend: Backend) -> RayRender:
    """Render rays through a grid with the backend of choice."""
    if choose_backend(backend, grid.density.device) == "fused":
        return fused_render(grid, request, options)
    return reference_render(grid, request, options)


@dataclass(frozen=True)
class ReferenceSamples:
    """Samples of rays through the box, and what density makes of them."""

    steps: RaySteps
    density: Float[Tensor, "rays steps"]  # Density at the samples, 0 where nothing was asked, [1 / world unit]
    along: RayWeights
    active: Int64[Tensor, " n"]
    """Flat indices (into rays x steps) of the samples whose density was asked for, ascending."""
    positions: Float[Tensor, "n 3"]  # World positions of the active samples

    def rays_of(self, flat: Int64[Tensor, " m"]) -> Int64[Tensor, " m"]:
        """The ray each sample belongs to."""
        return flat // self.steps.t.shape[1]


def reference_march(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> ReferenceSamples:
    """Sample rays through the kept voxels and weigh the samples, in plain torch."""
    origins, directions, lattice = request.origins, request.directions, grid.lattice
    lo = torch.tensor(lattice.lo, dtype=origins.dtype, device=origins.device)
    hi = torch.tensor(lattice.hi, dtype=origins.dtype, device=origins.device)
    step = lattice.voxel_size / options.steps_per_voxel
    steps = sample_box(origins, directions, lo, hi, step, request.near, request.far)
    active = (steps.deltas > 0).flatten().nonzero()[:, 0]
    rays = active // steps.t.shape[1]
    positions = origins[rays] + directions[rays] * steps.t.flatten()[active][:, None]
    if not grid.voxels.all_kept:
        kept = grid.in_kept_voxel(positions)
        active, positions = active[kept], positions[kept]
    asked = grid.density_at(grid.locate(positions))
    density = torch.zeros_like(steps.t).flatten().index_put((active,), asked).view_as(steps.t)
    return ReferenceSamples(steps, density, ray_weights(density, steps.deltas), active, positions)


def reference_render(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> RayRender:
    """Render rays in plain torch: the twin that every faster renderer is tested against."""
    marched = reference_march(grid, request, options)
    at = grid.locate(marched.positions)

    def rows(query):
        def rows_at(flat: Tensor) -> Tensor:
            return query(at.select(torch.searchsorted(marched.active, flat)), request.directions[marched.rays_of(flat)])

        return rows_at

    def rgb_at(points: TrilinearPoints, directions: Tensor) -> Tensor:
        return grid.rgb_at(points, directions, options.sh_degree)

    seen = composite(
        marched.steps,
        marched.along,
        rows(rgb_at) if grid.sh is not None else None,
        rows(grid.thermal_at),
        request.rgb_rays,
        request.thermal_rays,
        thermal_moves_density=options.thermal_moves_density,
        smallest_weight=options.smallest_weight,
    )
    assert seen.thermal is not None
    steps = marched.steps
    distortion = sparsity = None
    if options.distortion_scale:
        distortion = ray_distortion(marched.along.weights, steps.t, steps.deltas, options.distortion_scale)
    if options.sparsity:
        sparsity = ray_sparsity(marched.density, steps.deltas)
    corners = grid.voxels.tables(grid.density.device)[0]
    parameters = grid.row_parameters()
    variation = {
        name: total_variation(
            parameters[name], corners[first:last], channels=options.colour_channels if name == "sh" else None
        )
        for name, (first, last) in options.variation.items()
    }
    return RayRender(
        seen.rgb,
        seen.thermal,
        marched.along.transmittance,
        marched.along.accumulation,
        seen.depth.detach(),
        distortion,
        sparsity,
        variation,
    )


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


def fused_render(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> RayRender:
    """Render rays with the compiled kernels."""
    from thermoxels_ns.render.fused import render

    return render(grid, request, options)


@dataclass(frozen=True)
class GridSamples:
    """Samples of rays in kept voxels, ray after ray, for statistics. No gradients."""

    ray: Int64[Tensor, " n"]  # Ray of each sample, ascending
    at: TrilinearPoints  # Where the samples lie
    weight: Float[Tensor, " n"]  # Share of the pixel
    before: Float[Tensor, " n"]  # Share of the pixel that is spent before the sample
    transmittance: Float[Tensor, " rays"]  # Share of the pixel that is left for the background


@torch.no_grad()
def sample_rays(grid: VoxelGrid, request: RayRequest, options: RenderOptions, backend: Backend) -> GridSamples:
    """March rays and list their samples; neither colour nor temperature is read."""
    if choose_backend(backend, grid.density.device) == "fused":
        from thermoxels_ns.render.fused import samples_without_gaps

        nothing = torch.zeros(len(request.origins), dtype=torch.bool)
        request = RayRequest(request.origins, request.directions, request.near, request.far, nothing, nothing)
        recorded = samples_without_gaps(grid, request, options)
        records = recorded.records
        ray = torch.repeat_interleave(torch.from_numpy(records.used))
        number, fraction = torch.from_numpy(records.number).long(), torch.from_numpy(records.fraction)
        weight, left = torch.from_numpy(records.weight), torch.from_numpy(records.transmittance)
        at = TrilinearPoints.placed(grid.voxels, number, fraction)
        return GridSamples(ray, at, weight, 1.0 - left - weight, torch.from_numpy(recorded.sums.transmittance))
    marched = reference_march(grid, request, options)
    weights = marched.along.weights
    before = torch.cumsum(weights, -1) - weights
    return GridSamples(
        marched.rays_of(marched.active),
        grid.locate(marched.positions),
        weights.flatten()[marched.active],
        before.flatten()[marched.active],
        marched.along.transmittance,
    )
