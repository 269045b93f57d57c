"""Statistics of training rays: their weights in voxels, and the temperatures that they measure at corners."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import torch
from jaxtyping import Bool, Float, Int64
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from thermoxels_ns.core.feature_rays import THERMAL_STREAM
from thermoxels_ns.core.snapshot import RayEvidence
from thermoxels_ns.field.interpolation import splat
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.renderers import GridSamples

Sampler = Callable[[Tensor, Tensor], GridSamples]
"""A function from origins and directions of rays, (n, 3) each, to the rays' samples in kept voxels of a grid."""


def _sampled(
    grid: VoxelGrid, sample: Sampler, rays: Iterable[RayBundle]
) -> Iterator[tuple[RayBundle, Tensor, GridSamples]]:
    """Yield each batch of rays, its directions on the device of the grid, and its samples."""
    device = grid.density.device
    for bundle in rays:
        directions = bundle.directions.to(device)
        yield bundle, directions, sample(bundle.origins.to(device), directions)


@torch.no_grad()
def voxel_weights(
    grid: VoxelGrid, sample: Sampler, rays: Iterable[RayBundle]
) -> tuple[Float[Tensor, " voxels"], Bool[Tensor, " voxels"]]:
    """Return for each kept voxel the largest weight of a sample in it, and whether some ray ends in it. Only a ray of
    opacity above one half ends: at the sample that completes half of its weight."""
    device = grid.density.device
    largest = torch.zeros(len(grid.voxels), device=device)
    ends = torch.zeros(len(grid.voxels), dtype=torch.bool, device=device)
    for _, _, samples in _sampled(grid, sample, rays):
        largest.scatter_reduce_(0, samples.at.number, samples.weight.to(largest.dtype), reduce="amax")
        ends[samples.at.number[_half_way(samples)]] = True
    return largest, ends


def _half_way(samples: GridSamples) -> Int64[Tensor, " ends"]:
    """Return the index of the sample that completes half of a ray's weight, for each ray of opacity above one half."""
    opacity = (1.0 - samples.transmittance)[samples.ray]
    spent = (opacity > 0.5) & (samples.before + samples.weight >= 0.5 * opacity)
    (places,) = spent.nonzero(as_tuple=True)
    ray = samples.ray[places]
    first = torch.ones_like(ray, dtype=torch.bool)
    first[1:] = ray[1:] != ray[:-1]
    return places[first]


@torch.no_grad()
def share_of_rays_opened(
    grid: VoxelGrid, sample: Sampler, rays: Iterable[RayBundle], keep: Bool[Tensor, " voxels"]
) -> float:
    """Return the share of rays that pruning to the voxels True in `keep` would open, of rays of opacity above 1/2. A
    ray is opened if more than half of its weight lies in voxels that are False in `keep`."""
    hit, opened = 0, 0
    for _, _, samples in _sampled(grid, sample, rays):
        lost = torch.zeros_like(samples.transmittance)
        goes = ~keep[samples.at.number]
        lost.index_add_(0, samples.ray[goes], samples.weight[goes].to(lost.dtype))
        opacity = 1.0 - samples.transmittance
        hit += int((opacity > 0.5).sum())
        opened += int(((opacity > 0.5) & (lost > 0.5 * opacity)).sum())
    return opened / max(1, hit)


END_WIDTH = 0.5
"""Distance, [voxels], from the sample that completes half of a ray's weight, forwards and backwards, within which the
ray meets the voxels that it crosses. If a sharp surface lies behind the centre of a voxel, the voxel is empty at its
centre although rays end in it; the solid begins with the next voxel, whose centre is at most half a voxel farther."""
_END_STEPS = 5


