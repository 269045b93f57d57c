"""The space outside the box: a frustum from each face to infinity, and colour and temperature at infinity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.harmonics import MAX_DEGREE, harmonics_with_unit_mean, num_coefficients
from thermoxels_ns.field.kept_voxels import KeptVoxels
from thermoxels_ns.field.voxel_grid import DensityActivation, VoxelGrid


@dataclass(frozen=True)
class Segments:
    """Straight pieces of rays in lattice coordinates of `Surroundings`, ray after ray, each ray from near to far."""

    ray: Int64[Tensor, " n"]  # Ray to which each piece belongs
    rank: Int64[Tensor, " n"]  # 0 for the first piece of a ray, 1 for the next
    origins: Float[Tensor, "n 3"]  # Begin of each piece
    directions: Float[Tensor, "n 3"]  # Unit vectors
    lengths: Float[Tensor, " n"]  # In lattice units


class Surroundings(nn.Module):
    """Density, colour and temperature from the faces of the box to infinity.

    A frustum reaches from each face to infinity. Scale the box to -1 to 1. Let q be the coordinate perpendicular to the
    face (1 on the face), and p and r the coordinates along it. In the coordinates 1/q, p/q and r/q the frustum is a
    box, infinity is its far side 1/q = 0, and straight lines stay straight. The six boxes stand in one lattice, one
    behind the other along x with an empty layer of voxels between, so that the renderers of a grid can render them.

    Args:
        box: Lower and upper corner, [world units].
        across: Width of a face at the start, [voxels].
        deep: Number of voxels from a face to infinity at the start.
        start_density: Density at the start, [1 / edge of a voxel at the start], the unit of all densities here.
        activation: See `VoxelGrid`.
        colour: False: no colour is stored.
    """

    centre: Tensor  # Middle of the box, (3,), world units
    half_sides: Tensor  # Half of each side of the box, (3,), world units

    def __init__(
        self,
        box: Float[Tensor, "2 3"],
        across: int,
        deep: int,
        start_density: float,
        activation: DensityActivation,
        colour: bool,
    ):
        super().__init__()
        self.across, self.deep = across, deep
        self.register_buffer("centre", 0.5 * (box[0] + box[1]))
        self.register_buffer("half_sides", 0.5 * (box[1] - box[0]))
        lattice = Lattice((0.0, 0.0, 0.0), 1.0, (6 * (deep + 1), across + 1, across + 1))
        self.grid = VoxelGrid(lattice, 0 if colour else None, 0, start_density, activation)
        layer = np.arange(np.prod(lattice.cell_shape)) // (across * across) % (deep + 1)
        voxels = KeptVoxels(lattice, np.flatnonzero(layer < deep))
        rows = {name: values.data[: voxels.num_rows] for name, values in self.grid.row_parameters().items()}
        self.grid.replace_voxels(voxels, rows, keep_identity=True)

    @property
    def step(self) -> float:
        """Change of 1/q across a voxel, where 1/q falls from 1 on a face of the box to 0 at infinity."""
        return self.grid.lattice.voxel_size / self.deep

    def segments(
        self, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], far: Float[Tensor, " n"] | None = None
    ) -> Segments:
        """Return the straight pieces, one per frustum, of rays from the point at which they leave the box to `far`.

        Rays and distances `far` are in world units; None: infinity. A ray that misses the box begins at its point
        nearest to the box's middle, so that the space before a camera outside the box is empty.
        """
        from thermoxels_ns.field.surroundings_kernels import MOST_SEGMENTS, cut_rays

        device, dtype = origins.device, origins.dtype
        at = ((origins.double() - self.centre) / self.half_sides).cpu().numpy()
        along = (directions.double() / self.half_sides).cpu().numpy()
        reach = np.full(len(at), np.inf) if far is None else far.double().cpu().numpy()
        ends = np.empty((MOST_SEGMENTS * len(at), 2, 3))
        ray, rank = (np.empty(len(ends), dtype=np.int64) for _ in range(2))
        count = cut_rays(at, along, reach, self.across, self.deep, ends, ray, rank)
        start, end = torch.from_numpy(ends[:count]).to(device).unbind(1)
        length = torch.linalg.norm(end - start, dim=1)
        towards = (end - start) / length.clamp(min=1e-12)[:, None]
        rays, ranks = (torch.from_numpy(values[:count]).to(device) for values in (ray, rank))
        return Segments(rays, ranks, start.to(dtype), towards.to(dtype), length.to(dtype))


RAYS_AT_ONCE = 8192
"""Most rays for which a background is evaluated together. Torch splits tensors of 32,768 entries or more among its
threads; the last bits of gradients and of some functions would then depend on the number of threads."""


def seen_behind(
    background: nn.Module, directions: Float[Tensor, "n 3"], wanted: Bool[Tensor, " n"] | None
) -> Float[Tensor, "n c"]:
    """Return colour or temperature of `background` along unit directions; 0 for rays that are False in `wanted`."""
    if wanted is None or bool(wanted.all()):
        if len(directions) <= RAYS_AT_ONCE:
            return background(directions)
        return torch.cat([background(part) for part in directions.split(RAYS_AT_ONCE)])
    (places,) = wanted.nonzero(as_tuple=True)
    values = seen_behind(background, directions[places], None)
    return values.new_zeros((len(directions), values.shape[1])).index_copy(0, places, values)


class SphereImage(nn.Module):
    """Colour at infinity: an equirectangular image around the z axis that holds colours before the sigmoid.

    Args:
        height: Number of rows from the +z pole to the -z pole; the image has twice as many columns.
    """

    def __init__(self, height: int = 32):
        super().__init__()
        self.image = nn.Parameter(torch.zeros(height, 2 * height, 3))

    def forward(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the colour seen along unit directions, interpolated bilinearly, each channel in [0, 1]."""
        height, width, _ = self.image.shape
        x, y, z = directions.unbind(-1)
        column = (torch.atan2(y, x) / (2 * math.pi) + 0.5) * width - 0.5
        row = (torch.acos(z.clamp(-1, 1)) / math.pi * height - 0.5).clamp(0, height - 1)
        left, top = column.floor(), row.floor().clamp(max=height - 2)
        s, t = (column - left)[:, None], (row - top)[:, None]
        j0, i0 = left.long() % width, top.long()
        j1, i1 = (j0 + 1) % width, i0 + 1
        upper = torch.lerp(self.image[i0, j0], self.image[i0, j1], s)
        lower = torch.lerp(self.image[i1, j0], self.image[i1, j1], s)
        return torch.sigmoid(torch.lerp(upper, lower, t))


class SkyTemperature(nn.Module):
    """Normalised temperature at infinity as a sum of spherical harmonics; 0 in every direction at the start."""

    def __init__(self) -> None:
        super().__init__()
        self.coefficients = nn.Parameter(torch.zeros(num_coefficients(MAX_DEGREE)))

    def forward(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
        """Return the normalised temperature seen along unit directions."""
        # BLAS splits a product over rays among its threads; the gradient of `embedding` adds rays in their order.
        one = torch.zeros(len(directions), dtype=torch.long, device=directions.device)
        coefficients = F.embedding(one, self.coefficients[None])
        return (harmonics_with_unit_mean(directions, MAX_DEGREE) * coefficients).sum(-1, keepdim=True)
