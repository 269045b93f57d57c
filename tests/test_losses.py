from __future__ import annotations

import pytest
import torch

from thermoxels_ns import losses


def test_thermal_loss_is_half_l2_half_l1():
    predicted, target = torch.tensor([[0.2], [0.8]]), torch.tensor([[0.0], [0.5]])
    expected = 0.5 * (0.04 + 0.09) / 2 + 0.5 * (0.2 + 0.3) / 2
    assert float(losses.thermal_loss(predicted, target)) == pytest.approx(expected)
    assert float(losses.thermal_loss(predicted, target, 1.0)) == pytest.approx((0.04 + 0.09) / 2)


def test_total_variation_of_a_ramp_is_its_slope():
    x, y, z = torch.meshgrid(*[torch.arange(5.0)] * 3, indexing="ij")
    ramp = (3 * x - 4 * y + 0 * z)[..., None].repeat(1, 1, 1, 2)
    assert float(losses.total_variation(ramp)) == pytest.approx(5.0)
    flat = torch.ones(3, 3, 3, 1, requires_grad=True)
    losses.total_variation(flat).backward()
    assert flat.grad is not None and torch.isfinite(flat.grad).all()


def test_random_block_is_contiguous_and_pure_in_its_seed():
    rows = torch.arange(10 * 4 * 3.0)[:, None]
    first = losses.random_block(rows, (10, 4, 3), 0.2, torch.Generator().manual_seed(5))
    again = losses.random_block(rows, (10, 4, 3), 0.2, torch.Generator().manual_seed(5))
    assert first.shape == (3, 4, 3, 1) and torch.equal(first, again)
    assert float(first[1, 0, 0, 0] - first[0, 0, 0, 0]) == 12.0


def brute_force_distortion(w, t, d):
    pairs = sum(w[i] * w[j] * abs(t[i] - t[j]) for i in range(len(w)) for j in range(len(w)))
    return pairs + sum(w[i] ** 2 * d[i] for i in range(len(w))) / 3


def test_distortion_matches_the_double_sum():
    generator = torch.Generator().manual_seed(0)
    w = torch.rand(4, 30, generator=generator, dtype=torch.float64) / 30
    d = torch.rand(4, 30, generator=generator, dtype=torch.float64)
    t = torch.cumsum(d, -1) - d / 2
    expected = sum(brute_force_distortion(w[r].tolist(), t[r].tolist(), d[r].tolist()) for r in range(4)) / 4
    assert float(losses.distortion_loss(w, t, d, scale=1.0)) == pytest.approx(expected, rel=1e-12)
    assert float(losses.distortion_loss(w, t, d, scale=2.0)) == pytest.approx(expected / 2, rel=1e-12)


def test_all_terms_have_exact_gradients():
    w = (torch.rand(3, 8, dtype=torch.float64) * 0.9 + 0.05).requires_grad_()
    d = torch.full((3, 8), 0.1, dtype=torch.float64)
    t = torch.cumsum(d, -1)
    block = torch.rand(3, 3, 3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: losses.distortion_loss(x, t, d, 2.0), (w,))
    assert torch.autograd.gradcheck(lambda x: losses.sparsity_loss(x, d), (w,))
    assert torch.autograd.gradcheck(lambda x: losses.beta_loss(x[:, 0]), (w,))
    assert torch.autograd.gradcheck(losses.total_variation, (block,))


def test_beta_is_nil_for_decided_rays_and_dearest_at_one_half():
    decided = losses.beta_loss(torch.tensor([0.0, 1.0], dtype=torch.float64))
    assert float(decided) == pytest.approx(0.0, abs=1e-12)
    costs = [float(losses.beta_loss(torch.tensor([a]))) for a in (0.1, 0.5, 0.9)]
    assert costs[1] > costs[0] > 0 and costs[1] > costs[2] > 0


def test_sparsity_ignores_padding_and_stays_finite():
    density = torch.tensor([[1.0, float("inf")]])
    assert float(losses.sparsity_loss(density, torch.tensor([[0.1, 0.0]]))) == pytest.approx(1.0986, abs=1e-4)
    assert torch.isfinite(losses.sparsity_loss(density, torch.tensor([[0.1, 0.1]])))
