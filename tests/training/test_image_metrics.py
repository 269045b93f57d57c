import math
import sys
import types

import pytest
import torch

from thermoxels_ns.training import image_metrics as metrics


def images(h=48, w=64):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(h, w, 1, generator=generator)
    return target, torch.ones(h, w, 1, dtype=torch.bool)


def thermal_metrics(predicted, target, valid, span_k, opacity=1.0):
    seen = {"thermal": predicted, "accumulation": opacity * torch.ones_like(target), "in_box": torch.ones_like(target)}
    return metrics.thermal_metrics(seen, target, valid, span_k)


def test_constant_shift_is_an_error_in_degrees_that_debiasing_removes():
    target, valid = images()
    result = thermal_metrics(target, target, valid, 40.0)
    assert result["thermal_ssim"] == pytest.approx(1.0) and result["thermal_hssim"] == pytest.approx(1.0)
    assert all(result[f"thermal_mae_{k}"] == 0.0 for k in ("c", "hit_c", "roi_c", "debiased_c"))
    result = thermal_metrics(target + 0.05, target, valid, 40.0)
    assert result["thermal_mae_c"] == pytest.approx(2.0, rel=1e-5)
    assert result["thermal_mae_debiased_c"] == pytest.approx(0.0, abs=1e-5)


def test_only_valid_and_hit_pixels_count():
    target, valid = images()
    predicted, opacity = target.clone(), torch.ones_like(target)
    predicted[:10] += 0.5  # wrong where nothing was measured
    predicted[10:20] += 0.1  # wrong where nothing was hit
    valid[:10], opacity[10:20] = False, 0.2
    result = thermal_metrics(predicted, target, valid, 10.0, opacity)
    assert result["thermal_mae_hit_c"] == 0.0
    assert result["thermal_mae_c"] == pytest.approx(10 / 38, rel=1e-5)


def test_hot_region_is_the_hot_side():
    temperature = torch.full((20, 20, 1), 10.0)
    temperature[5:9, 5:9] = 60.0
    temperature += torch.linspace(0, 1, 20)[:, None, None]
    valid = torch.ones_like(temperature, dtype=torch.bool)
    assert torch.equal(metrics.hot_region(temperature, valid), temperature > 30)


def test_flat_images_and_images_without_a_valid_pixel_give_no_nan_where_a_number_exists():
    flat = torch.full((16, 16, 1), 0.5)
    every = torch.ones_like(flat, dtype=torch.bool)
    result = thermal_metrics(flat, flat, every, 1.0)
    assert result["thermal_hssim"] == pytest.approx(1.0) and all(map(math.isfinite, result.values()))
    nothing = thermal_metrics(flat, flat, ~every, 1.0)
    assert math.isnan(nothing["thermal_mae_c"]) and math.isnan(nothing["thermal_psnr"])


def test_hssim_against_one_window_by_hand():
    predicted = torch.arange(16.0).view(4, 4, 1) / 16
    target = predicted * 0.5
    variance = float(predicted.var(unbiased=False))
    expected = (2 * 0.5 * variance + 9e-4) / (variance * 1.25 + 9e-4)
    assert metrics.hssim(predicted, target) == pytest.approx(expected, rel=1e-5)


def test_blocks_tell_wrong_colours_from_soft_ones():
    """Noise goes, an offset stays; sides that are no multiple of 8 end in smaller blocks."""
    generator = torch.Generator().manual_seed(3)
    target = torch.rand(45, 61, 3, generator=generator)
    soft = torch.empty_like(target)
    for rows, seen in zip(target.split(8), soft.split(8)):
        for block, flat in zip(rows.split(8, dim=1), seen.split(8, dim=1)):
            flat[:] = block.mean((0, 1))
    assert metrics.psnr(soft, target) < 12.0 and metrics.psnr_of_blocks(soft, target) == pytest.approx(100.0)
    assert metrics.psnr_of_blocks(soft + 0.1, target) == pytest.approx(20.0, abs=1e-3)


def test_blocks_are_means_of_their_valid_pixels():
    target, valid = torch.full((16, 16, 3), 0.5), torch.ones(16, 16, 1, dtype=torch.bool)
    predicted = target.clone()
    predicted[:8, :8] += 0.2
    predicted[0, 0], predicted[12:, 8:] = math.nan, 1.0  # not measured
    valid[0, 0], valid[8:, 8:] = False, False
    assert metrics.psnr_of_blocks(predicted, target, valid) == pytest.approx(-10 * math.log10(0.04 / 3), abs=1e-3)
    assert math.isnan(metrics.psnr_of_blocks(predicted, target, ~torch.ones_like(valid)))


@pytest.mark.parametrize("size", [(3, 5), (10, 64), (11, 11)])
def test_ssim_of_small_images(size):
    image = torch.rand(*size, 3)
    assert metrics.ssim(image, image) == pytest.approx(1.0)


def test_lpips_is_asked_only_when_installed(monkeypatch):
    """With a stand-in for the optional package: images are handed over as (1, 3, h, w) in [-1, 1]."""
    seen = []

    def network(a, b):
        seen.append((a.shape, float(a.min()), float(b.max())))
        return torch.tensor(0.25)

    monkeypatch.setitem(sys.modules, "lpips", types.SimpleNamespace())
    monkeypatch.setattr(metrics.lpips, "network", network, raising=False)
    assert metrics.lpips(torch.zeros(8, 8, 3), torch.ones(8, 8, 3)) == 0.25
    assert seen == [((1, 3, 8, 8), -1.0, 1.0)]


def test_invalid_pixels_do_not_flatter_the_structure():
    """Noise against noise is not similar, however many pixels were not measured."""
    generator = torch.Generator().manual_seed(1)
    a, b = (torch.rand(64, 64, 1, generator=generator) for _ in range(2))
    valid = torch.zeros(64, 64, 1, dtype=torch.bool)
    valid[:32, :32] = True
    masked = thermal_metrics(a, b, valid, 1.0)
    whole = thermal_metrics(a, b, torch.ones_like(valid), 1.0)
    assert masked["thermal_ssim"] < 0.2 and abs(masked["thermal_ssim"] - whole["thermal_ssim"]) < 0.1
    assert abs(masked["thermal_hssim"] - whole["thermal_hssim"]) < 0.15
    assert math.isnan(thermal_metrics(a, b, ~torch.ones_like(valid), 1.0)["thermal_ssim"])
