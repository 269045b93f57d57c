"""What training rays say about voxels and corners: how much of their weight falls where."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from thermoxels_ns.field.interpolation import splat
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.march import March


class RayMarcher(Protocol):
    """What is needed of a model here."""

    @property
    def grid(self) -> VoxelGrid:
        """The voxel grid."""
        ...

    def march_rays(self, origins: Tensor, directions: Tensor) -> March:
        """Sample and weigh rays."""
        ...


@dataclass(frozen=True)
class VoxelWeights:
    """Weights of rays per voxel, shape of the lattice's voxels."""

    largest: Float[Tensor, "x y z"]
    """Largest weight a sample in the voxel had on any ray."""
    total: Float[Tensor, "x y z"]
    """Sum of the weights of all samples in the voxel."""


@torch.no_grad()
def voxel_weights(model: RayMarcher, rays: Iterable[RayBundle]) -> VoxelWeights:
    """Accumulate ray weights in voxels."""
    lattice = model.grid.lattice
    nx, ny, nz = lattice.cell_shape
    device = model.grid.density.device
    largest, total = torch.zeros(nx * ny * nz, device=device), torch.zeros(nx * ny * nz, device=device)
    for bundle in rays:
        marched = model.march_rays(bundle.origins.to(device), bundle.directions.to(device))
        weights = marched.along.weights.flatten()[marched.active]
        corner = model.grid.locate(marched.positions).first_corner
        k, j = corner % lattice.shape[2], corner // lattice.shape[2] % lattice.shape[1]
        voxel = (corner // (lattice.shape[1] * lattice.shape[2]) * ny + j) * nz + k
        largest.scatter_reduce_(0, voxel, weights, reduce="amax")
        total.index_add_(0, voxel, weights)
    return VoxelWeights(largest.view(nx, ny, nz), total.view(nx, ny, nz))


@dataclass(frozen=True)
class CornerTemperature:
    """What thermal rays say about the lattice's corners."""

    thermal: Float[Tensor, " corners"]
    """Normalised temperature, in [0, 1], the range of what was measured; where no ray came, the stored value."""
    weight: Float[Tensor, " corners"]
    """Sum of the weights of the first-hit samples around the corner, shared out by the trilinear weights."""


@torch.no_grad()
def corner_temperature(model: RayMarcher, rays: Iterable[RayBundle]) -> CornerTemperature:
    """Average the temperature that rays see around each corner, each sample by its share of the pixel.

    A corner's own stored value is only ever used mixed with its neighbours', so an image can be right while single
    corners overshoot; the average over what rays used has no such freedom. Only first hits count: samples of rays that
    end on something (opacity above one half), before half of the ray's light is spent. What leaks through a surface
    measures nothing behind it.
    """
    grid = model.grid
    device, corners = grid.density.device, grid.lattice.num_corners
    total = torch.zeros(corners, 2, device=device)
    for bundle in rays:
        directions = bundle.directions.to(device)
        marched = model.march_rays(bundle.origins.to(device), directions)
        before = torch.cumsum(marched.along.weights, -1) - marched.along.weights
        first_hit = (before < 0.5) & (marched.along.accumulation > 0.5)[:, None]
        weights = torch.where(first_hit, marched.along.weights, torch.zeros_like(before)).flatten()
        weights = weights[marched.active][:, None]
        at = grid.locate(marched.positions)
        thermal = grid.thermal_at(at, directions[marched.rays_of(marched.active)])
        total += splat(torch.cat((weights * thermal, weights), -1), at, corners)
    weight = total[:, 1]
    stored = grid.temperature[:, 0]
    thermal = torch.where(weight > 0, total[:, 0] / weight.clamp(min=1e-30), stored)
    return CornerTemperature(thermal.clamp(0, 1), weight)


@dataclass(frozen=True)
class BackdropEvidence:
    """What rays show behind the box."""

    rays: int
    """Rays looked at."""
    unsaturated: float
    """Share of them that leave the box with more than half of their light still to come."""
    directions: Float[Tensor, "n 3"]
    """Directions of those rays."""


@torch.no_grad()
def backdrop_evidence(model: RayMarcher, rays: Iterable[RayBundle]) -> BackdropEvidence:
    """Find the rays that leave the box unsaturated."""
    device = model.grid.density.device
    seen, open_directions = 0, [torch.zeros(0, 3, device=device)]
    for bundle in rays:
        directions = bundle.directions.to(device)
        marched = model.march_rays(bundle.origins.to(device), directions)
        open_directions.append(directions[marched.along.transmittance > 0.5])
        seen += len(directions)
    found = torch.cat(open_directions)
    return BackdropEvidence(seen, len(found) / max(1, seen), found)
