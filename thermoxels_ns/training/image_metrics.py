"""Metrics of rendered photographs and thermal images against held-out ones."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

_SMALLEST_MSE = 1e-10
_HSSIM_WINDOW = 4
_HSSIM_C2 = 9e-4  # (0.03 x data range 1)^2
SATURATED = 0.99  # Least value of a saturated channel: the scene may have been brighter


def psnr(predicted: Tensor, target: Tensor, valid: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio of values in [0, 1], [dB], at most 100, over entries True in `valid`."""
    squared = (predicted - target) ** 2
    mse = squared.mean() if valid is None else squared[valid].mean()
    return float(-10.0 * torch.log10(mse.clamp(min=_SMALLEST_MSE)))


def psnr_of_blocks(
    predicted: Float[Tensor, "h w c"],
    target: Float[Tensor, "h w c"],
    valid: Bool[Tensor, "h w 1"] | None = None,
    side: int = 8,
) -> float:
    """Return the `psnr` of both images after averaging over blocks of `side` x `side` pixels, [dB].

    A block is the mean of its valid pixels; blocks without valid pixels are left out. NaN if no pixel is valid.

    >>> fine = torch.tensor([[[0.0], [1.0]], [[1.0], [0.0]]])
    >>> round(psnr_of_blocks(torch.full((2, 2, 1), 0.6), fine, side=2), 3)  # pixels are 0.4 and 0.6 off, their mean 0.1
    20.0
    """
    counts = torch.ones_like(target[..., :1], dtype=torch.bool) if valid is None else valid

    def block_mean(image: Tensor) -> Tensor:
        return F.avg_pool2d(image.permute(2, 0, 1)[None], side, ceil_mode=True)[0].permute(1, 2, 0)

    share = block_mean(counts.to(target.dtype))
    seen, measured = (block_mean(torch.where(counts, image, 0.0)) / share for image in (predicted, target))
    return psnr(seen, measured, (share > 0).expand(*share.shape[:2], target.shape[2]))


