"""What training rays say about voxels and corners: how much of their weight falls where."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int64
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from thermoxels_ns.core.feature_rays import THERMAL_STREAM
from thermoxels_ns.field.interpolation import TrilinearPoints, splat
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.renderers import GridSamples


class RaySampler(Protocol):
    """What is needed of a model here."""

    @property
    def grid(self) -> VoxelGrid:
        """The voxel grid."""
        ...

    def sample_rays(self, origins: Tensor, directions: Tensor) -> GridSamples:
        """Sample and weigh rays."""
        ...


@dataclass(frozen=True)
class VoxelWeights:
    """Weights of rays per kept voxel."""

    largest: Float[Tensor, " voxels"]  # Largest weight a sample in the voxel had on any ray
    ends: Bool[Tensor, " voxels"]
    """Voxels in which some ray that ends on something (opacity above one half) has spent half of its weight."""


@torch.no_grad()
def voxel_weights(model: RaySampler, rays: Iterable[RayBundle]) -> VoxelWeights:
    """Find how much of a ray each voxel ever held, and where rays end."""
    density = model.grid.density
    largest = torch.zeros(len(model.grid.voxels), device=density.device)
    ends = torch.zeros(len(model.grid.voxels), dtype=torch.bool, device=density.device)
    for bundle in rays:
        samples = model.sample_rays(bundle.origins.to(density.device), bundle.directions.to(density.device))
        largest.scatter_reduce_(0, samples.at.number, samples.weight.to(largest.dtype), reduce="amax")
        ends[samples.at.number[_half_way(samples)]] = True
    return VoxelWeights(largest, ends)


def _half_way(samples: GridSamples) -> Int64[Tensor, " ends"]:
    """Return, for each ray of opacity above one half, the sample by which half of its weight is spent."""
    opacity = (1.0 - samples.transmittance)[samples.ray]
    spent = (opacity > 0.5) & (samples.before + samples.weight >= 0.5 * opacity)
    (places,) = spent.nonzero(as_tuple=True)
    ray = samples.ray[places]
    first = torch.ones_like(ray, dtype=torch.bool)
    first[1:] = ray[1:] != ray[:-1]
    return places[first]


@torch.no_grad()
def share_of_rays_opened(model: RaySampler, rays: Iterable[RayBundle], keep: Bool[Tensor, " voxels"]) -> float:
    """Return the share of the rays of opacity above one half that lose more than half of their weight.

    Only voxels of `keep` stay. Removing thin, half-transparent voxels lets no ray through; removing a body does.
    """
    device = model.grid.density.device
    hit, opened = 0, 0
    for bundle in rays:
        samples = model.sample_rays(bundle.origins.to(device), bundle.directions.to(device))
        lost = torch.zeros_like(samples.transmittance)
        goes = ~keep[samples.at.number]
        lost.index_add_(0, samples.ray[goes], samples.weight[goes].to(lost.dtype))
        opacity = 1.0 - samples.transmittance
        hit += int((opacity > 0.5).sum())
        opened += int(((opacity > 0.5) & (lost > 0.5 * opacity)).sum())
    return opened / max(1, hit)


END_WIDTH = 0.5
"""A ray meets the voxels that it crosses this much before and after the point where half of its weight is spent,
[voxels]. A sharp surface may lie anywhere in a voxel: if it lies behind the centre, that voxel is empty at its centre
although rays end in it, and the solid begins with the next one, whose centre is at most half a voxel farther in."""
_END_STEPS = 5


@dataclass(frozen=True)
class CornerTemperature:
    """What thermal rays say about the stored corners."""

    thermal: Float[Tensor, " rows"]
    """Normalised temperature, in [0, 1], the range of what was measured; where no ray came, the stored value."""
    weight: Float[Tensor, " rows"]
    """Sum of the weights of the first-hit samples around the corner, shared out by the trilinear weights."""


@dataclass(frozen=True)
class FieldEvidence:
    """What training rays say about the trained field."""

    rays: int  # Rays looked at
    temperature: CornerTemperature  # What the thermal ones among them measured
    voxel_weight: Float[Tensor, " voxels"]  # Sum of the weights that rays spent in each kept voxel, [rays]
    voxel_ends: Float[Tensor, " voxels"]
    """Number of rays that end on something (opacity above one half) and have spent half of their weight in each kept
    voxel, [rays]."""
    half_depth_density: Float[Tensor, " ends"]
    """One density per ray of opacity above one half, in the order of the rays, [1 / world unit]: the highest at the
    centres of the voxels that it crosses within `END_WIDTH` of the point at which half of its weight is spent."""


@torch.no_grad()
def field_evidence(model: RaySampler, rays: Iterable[RayBundle]) -> FieldEvidence:
    """Find in one pass where rays spend their weight, and what temperature thermal rays see around each corner.

    The temperature is the mean over thermal rays, each sample weighted by its share of the pixel: images can be right
    while values stored at single corners overshoot, but this mean cannot. Only first hits count for it: samples of rays
    of opacity above one half, before half of the ray's light is spent, so that light which leaks through a surface
    measures nothing behind it. A ray without a stream (see `core.feature_rays`) counts as thermal too.
    """
    grid = model.grid
    device = grid.density.device
    centre_density = grid.voxel_density()
    corners = torch.zeros(grid.voxels.num_rows, 2, device=device)
    voxels = torch.zeros(len(grid.voxels), dtype=torch.float64, device=device)
    ends = torch.zeros_like(voxels)
    half_depth = [centre_density.view(-1)[:0]]
    seen = 0
    for bundle in rays:
        directions = bundle.directions.to(device)
        samples = model.sample_rays(bundle.origins.to(device), directions)
        seen += len(directions)
        voxels.index_add_(0, samples.at.number, samples.weight.double())
        half_way = _half_way(samples)
        at_half, ray = samples.at.select(half_way), samples.ray[half_way]
        ends += torch.bincount(at_half.number, minlength=len(ends))
        half_depth.append(_density_met(grid, centre_density, at_half, directions[ray]))
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
    return FieldEvidence(seen, CornerTemperature(thermal.clamp(0, 1), weight), voxels, ends, torch.cat(half_depth))


def _density_met(
    grid: VoxelGrid, centre_density: Float[Tensor, "x y z"], at: TrilinearPoints, directions: Float[Tensor, "n 3"]
) -> Float[Tensor, " n"]:
    """Return the highest density at the centre of a voxel within `END_WIDTH` of points along unit directions."""
    shape = torch.tensor(grid.lattice.cell_shape, device=centre_density.device)
    voxel = torch.stack(torch.unravel_index(grid.cells[at.number], grid.lattice.cell_shape), -1)
    met = torch.zeros(len(voxel), dtype=centre_density.dtype, device=centre_density.device)
    for offset in torch.linspace(-END_WIDTH, END_WIDTH, _END_STEPS).tolist():
        there = voxel + torch.floor(at.fraction + offset * directions.to(at.fraction.dtype)).long()
        inside = ((there >= 0) & (there < shape)).all(-1)
        x, y, z = there.clamp(min=0).minimum(shape - 1).unbind(-1)
        met = torch.where(inside, torch.maximum(met, centre_density[x, y, z]), met)
    return met


@torch.no_grad()
def backdrop_evidence(model: RaySampler, rays: Iterable[RayBundle]) -> tuple[float, Float[Tensor, "n 3"]]:
    """Return share and directions of the rays that leave the box with more than half of their light."""
    device = model.grid.density.device
    seen, open_directions = 0, [torch.zeros(0, 3, device=device)]
    for bundle in rays:
        directions = bundle.directions.to(device)
        samples = model.sample_rays(bundle.origins.to(device), directions)
        open_directions.append(directions[samples.transmittance > 0.5])
        seen += len(directions)
    found = torch.cat(open_directions)
    return len(found) / max(1, seen), found
