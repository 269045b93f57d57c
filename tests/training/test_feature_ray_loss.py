"""Rays along lines of sight: where they end, and what opacity they want."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.ray_render import RenderOptions
from thermoxels_ns.render.renderers import render_rays
from thermoxels_ns.training.losses import MARGIN_ERRORS, MARGIN_VOXELS, FeatureRaySampler, feature_ray_loss

CPU = torch.device("cpu")
LATTICE = Lattice.covering((-1, -1, -1), (1, 1, 1), 20)


def track_rays(uncertainty: float = 0.0, count: int = 40) -> tuple[FeatureRaySampler, FeatureRays]:
    """Lines along x from 0.9 before the middle to a wall at x = 0.2."""
    side = np.random.default_rng(0).uniform(-0.8, 0.8, (count, 2))
    origins = np.column_stack((np.full(count, -0.9), side))
    points = np.column_stack((np.full(count, 0.2), side))
    lines = FeatureRays(origins, np.arange(count), points, np.full(count, uncertainty))
    return FeatureRaySampler(lines), lines


def wall(at: float, backend: str) -> float:
    """Loss of a field that is opaque from x = `at` on and nothing before."""
    grid = VoxelGrid(LATTICE, sh_degree=0, activation="relu")
    with torch.no_grad():
        x = torch.from_numpy(LATTICE.corner_positions()[..., 0].reshape(-1, 1))
        grid.density.copy_(torch.where(x > at, 1e3, 0.0))
    request = track_rays()[0].request(32, 0.0, LATTICE.voxel_size, torch.Generator().manual_seed(0), CPU)
    seen = render_rays(grid, request, RenderOptions(), backend)  # type: ignore[arg-type]
    return float(feature_ray_loss(seen.accumulation, seen.transmittance).detach())


def test_rays_end_before_and_behind_their_points_by_margin_and_uncertainty() -> None:
    rays, lines = track_rays(uncertainty=0.01)
    request = rays.request(25, 0.1, 0.05, torch.Generator().manual_seed(3), CPU)
    margin = MARGIN_VOXELS * 0.05 + MARGIN_ERRORS * 0.01
    assert request.far is not None
    assert request.far[:25] == pytest.approx(1.1 - margin, abs=1e-6)
    assert request.far[25:] == pytest.approx(1.1 + margin, abs=1e-6)
    assert torch.equal(request.origins[:25], request.origins[25:])
    on = np.linalg.norm(lines.origins[:, None] - request.origins[:25].numpy(), axis=2).min(axis=0)
    assert on.max() < 1e-6
    assert request.rgb_rays is not None and not bool(request.rgb_rays.any())


@pytest.mark.parametrize("backend", ["reference", "fused"])
def test_a_wall_in_place_costs_nothing_and_one_before_or_behind_it_everything(backend: str) -> None:
    assert wall(0.16, backend) < 1e-3
    assert wall(-0.4, backend) == pytest.approx(1.0, abs=1e-3)
    assert wall(0.7, backend) == pytest.approx(1.0, abs=1e-3)


def test_the_gradient_thins_what_is_before_the_points_and_thickens_what_is_at_them() -> None:
    grid = VoxelGrid(LATTICE, sh_degree=0, activation="relu", start_density=0.5)
    request = track_rays()[0].request(32, 0.0, LATTICE.voxel_size, torch.Generator().manual_seed(0), CPU)
    seen = render_rays(grid, request, RenderOptions(), "reference")
    feature_ray_loss(seen.accumulation, seen.transmittance).backward()
    gradient = grid.density.grad
    assert gradient is not None
    by_x = gradient.to_dense().view(LATTICE.shape).sum(dim=(1, 2))
    x = torch.linspace(-1, 1, 21)
    assert bool((by_x[(x > 0.15) & (x < 0.25)] < 0).all())
    assert float(by_x[(x > -0.9) & (x < 0.0)].sum()) > float(by_x[(x > 0.15) & (x < 0.25)].sum())
