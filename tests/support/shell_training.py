"""Train one step on a lattice of which only a shell is kept, and print what it took in memory, [bytes], as json.

A script, so that a test can look at a process that does nothing else.
"""

import json
import sys

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
    with open("/proc/self/status", encoding="ascii") as status:
        return next(1024 * int(line.split()[1]) for line in status if line.startswith(kind))


def keep_shell(grid: VoxelGrid, share: float):
    """Keep the voxels next to a sphere, `share` of the lattice."""
    shape = np.array(grid.lattice.cell_shape)
    index = np.stack(np.unravel_index(grid.voxels.cells, tuple(shape)), 1).astype(np.float32)
    distance = np.abs(np.linalg.norm(index + 0.5 - shape / 2, axis=1) - 0.35 * shape[0])
    return prune(grid, distance <= np.partition(distance, int(share * shape.prod()) - 1)[int(share * shape.prod()) - 1])


def main(resolution: int, share: float, sh_degree: int) -> None:
    """Refine to the resolution as a training does, with optimiser state, and take a step there."""
    torch.set_num_threads(1)
    imports = resident("VmRSS")
    grid = VoxelGrid(Lattice.covering((-1, -1, -1), (1, 1, 1), 64), sh_degree, activation="exp", start_density=1.0)
    optimizers = {name: RowAdam([p], lr=1e-3) for name, p in grid.row_parameters().items()}
    generator = torch.Generator().manual_seed(0)

    def change(how) -> None:
        old = grid.row_parameters()
        moved = how()
        for name, new in grid.row_parameters().items():
            optimizers[name].change_rows(old[name], new, moved)

    def step() -> MemoryNeed:
        wants_rgb = torch.arange(8192) < 4096
        origins = torch.nn.functional.normalize(torch.randn(8192, 3, generator=generator), dim=-1) * 3.0
        aims = torch.randn(8192, 3, generator=generator) * 0.3
        directions = torch.nn.functional.normalize(aims - origins, dim=-1)
        variation = {name: (0, max(1, len(grid.voxels) // 10)) for name in grid.row_parameters()}
        options = RenderOptions(distortion_scale=2.0, early_stop=1e-5, variation=variation)
        seen = fused_render(grid, RayRequest(origins, directions, 0.0, None, wants_rgb, ~wants_rgb), options)
        loss = seen.rgb.sum() + seen.thermal.sum() + seen.distortion.sum() + sum(seen.variation.values())
        loss.backward()
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
    need, voxels, shape = step(), grid.voxels, grid.lattice.cell_shape
    figures = {"imports": imports, "peak": resident("VmHWM"), "most_predicted": most * 1e9, "predicted_rows": need.rows}
    shown = {"rows": voxels.num_rows, "share": len(voxels) / float(np.prod(shape)), "resolution": shape[0]}
    print(json.dumps(figures | shown))


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]), *map(int, sys.argv[3:]))