def fitted_gain(predicted: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Float[Tensor, " 3"]:
    """Return the gain of each channel, (3,), with which rendered pixels best fit measured ones (robust, Huber). Values
    of at least `SATURATED` in the measured photograph do not count."""
    gain, weight = torch.ones(3, device=predicted.device), (target < SATURATED).to(predicted.dtype)
    for _ in range(8):
        gain = (weight * predicted * target).sum(0) / (weight * predicted**2).sum(0).clamp(min=1e-12)
        off = (target - gain * predicted).abs()
        weight = (target < SATURATED) * (off.median(0).values / off.clamp(min=1e-6)).clamp(max=1.0)
    return gain


def ssim(
    predicted: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"], valid: Bool[Tensor, "h w 1"] | None = None
) -> float:
    """Return the structural similarity (Wang et al. 2004) with a Gaussian window of 11 pixels. Smaller images have a
    box window. The mean is over windows whose pixels are all valid; NaN without such a window."""
    side = min(11, *predicted.shape[:2])
    side -= 1 - side % 2
    images = (predicted.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
    window = {"data_range": 1.0, "gaussian_kernel": side == 11, "kernel_size": side}
    if valid is None or bool(valid.all()):
        return float(structural_similarity_index_measure(*images, **window))  # type: ignore[arg-type]
    _, similarity = structural_similarity_index_measure(*images, **window, return_full_image=True)  # type: ignore[misc]
    whole = F.avg_pool2d(valid.permute(2, 0, 1)[None].float(), side, 1, side // 2, count_include_pad=False)[0, 0] == 1
    return float(similarity[0].mean(0)[whole].mean())


def hssim(
    predicted: Float[Tensor, "h w 1"], target: Float[Tensor, "h w 1"], valid: Bool[Tensor, "h w 1"] | None = None
) -> float:
    """Return the heat-based structural similarity (arXiv 2403.10340), as the Thermoxels paper reports it.

    HSSIM is the mean of (2 cov + C2) / (var_p + var_t + C2), C2 = 9e-4, over disjoint 4 x 4 windows whose pixels are
    all valid; NaN without such a window. A window that is flat in both images counts 1.
    """

    def window_mean(image: Tensor) -> Tensor:
        return F.avg_pool2d(image.permute(2, 0, 1)[None], min(_HSSIM_WINDOW, *image.shape[:2]))

    mean_p, mean_t = window_mean(predicted), window_mean(target)
    var_p = window_mean(predicted**2) - mean_p**2
    var_t = window_mean(target**2) - mean_t**2
    covariance = window_mean(predicted * target) - mean_p * mean_t
    similarity = (2 * covariance + _HSSIM_C2) / (var_p + var_t + _HSSIM_C2)
    return float((similarity if valid is None else similarity[window_mean(valid.float()) == 1]).mean())


def hot_region(temperature_c: Float[Tensor, "h w 1"], valid: Bool[Tensor, "h w 1"]) -> Bool[Tensor, "h w 1"]:
    """Return the mask of valid pixels hotter than Otsu's threshold (1979), or of all valid pixels of a flat image."""
    values = temperature_c[valid]
    if values.numel() == 0:
        return valid
    low, span = values.min(), values.max() - values.min()
    if float(span) < 1e-6:
        return valid
    grey = ((temperature_c - low) / span * 255).round()
    levels = np.ascontiguousarray(grey[valid].to(torch.uint8).cpu().numpy()[:, None])
    threshold, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return valid & (grey > threshold)


def thermal_metrics(
    seen: Mapping[str, Tensor], target: Float[Tensor, "h w 1"], valid: Bool[Tensor, "h w 1"], span_k: float
) -> dict[str, float]:
    """Return all thermal metrics of one image.

    Args:
        seen: `thermal`, `accumulation` and `in_box` of the rendered image, (h, w, 1) each, as the model returns them.
        target: Measured normalised temperature.
        valid: Pixels that were measured.
        span_k: Width of the temperature range, [K].

    Returns:
        `thermal_psnr`, `thermal_ssim`, `thermal_hssim` of normalised images, and mean absolute errors in kelvin (the
        size of a degree Celsius): `thermal_mae_c` over all valid pixels; `thermal_mae_hit_c` where opacity exceeds one
        half; `thermal_mae_box_c` in the box; `thermal_mae_roi_c` in `hot_region`; `thermal_mae_debiased_c` after the
        image's mean error is subtracted. A metric over no pixel is NaN.
    """
    predicted = seen["thermal"]
    filled_p, filled_t = (torch.where(valid, image, torch.zeros_like(image)) for image in (predicted, target))
    error_k = (predicted - target) * span_k
    # The mean of no pixel is NaN.
    return {
        "thermal_psnr": psnr(filled_p, filled_t, valid),
        "thermal_ssim": ssim(filled_p, filled_t, valid),
        "thermal_hssim": hssim(filled_p, filled_t, valid),
        "thermal_mae_c": float(error_k[valid].abs().mean()),
        "thermal_mae_hit_c": float(error_k[valid & (seen["accumulation"] > 0.5)].abs().mean()),
        "thermal_mae_box_c": float(error_k[valid & (seen["in_box"] > 0)].abs().mean()),
        "thermal_mae_roi_c": float(error_k[hot_region(target, valid)].abs().mean()),
        "thermal_mae_debiased_c": float((error_k - error_k[valid].mean())[valid].abs().mean()),
    }


def lpips(predicted: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> float:
    """Return the learned perceptual distance (Zhang et al. 2018, AlexNet); the first call may download weights."""
    import lpips as package  # type: ignore[import-not-found]

    def prepare(image: Tensor) -> Tensor:
        return image.permute(2, 0, 1)[None].cpu() * 2 - 1

    if not hasattr(lpips, "network"):
        lpips.network = package.LPIPS(net="alex", verbose=False)  # type: ignore[attr-defined]
    with torch.no_grad():
        return float(lpips.network(prepare(predicted), prepare(target)))  # type: ignore[attr-defined]
