"""What lies outside the box: six lattices that reach from its faces to infinity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.kept_voxels import KeptVoxels
from thermoxels_ns.field.voxel_grid import DensityActivation, VoxelGrid


@dataclass(frozen=True)
class Segments:
    """Straight pieces of rays in the coordinates of the lattice, in the order in which each ray meets them."""

    ray: Int64[Tensor, " n"]  # The ray that each belongs to
    rank: Int64[Tensor, " n"]  # 0 for the first piece of a ray, 1 for the next
    origins: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]  # Unit vectors
    lengths: Float[Tensor, " n"]


class Surroundings(nn.Module):
    """Density, colour and temperature from the faces of the box to infinity.

    Through each face one looks into a frustum that widens without end. With q the coordinate across the face (1 on it;
    the box is -1 to 1) and p, r those along it, 1/q, p/q and r/q are coordinates in which the frustum is a box that
    ends at infinity, where 1/q = 0, and in which straight lines are straight. So the renderer of the box serves here
    too: the six boxes stand one behind the other in one lattice, with an empty layer of voxels between.

    The box, (2, 3), is in world units; a face is `across` voxels wide, infinity `deep` voxels away; density is
    [1 / voxel].
    """

    centre: Tensor
    half_sides: Tensor

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
        self.keep(layer < deep)

    @property
    def step(self) -> float:
        """Share of the way from a face to infinity, in 1 / distance, that a voxel spans."""
        return self.grid.lattice.voxel_size / self.deep

    def keep(self, chosen: np.ndarray) -> None:
        """Keep the voxels chosen by one boolean for each of the lattice's; only before a training."""
        voxels = KeptVoxels(self.grid.lattice, np.flatnonzero(chosen))
        rows = {name: values.data[: voxels.num_rows] for name, values in self.grid.row_parameters().items()}
        self.grid.replace_voxels(voxels, rows, keep_identity=True)

    def segments(
        self, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], far: Float[Tensor, " n"] | None = None
    ) -> Segments:
        """Cut rays where they pass from one frustum into another, from where they leave the box for good to `far`.

        A ray that misses the box begins where it is nearest to the box's middle, so that what a camera outside has
        before it stays empty.
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
