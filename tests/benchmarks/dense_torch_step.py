"""A training step as published voxel code would be written in plain torch for a CPU: the baseline of `step_speed`.

A dense lattice without skipping: every sample along every ray reads all values of its eight corners, autograd goes back
through all of them, and RMSprop passes over the whole lattice. Same rays and step length as the fused step, and the
same colours, temperatures and gradients (tests/reference/test_fused_rendering.py); what it does not do (distortion,
total variation) makes it look quicker, not slower.
"""

import time

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from thermoxels_ns.core.lattice import CORNER_OFFSETS
from thermoxels_ns.field.harmonics import harmonics
from thermoxels_ns.field.voxel_grid import VoxelGrid, activate_density
from thermoxels_ns.render.reference import ray_weights, sample_box


class DenseField:
    """All values of a grid on all corners of its lattice.

    Args:
        grid: The grid; corners of no kept voxel get its smallest density.
        steps_per_voxel: Samples per voxel edge.
    """

    def __init__(self, grid: VoxelGrid, steps_per_voxel: float) -> None:
        lattice = grid.lattice
        with torch.no_grad():
            parts = [grid.corner_values(grid.density[:, 0], float(grid.density.min()))[..., None]]
            for values in (grid.sh, grid.temperature):
                assert values is not None
                parts.append(torch.stack([grid.corner_values(column) for column in values.T], dim=-1))
            self.table = torch.cat(parts, dim=-1).reshape(lattice.num_corners, -1).contiguous()
        self.table.requires_grad_()
        self._lo, self._hi = torch.tensor(lattice.lo).float(), torch.tensor(lattice.hi).float()
        self._last_cell = torch.tensor(lattice.cell_shape) - 1
        self._strides = torch.tensor([lattice.shape[1] * lattice.shape[2], lattice.shape[2], 1])
        self._offsets = torch.from_numpy(CORNER_OFFSETS)
        self._voxel_size, self._step = lattice.voxel_size, lattice.voxel_size / steps_per_voxel
        self._degree, self._activation = grid.sh_degree or 0, grid.activation

    def render(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Colour (rays, 3) and temperature (rays, 1) of rays; temperature does not move density."""
        steps = sample_box(origins, directions, self._lo, self._hi, self._step)
        points = origins[:, None] + directions[:, None] * steps.t[..., None]
        place = (points - self._lo) / self._voxel_size
        cell = torch.minimum(place.floor().long().clamp(min=0), self._last_cell)
        fraction = (place - cell)[..., None, :]
        corners = ((cell[..., None, :] + self._offsets) * self._strides).sum(-1)
        shares = torch.where(self._offsets.bool(), fraction, 1.0 - fraction).prod(-1)
        values = (self.table[corners] * shares[..., None]).sum(-2)
        weights = ray_weights(activate_density(values[..., 0], self._activation), steps.deltas).weights[..., None]
        colours = values[..., 1:-1].unflatten(-1, (3, -1))
        basis = harmonics(directions, self._degree)[:, None, None]
        rgb = (weights * torch.sigmoid((colours * basis).sum(-1))).sum(1)
        return rgb, (weights.detach() * values[..., -1:]).sum(1)


def dense_step_seconds(grid: VoxelGrid, rays: RayBundle, steps_per_voxel: float, rays_at_once: int = 2048) -> float:
    """Time one step, forward, backward and RMSprop, on a dense copy of a grid.

    Args:
        grid: The grid.
        rays: A training batch; all its rays ask for colour and temperature, as rays of a shared camera do.
        steps_per_voxel: Samples per voxel edge.
        rays_at_once: Rays per part; gradients add up. All at once would take about 10 GB.

    Returns:
        Seconds of wall time.
    """
    field = DenseField(grid, steps_per_voxel)
    optimizer = torch.optim.RMSprop([field.table], lr=1e-6, alpha=0.95)
    start = time.perf_counter()
    optimizer.zero_grad()
    for first in range(0, len(rays.origins), rays_at_once):
        part = slice(first, first + rays_at_once)
        rgb, thermal = field.render(rays.origins[part], rays.directions[part])
        (rgb.square().sum() + thermal.square().sum()).backward()
    optimizer.step()
    return time.perf_counter() - start
