"""March rays through a density field: sample, skip voxels that are not kept, weigh. Fields are callables here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.render.compositing import RayWeights, ray_weights
from thermoxels_ns.render.sampling import RaySteps, sample_box


@dataclass(frozen=True)
class March:
    """Rays marched through the box."""

    steps: RaySteps
    density: Float[Tensor, "rays steps"]
    """Density at the samples, 0 where nothing was asked, [1 / world unit]."""
    along: RayWeights
    active: Int64[Tensor, " n"]
    """Flat indices (into rays x steps) of the samples whose density was asked for, ascending."""
    positions: Float[Tensor, "n 3"]
    """World positions of the active samples."""

    def active_index(self, flat: Int64[Tensor, " m"]) -> Int64[Tensor, " m"]:
        """Where the samples `flat` (all active) stand in `active`."""
        return torch.searchsorted(self.active, flat)

    def rays_of(self, flat: Int64[Tensor, " m"]) -> Int64[Tensor, " m"]:
        """The ray each sample belongs to."""
        return flat // self.steps.t.shape[1]


def march(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    lattice: Lattice,
    density_at: Callable[[Tensor], Tensor],
    keep: Callable[[Tensor], Tensor] | None = None,
    steps_per_voxel: float = 2.0,
    near: float | Float[Tensor, " rays"] = 0.0,
    far: Float[Tensor, " rays"] | None = None,
) -> March:
    """Sample rays inside the lattice and turn density into weights.

    Args:
        origins: Ray origins, world units.
        directions: Unit directions.
        lattice: Gives the box and the step: a voxel over `steps_per_voxel` (the paper: half a voxel).
        density_at: Maps positions (n, 3) to densities (n,), [1 / world unit].
        keep: Maps positions to booleans: samples it refuses have density 0 without being asked; None: ask all.
        steps_per_voxel: Samples per voxel edge.
        near: Distance in front of the camera where sampling starts, world units.
        far: Distance where it ends; None: at the box.

    Returns:
        Samples, densities and weights.
    """
    lo = torch.tensor(lattice.lo, dtype=origins.dtype, device=origins.device)
    hi = torch.tensor(lattice.hi, dtype=origins.dtype, device=origins.device)
    steps = sample_box(origins, directions, lo, hi, lattice.voxel_size / steps_per_voxel, near, far)
    active = (steps.deltas > 0).flatten().nonzero()[:, 0]
    rays = active // steps.t.shape[1]
    positions = origins[rays] + directions[rays] * steps.t.flatten()[active][:, None]
    if keep is not None:
        kept = keep(positions)
        active, positions = active[kept], positions[kept]
    asked = density_at(positions)
    density = torch.zeros_like(steps.t).flatten().index_put((active,), asked).view_as(steps.t)
    return March(steps, density, ray_weights(density, steps.deltas), active, positions)
