from __future__ import annotations

import numpy as np
import pytest
import torch

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.kept_voxels import KeptVoxels
from thermoxels_ns.render.compositing import ray_distortion, ray_sparsity
from thermoxels_ns.render.renderers import total_variation
from thermoxels_ns.training import losses


def voxel_corners(lattice: Lattice, cells=None) -> torch.Tensor:
    return KeptVoxels(lattice, cells).tables(torch.device("cpu"))[0]


def test_thermal_loss_is_half_l2_half_l1():
    predicted, target = torch.tensor([[0.2], [0.8]]), torch.tensor([[0.0], [0.5]])
    expected = 0.5 * (0.04 + 0.09) / 2 + 0.5 * (0.2 + 0.3) / 2
    assert float(losses.thermal_loss(predicted, target)) == pytest.approx(expected)
    assert float(losses.thermal_loss(predicted, target, 1.0)) == pytest.approx((0.04 + 0.09) / 2)


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


def brute_force_distortion(w, t, d):
    pairs = sum(w[i] * w[j] * abs(t[i] - t[j]) for i in range(len(w)) for j in range(len(w)))
    return pairs + sum(w[i] ** 2 * d[i] for i in range(len(w))) / 3


def test_distortion_matches_the_double_sum():
    generator = torch.Generator().manual_seed(0)
    w = torch.rand(4, 30, generator=generator, dtype=torch.float64) / 30
    d = torch.rand(4, 30, generator=generator, dtype=torch.float64)
    t = torch.cumsum(d, -1) - d / 2
    expected = [brute_force_distortion(w[r].tolist(), t[r].tolist(), d[r].tolist()) for r in range(4)]
    np.testing.assert_allclose(ray_distortion(w, t, d, scale=1.0).numpy(), expected, rtol=1e-12)
    np.testing.assert_allclose(2.0 * ray_distortion(w, t, d, scale=2.0).numpy(), expected, rtol=1e-12)


def test_all_terms_have_exact_gradients():
    w = (torch.rand(3, 8, dtype=torch.float64) * 0.9 + 0.05).requires_grad_()
    d = torch.full((3, 8), 0.1, dtype=torch.float64)
    t = torch.cumsum(d, -1)
    lattice = Lattice((0.0, 0.0, 0.0), 1.0, (3, 3, 3))
    rows = torch.rand(lattice.num_corners, 2, dtype=torch.float64, requires_grad=True)
    corners = voxel_corners(lattice)
    assert torch.autograd.gradcheck(lambda x: ray_distortion(x, t, d, 2.0), (w,))
    assert torch.autograd.gradcheck(lambda x: ray_sparsity(x, d), (w,))
    assert torch.autograd.gradcheck(lambda x: losses.beta_loss(x[:, 0]), (w,))
    assert torch.autograd.gradcheck(lambda x: total_variation(x, corners), (rows,))


def test_beta_is_nil_for_decided_rays_and_dearest_at_one_half():
    decided = losses.beta_loss(torch.tensor([0.0, 1.0], dtype=torch.float64))
    assert float(decided) == pytest.approx(0.0, abs=1e-12)
    costs = [float(losses.beta_loss(torch.tensor([a]))) for a in (0.1, 0.5, 0.9)]
    assert costs[1] > costs[0] > 0 and costs[1] > costs[2] > 0


def test_sparsity_ignores_padding_and_stays_finite():
    density = torch.tensor([[1.0, float("inf")], [2.0, 0.0]])
    found = ray_sparsity(density, torch.tensor([[0.1, 0.0], [0.1, 0.1]]))
    np.testing.assert_allclose(found.numpy(), np.log([3.0, 9.0]), rtol=1e-6)
    assert torch.isfinite(ray_sparsity(density, torch.full((2, 2), 0.1))).all()
