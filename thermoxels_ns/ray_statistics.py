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


@torch.no_grad()
def corner_weight(model: RayMarcher, rays: Iterable[RayBundle]) -> Float[Tensor, " corners"]:
    """Sum over rays of each sample's weight, shared among its voxel's corners by the trilinear weights."""
    device = model.grid.density.device
    total = torch.zeros(model.grid.lattice.num_corners, 1, device=device)
    for bundle in rays:
        marched = model.march_rays(bundle.origins.to(device), bundle.directions.to(device))
        weights = marched.along.weights.flatten()[marched.active][:, None]
        total += splat(weights, model.grid.locate(marched.positions), len(total))
    return total[:, 0]


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
