"""Compile the kernels before the first step, and say so where it takes time; numba keeps the result."""

from __future__ import annotations

import threading
from collections.abc import Callable

import torch

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import fused_render
from thermoxels_ns.training.optimizers import RowAdam

SILENT_SECONDS = 1.0
"""Loading kernels that were compiled before takes less."""


def compile_kernels(say: Callable[[str], None]) -> None:
    """Run every kernel once on a few rays.

    Args:
        say: Told what is going on if it takes longer than `SILENT_SECONDS`.
    """
    notice = threading.Timer(
        SILENT_SECONDS, say, ("compiling the kernels for this processor: 10 to 30 s, the first time",)
    )
    notice.daemon = True
    notice.start()
    try:
        grid = VoxelGrid(Lattice((-1.0, -1.0, -1.0), 1.0, (3, 3, 3)))
        generator = torch.Generator().manual_seed(0)
        origins = 3.0 * torch.nn.functional.normalize(torch.randn(4, 3, generator=generator), dim=-1)
        request = RayRequest(origins, torch.nn.functional.normalize(-origins, dim=-1))
        variation = {name: (0, 2) for name in grid.row_parameters()}
        seen = fused_render(grid, request, RenderOptions(distortion_scale=1.0, sparsity=True, variation=variation))
        assert seen.rgb is not None
        (seen.rgb.sum() + seen.thermal.sum() + sum(seen.variation.values())).backward()
        RowAdam(list(grid.parameters())).step()
    finally:
        notice.cancel()