@torch.no_grad()
def field_evidence(
    grid: VoxelGrid, sample: Sampler, rays: Iterable[RayBundle]
) -> tuple[Float[Tensor, " rows"], Float[Tensor, " rows"], RayEvidence | None]:
    """Return the temperature and the observed weight of each row, and the evidence of where training rays end.

    The temperature, normalised and clipped to [0, 1], is the mean of the field over first-hit samples of thermal rays
    around the row's corner, by weight and trilinear weight; without such a sample, it is the stored temperature. Stored
    values of single corners can overshoot although images are right, but this mean cannot. The observed weight, [rays],
    is the sum of these weights. First-hit samples are the samples, of rays of opacity above one half, before half of
    the light is spent: light that leaks through a surface measures nothing behind it. A ray without a stream (see
    `core.feature_rays`) counts as thermal. The evidence is None if there are no rays.
    """
    device = grid.density.device
    centre_density = grid.voxel_density()
    corners = torch.zeros(grid.voxels.num_rows, 2, device=device)
    ends, along = [corners.new_zeros(0, 3)], [corners.new_zeros(0, 3)]
    half_depth = [centre_density.view(-1)[:0]]
    seen = False
    for bundle, directions, samples in _sampled(grid, sample, rays):
        seen |= len(directions) > 0
        half_way = _half_way(samples)
        at_half, ray = samples.at.select(half_way), samples.ray[half_way]
        voxel = torch.stack(torch.unravel_index(grid.cells[at_half.number], grid.lattice.cell_shape), -1)
        ends.append((voxel + at_half.fraction).to(corners.dtype))
        along.append(directions[ray].to(corners.dtype))
        half_depth.append(_density_met(centre_density, voxel, at_half.fraction, directions[ray]))
        stream = bundle.metadata.get("stream")
        ends_here = samples.transmittance < 0.5
        if stream is not None:
            ends_here &= (stream[:, 0].to(device) & THERMAL_STREAM) > 0
        first_hit = (samples.before < 0.5) & ends_here[samples.ray]
        at = samples.at.select(first_hit)
        weights = samples.weight[first_hit][:, None]
        thermal = grid.thermal_at(at, directions[samples.ray[first_hit]])
        corners += splat(torch.cat((weights * thermal, weights), -1), at).to(corners.dtype)
    weight = corners[:, 1]
    stored = grid.temperature[:, 0]
    thermal = torch.where(weight > 0, corners[:, 0] / weight.clamp(min=1e-30), stored)
    evidence = None
    if seen:
        evidence = RayEvidence(*(torch.cat(parts).float().cpu().numpy() for parts in (half_depth, ends, along)))
    return thermal.clamp(0, 1), weight, evidence


def _density_met(
    centre_density: Float[Tensor, "x y z"],
    voxel: Int64[Tensor, "n 3"],
    fraction: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
) -> Float[Tensor, " n"]:
    """Return for each point the highest density at centres of voxels met within `END_WIDTH` along its direction. A
    point lies in the voxel of index `voxel`, at `fraction` of this voxel along each axis."""
    shape = torch.tensor(centre_density.shape, device=centre_density.device)
    met = torch.zeros(len(voxel), dtype=centre_density.dtype, device=centre_density.device)
    for offset in torch.linspace(-END_WIDTH, END_WIDTH, _END_STEPS).tolist():
        there = voxel + torch.floor(fraction + offset * directions.to(fraction.dtype)).long()
        inside = ((there >= 0) & (there < shape)).all(-1)
        x, y, z = there.clamp(min=0).minimum(shape - 1).unbind(-1)
        met = torch.where(inside, torch.maximum(met, centre_density[x, y, z]), met)
    return met


@torch.no_grad()
def backdrop_evidence(
    grid: VoxelGrid, sample: Sampler, rays: Iterable[RayBundle]
) -> tuple[float, Float[Tensor, "n 3"]]:
    """Return the share, of all rays, and the directions of rays that leave the box with over half of their light."""
    seen, open_directions = 0, [torch.zeros(0, 3, device=grid.density.device)]
    for _, directions, samples in _sampled(grid, sample, rays):
        open_directions.append(directions[samples.transmittance > 0.5])
        seen += len(directions)
    found = torch.cat(open_directions)
    return len(found) / max(1, seen), found
