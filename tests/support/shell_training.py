"""Train one step on a lattice of which only a shell is kept, and print what it took in memory, [bytes].

A script, so that a test can look at a process that does nothing else. Prints a line of json: the resident memory after
the imports, the peak, the bytes that stay, and what was predicted.
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


def main(resolution: int, share: float, sh_degree: int = 2, start: int = 64) -> None:
    """Refine to the resolution as a training does, with optimiser state, and take a step there."""
    torch.set_num_threads(1)
    imports = resident("VmRSS")
    lattice = Lattice.covering((-1, -1, -1), (1, 1, 1), start)
    grid = VoxelGrid(lattice, sh_degree, activation="exp", start_density=1.0)
    optimizers = {name: RowAdam([p], lr=1e-3) for name, p in grid.row_parameters().items()}

    def change(how) -> None:
        old = grid.row_parameters()
        moved = how()
        for name, new in grid.row_parameters().items():
            optimizers[name].change_rows(old[name], new, moved)

    def prediction() -> MemoryNeed:
        channels = sum(p.shape[1] for p in grid.row_parameters().values())
        return memory_need(grid.lattice, len(grid.voxels), channels)

    def step() -> int:
        count = 4096
        generator = torch.Generator().manual_seed(0)
        origins = torch.nn.functional.normalize(torch.randn(2 * count, 3, generator=generator), dim=-1) * 3.0
        aims = torch.randn(2 * count, 3, generator=generator) * 0.3
        wants_rgb = torch.arange(2 * count) < count
        directions = torch.nn.functional.normalize(aims - origins, dim=-1)
        variation = {name: (0, max(1, len(grid.voxels) // 10)) for name in grid.row_parameters()}
        options = RenderOptions(distortion_scale=2.0, early_stop=1e-5, variation=variation)
        seen = fused_render(grid, RayRequest(origins, directions, 0.0, None, wants_rgb, ~wants_rgb), options)
        loss = seen.rgb.sum() + seen.thermal.sum() + seen.distortion.sum() + sum(seen.variation.values())
        loss.backward()
        gradients = 0
        for name, optimizer in optimizers.items():
            gradient = grid.row_parameters()[name].grad
            gradients += gradient._values().nbytes + gradient._indices().nbytes
            optimizer.step()
            optimizer.zero_grad()
        return gradients

    gradients, most = step(), prediction().gigabytes
    while grid.lattice.cell_shape[0] < resolution:
        change(lambda: keep_shell(grid, min(1.0, 1.5 * share)))
        change(lambda: refine(grid, 2))
        gradients, most = step(), max(most, prediction().gigabytes)
    change(lambda: keep_shell(grid, share))
    gradients = step()
    voxels = grid.voxels
    tables = (voxels.cells, voxels.corners, voxels.voxel_rows, voxels.block_slot, voxels.voxel_number)
    stays = sum(array.nbytes for array in tables) + gradients
    for name, parameter in grid.row_parameters().items():
        stays += parameter.nbytes + sum(values.nbytes for values in optimizers[name].state[parameter].values())
    need, shape = prediction(), grid.lattice.cell_shape
    figures = {"imports": imports, "peak": resident("VmHWM"), "stays": stays, "predicted": need.gigabytes * 1e9}
    figures |= {"rows": voxels.num_rows, "most_predicted": most * 1e9, "predicted_rows": need.rows}
    print(json.dumps(figures | {"share": len(voxels) / float(np.prod(shape)), "resolution": shape[0]}))


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]), *map(int, sys.argv[3:]))
