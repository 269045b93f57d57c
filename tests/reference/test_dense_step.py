"""The dense step in plain torch that `step_speed` compares with computes what the fused kernels do."""

import importlib.util
from pathlib import Path

import pytest
import torch
from torch.nn.functional import cosine_similarity

from tests.reference.two_renderers import random_grid
from thermoxels_ns.render.fused import render as fused_render
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions

_PATH = Path(__file__).parents[1] / "benchmarks" / "dense_torch_step.py"
_SPEC = importlib.util.spec_from_file_location("dense_torch_step", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
dense_torch_step = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(dense_torch_step)


@pytest.mark.parametrize("sh_degree", [0, 1, 2])
def test_a_dense_step_gives_the_colours_temperatures_and_gradients_of_the_fused_one(sh_degree: int) -> None:
    grid = random_grid(sh_degree, activation="exp", seed=3)
    generator = torch.Generator().manual_seed(5)
    origins = 3.0 * torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=-1)
    towards = 1.2 * (torch.rand(200, 3, generator=generator) - 0.5)
    directions = torch.nn.functional.normalize(towards - origins, dim=-1)
    dense = dense_torch_step.DenseField(grid, steps_per_voxel=2.0)
    rgb, thermal = dense.render(origins, directions)
    options = RenderOptions(steps_per_voxel=2.0, smallest_weight=0.0, early_stop=0.0)
    seen = fused_render(grid, RayRequest(origins, directions), options)
    assert seen.rgb is not None and float(rgb.max()) > 0.1
    assert torch.allclose(rgb, seen.rgb, rtol=1e-5, atol=1e-6)
    assert torch.allclose(thermal[:, 0], seen.thermal.reshape(-1), rtol=1e-5, atol=1e-6)
    (rgb.square().sum() + thermal.square().sum()).backward()
    (seen.rgb.square().sum() + seen.thermal.square().sum()).backward()
    rows = grid.row_parameters()
    gradient = torch.cat([rows[name].grad.to_dense() for name in ("density", "sh", "temperature")], dim=1)  # type: ignore[union-attr]
    mine, theirs = dense.table.grad.double(), gradient.double()
    corners = torch.from_numpy(grid.voxels.corners)
    assert float(torch.linalg.norm(mine[corners] - theirs)) < 1e-4 * float(torch.linalg.norm(theirs))
    assert float(cosine_similarity(mine[corners].reshape(1, -1), theirs.reshape(1, -1))) > 0.9999
