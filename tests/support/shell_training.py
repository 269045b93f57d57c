"""Train one step on a lattice of which only a shell is kept, and print what it took in memory, [bytes], as json.

A script, so that a test can look at a process that does nothing else.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.kept_voxels import MemoryNeed, memory_need
from thermoxels_ns.field.refine import prune, refine
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.fused import render as fused_render
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.training.optimizers import RowAdam


def resident(kind: str) -> int:
    """Resident memory of this process: VmRSS now, VmHWM at its peak."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(kind))


def keep_shell(grid: VoxelGrid, share: float):
    """Keep the voxels next to a sphere, `share` of the lattice."""
    shape = np.array(grid.lattice.cell_shape)
    index = np.stack(np.unravel_index(grid.voxels.cells, tuple(shape)), 1).astype(np.float32)
    distance = np.abs(np.linalg.norm(index + 0.5 - shape / 2, axis=1) - 0.35 * shape[0])
    return prune(grid, distance <= np.partition(distance, int(share * shape.prod()) - 1)[int(share * shape.prod()) - 1])


def main(resolution: int, share: float) -> None:
    """Refine to the resolution as a training does, with optimiser state, and take a step there."""
    torch.set_num_threads(1)
    imports = resident("VmRSS")
    grid = VoxelGrid(Lattice.covering((-1, -1, -1), (1, 1, 1), 64), 2, activation="exp", start_density=1.0)
    optimizers = {name: RowAdam([p], lr=1e-3) for name, p in grid.row_parameters().items()}
    generator = torch.Generator().manual_seed(0)

    def change(how) -> None:
        old = grid.row_parameters()
        moved = how()
        for name, new in grid.row_parameters().items():
            optimizers[name].follow(old[name], new, moved)

    def step() -> MemoryNeed:
        wants_rgb = torch.arange(8192) < 4096
        origins = torch.nn.functional.normalize(torch.randn(8192, 3, generator=generator), dim=-1) * 3.0
        directions = torch.nn.functional.normalize(0.3 * torch.randn(8192, 3, generator=generator) - origins, dim=-1)
        variation = {name: (0, max(1, len(grid.voxels) // 10)) for name in grid.row_parameters()}
        options = RenderOptions(distortion_scale=2.0, early_stop=1e-5, variation=variation)
        seen = fused_render(grid, RayRequest(origins, directions, 0.0, None, wants_rgb, ~wants_rgb), options)
        (seen.rgb.sum() + seen.thermal.sum() + seen.distortion.sum() + sum(seen.variation.values())).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        channels = sum(p.shape[1] for p in grid.row_parameters().values())
        return memory_need(grid.lattice, len(grid.voxels), channels)

    most = step().gigabytes
    while grid.lattice.cell_shape[0] < resolution:
        change(lambda: keep_shell(grid, min(1.0, 1.5 * share)))
        change(lambda: refine(grid, 2))
        most = max(most, step().gigabytes)
    change(lambda: keep_shell(grid, share))
    need, voxels = step(), grid.voxels
    taken = {"taken": resident("VmHWM") - imports, "most_predicted": most * 1e9}
    print(json.dumps(taken | {"rows": voxels.num_rows, "predicted_rows": need.rows}))


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
