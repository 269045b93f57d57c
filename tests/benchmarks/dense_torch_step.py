"""A training step as published voxel code would be written in plain torch for a CPU: the baseline of `step_speed`.

A dense lattice without skipping: every sample along every ray reads all values of its eight corners, autograd goes back
through all of them, and RMSprop passes over the whole lattice. Same rays and step length as the fused step; what it
does not do (distortion, total variation) makes it look quicker, not slower.
"""

from __future__ import annotations

import time

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from thermoxels_ns.field.harmonics import harmonics
from thermoxels_ns.field.voxel_grid import VoxelGrid, activate_density
from thermoxels_ns.lattice import CORNER_OFFSETS
from thermoxels_ns.render.compositing import ray_weights
from thermoxels_ns.render.sampling import sample_box


def dense_step_seconds(grid: VoxelGrid, rays: RayBundle, steps_per_voxel: float, rays_at_once: int = 2048) -> float:
    """Time one step, forward, backward and RMSprop, on a dense copy of a grid.

    Args:
        grid: The grid; corners of no kept voxel get its smallest density.
        rays: A training batch; all its rays ask for colour and temperature, as rays of a shared camera do.
        steps_per_voxel: Samples per voxel edge.
        rays_at_once: Rays per part; gradients add up. All at once would take about 10 GB.

    Returns:
        Seconds of wall time.
    """
    lattice = grid.lattice
    with torch.no_grad():
        parts = [grid.corner_values(grid.density[:, 0], float(grid.density.min()))[..., None]]
        for values in (grid.sh, grid.temperature):
            assert values is not None
            parts.append(torch.stack([grid.corner_values(column) for column in values.T], dim=-1))
        table = torch.cat(parts, dim=-1).reshape(lattice.num_corners, -1).contiguous()
    table.requires_grad_()
    optimizer = torch.optim.RMSprop([table], lr=1e-6, alpha=0.95)
    lo, hi = torch.tensor(lattice.lo).float(), torch.tensor(lattice.hi).float()
    last_cell = torch.tensor(lattice.cell_shape) - 1
    strides = torch.tensor([lattice.shape[1] * lattice.shape[2], lattice.shape[2], 1])
    offsets = torch.from_numpy(CORNER_OFFSETS)

    def loss_of(origins: Tensor, directions: Tensor) -> Tensor:
        steps = sample_box(origins, directions, lo, hi, lattice.voxel_size / steps_per_voxel)
        points = origins[:, None] + directions[:, None] * steps.t[..., None]
        place = (points - lo) / lattice.voxel_size
        cell = torch.minimum(place.floor().long().clamp(min=0), last_cell)
        fraction = (place - cell)[..., None, :]
        corners = ((cell[..., None, :] + offsets) * strides).sum(-1)
        shares = torch.where(offsets.bool(), fraction, 1.0 - fraction).prod(-1)
        values = (table[corners] * shares[..., None]).sum(-2)
        weights = ray_weights(activate_density(values[..., 0], grid.activation), steps.deltas).weights[..., None]
        colours = values[..., 1:-1].unflatten(-1, (3, -1))
        basis = harmonics(directions, grid.sh_degree or 0)[:, None, None]
        rgb = (weights * torch.sigmoid((colours * basis).sum(-1))).sum(1)
        thermal = (weights.detach() * values[..., -1:]).sum(1)
        return rgb.square().sum() + thermal.square().sum()

    start = time.perf_counter()
    optimizer.zero_grad()
    for first in range(0, len(rays.origins), rays_at_once):
        part = slice(first, first + rays_at_once)
        loss_of(rays.origins[part], rays.directions[part]).backward()
    optimizer.step()
    return time.perf_counter() - start
