import numpy as np
import pytest
import torch

from thermoxels_ns.core.feature_rays import MARGIN_ERRORS, MARGIN_VOXELS, FeatureRays
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.kept_voxels import KeptVoxels
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.ray_render import RenderOptions
from thermoxels_ns.render.reference import ray_distortion, total_variation
from thermoxels_ns.render.renderers import render_rays
from thermoxels_ns.training import losses
from thermoxels_ns.training.losses import FeatureRaySampler, feature_ray_loss


def voxel_corners(lattice: Lattice, cells=None) -> torch.Tensor:
    return KeptVoxels(lattice, cells).tables(torch.device("cpu"))[0]


def test_thermal_loss_is_half_l2_half_l1():
    predicted, target = torch.tensor([[0.2], [0.8]]), torch.tensor([[0.0], [0.5]])
    expected = 0.5 * (0.04 + 0.09) / 2 + 0.5 * (0.2 + 0.3) / 2
    assert float(losses.thermal_loss(predicted, target)) == pytest.approx(expected)


def test_total_variation_of_a_ramp_is_its_slope():
    lattice = Lattice((0.0, 0.0, 0.0), 1.0, (5, 4, 6))
    x, y, z = torch.as_tensor(lattice.corner_positions(), dtype=torch.float32).reshape(-1, 3).unbind(-1)
    ramp = torch.stack((3 * x - 4 * y, 2 * x + y - 2 * z), -1)
    corners = voxel_corners(lattice)
    assert float(total_variation(ramp, corners)) == pytest.approx((5.0 + 3.0) / 2)
    assert float(total_variation(ramp[:, :1], corners[7:20])) == pytest.approx(5.0)
    flat = torch.ones(len(ramp), 1, requires_grad=True)
    total_variation(flat, corners).backward()
    assert flat.grad is not None and torch.isfinite(flat.grad).all()


def test_total_variation_looks_at_kept_voxels_alone():
    """The rows of two voxels that touch nowhere: the jump between them does not count."""
    lattice = Lattice((0.0, 0.0, 0.0), 1.0, (5, 2, 2))
    voxels = KeptVoxels(lattice, [0, 3])
    rows = torch.from_numpy(np.where(voxels.corner_index()[:, :1] < 2, 1.0, 50.0))
    assert float(total_variation(rows, voxel_corners(lattice, [0, 3]))) == pytest.approx(1e-5)


def test_random_block_is_contiguous_and_pure_in_its_seed():
    first, again = (losses.random_block(1200, 0.2, torch.Generator().manual_seed(5)) for _ in range(2))
    assert first == again and first[1] - first[0] == 240
    blocks = [losses.random_block(10, 0.25, torch.Generator().manual_seed(n)) for n in range(200)]
    assert {last - first for first, last in blocks} == {3}
    assert {first for first, _ in blocks} == set(range(8)), "every place occurs, the first and the last too"
    assert losses.random_block(7, 1.0, torch.Generator()) == (0, 7)
    assert losses.random_block(5, 1e-6, torch.Generator().manual_seed(0))[1] > 0


def test_distortion_matches_the_double_sum():
    generator = torch.Generator().manual_seed(0)
    w = torch.rand(4, 30, generator=generator, dtype=torch.float64) / 30
    d = torch.rand(4, 30, generator=generator, dtype=torch.float64)
    t = torch.cumsum(d, -1) - d / 2
    apart = (t[:, :, None] - t[:, None, :]).abs()
    expected = (w[:, :, None] * w[:, None, :] * apart).sum((1, 2)) + (w**2 * d).sum(1) / 3
    np.testing.assert_allclose(ray_distortion(w, t, d, scale=1.0).numpy(), expected, rtol=1e-12)
    np.testing.assert_allclose(2.0 * ray_distortion(w, t, d, scale=2.0).numpy(), expected, rtol=1e-12)


def test_beta_is_nil_for_decided_rays_and_dearest_at_one_half():
    decided = losses.beta_loss(torch.tensor([0.0, 1.0], dtype=torch.float64))
    assert float(decided) == pytest.approx(0.0, abs=1e-12)
    costs = [float(losses.beta_loss(torch.tensor([a]))) for a in (0.1, 0.5, 0.9)]
    assert costs[1] > costs[0] > 0 and costs[1] > costs[2] > 0


CPU = torch.device("cpu")
LATTICE = Lattice.covering((-1, -1, -1), (1, 1, 1), 20)


def track_rays(uncertainty: float = 0.0, count: int = 40) -> tuple[FeatureRaySampler, FeatureRays]:
    """Lines along x from 0.9 before the middle to a wall at x = 0.2."""
    side = np.random.default_rng(0).uniform(-0.8, 0.8, (count, 2))
    origins = np.column_stack((np.full(count, -0.9), side))
    points = np.column_stack((np.full(count, 0.2), side))
    lines = FeatureRays(origins, np.arange(count), points, np.full(count, uncertainty))
    return FeatureRaySampler(lines, (LATTICE.lo, LATTICE.hi)), lines


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
    assert request.far[:25] == pytest.approx(1.1**2 / (1.1 + margin), abs=1e-6)
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


def test_a_ray_to_a_point_outside_the_box_asks_for_air_up_to_it_and_for_no_wall() -> None:
    rays = FeatureRays(np.zeros((1, 3)), np.zeros(1, np.int64), np.array([[4.0, 0.0, 0.0]]), np.full(1, 0.05))
    generator = torch.Generator().manual_seed(0)
    alone = FeatureRaySampler(rays, (LATTICE.lo, LATTICE.hi)).request(1, 0.0, 0.1, generator, CPU)
    beyond = FeatureRaySampler(rays, (LATTICE.lo, LATTICE.hi), True).request(1, 0.0, 0.1, generator, CPU, 0.01)
    assert alone.far[0] > 3.7 and alone.far[1] == 0.0
    margin = MARGIN_VOXELS * (0.1 + 0.01 * 4.0**2) + MARGIN_ERRORS * 0.05
    assert beyond.far.tolist() == pytest.approx([4.0**2 / (4.0 + margin), 4.0 + margin])
