"""What a photograph and a thermal image have in common: where edges are and which way they run.

A warm thing may be bright or dark, so the sign of an edge says nothing; its place and its direction do. The squared
complex gradient (gx + i gy)^2 has the edge's strength and twice its angle, so an edge and its negative are equal.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

FloatImage = npt.NDArray[np.float32]

_GRADIENT_SIGMA_PX = 1.2
_NOISE_FACTOR = 3.0
_STRONG_PERCENTILE, _SMALLEST_SHARE = 98.0, 3e-3
"""Below this share of the strong edges' |z| an image without noise counts as flat."""
_CONTRAST_SIGMA_PX, _CONTRAST_SIGMA_SHARE = 6.0, 0.02
_FEWEST_FOR_PATTERN = 8
_PATTERN_CORRELATION = 0.25


def edge_field(image: FloatImage, blur_px: float, pixels_per_pixel: float = 1.0) -> npt.NDArray[np.complex64]:
    """Edges of an image as complex numbers of magnitude 0 to 1 and twice the edge's angle.

    Strong edges all count as 1 and noise as little: z / (|z| + c) with c a multiple of the median of |z|, the
    level of noise in an image that is mostly flat. NaN pixels and what lies next to them count as no edge.

    Args:
        image: Shape (height, width).
        blur_px: Standard deviation of the blur that follows, which is how far apart two edges may lie to be found.
        pixels_per_pixel: How many pixels of this image are one of those that lengths are given in.

    Returns:
        Shape (height, width).
    """
    bad = ~np.isfinite(image)
    filled = np.where(bad, np.float32(np.nanmedian(image) if not bad.all() else 0.0), image).astype(np.float32)
    filled -= filled.mean()
    sigma = _GRADIENT_SIGMA_PX * pixels_per_pixel
    smooth = cv2.GaussianBlur(filled, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    gx = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, borderType=cv2.BORDER_REPLICATE) / np.float32(32.0)
    gy = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, borderType=cv2.BORDER_REPLICATE) / np.float32(32.0)
    real, imaginary = gx * gx - gy * gy, 2.0 * gx * gy
    strength = gx * gx + gy * gy
    middle, strong = np.percentile(strength, [50.0, _STRONG_PERCENTILE])
    floor = max(_NOISE_FACTOR * float(middle), _SMALLEST_SHARE * float(strong), 1e-30)
    weight = 1.0 / (strength + floor)
    if bad.any():
        reach = 2 * int(np.ceil(3.0 * sigma)) + 1
        weight[cv2.dilate(bad.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0] = 0.0
    parts = [cv2.GaussianBlur(part * weight, (0, 0), blur_px * pixels_per_pixel) for part in (real, imaginary)]
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def without_fixed_pattern(images: Sequence[FloatImage], neighbours: int = 20) -> tuple[list[FloatImage], float]:
    """Take out what stays in place while the camera moves: rows, columns and single pixels that read differently.

    The pattern is the median local contrast over the frames around each one, because cameras renew it now and
    then. It is taken out only if two halves of the frames agree on it.

    Args:
        images: Temperatures in the order they were taken, all of one shape.
        neighbours: Over how many frames the median goes.

    Returns:
        Local contrasts, with the pattern taken out where there is one, and the correlation of the two halves.
    """
    contrast = [local_contrast(image) for image in images]
    if len(contrast) < _FEWEST_FOR_PATTERN:
        return contrast, 0.0
    stack = np.nan_to_num(np.stack(contrast), nan=0.0)
    agreement = _correlation(np.median(stack[::2], axis=0), np.median(stack[1::2], axis=0))
    if not agreement > _PATTERN_CORRELATION:
        return contrast, agreement
    cleaned, window = [], min(neighbours, len(stack))
    step = max(window // 4, 1)
    for first in range(0, len(stack), step):  # one median serves a few neighbouring frames
        start = min(max(first + step // 2 - window // 2, 0), len(stack) - window)
        pattern = np.median(stack[start : start + window], axis=0)
        cleaned += [image - pattern for image in stack[first : first + step]]
    return cleaned, agreement


def local_contrast(image: FloatImage) -> FloatImage:
    """Difference of each pixel to its surroundings; drift and vignetting do not show in it."""
    bad = ~np.isfinite(image)
    known = (~bad).astype(np.float32)
    filled = np.where(bad, np.float32(0.0), image).astype(np.float32)
    mean = filled.sum() / max(float(known.sum()), 1.0)
    filled = np.where(bad, np.float32(0.0), filled - mean)
    reach = max(_CONTRAST_SIGMA_PX, _CONTRAST_SIGMA_SHARE * image.shape[1])
    weight = cv2.GaussianBlur(known, (0, 0), reach)
    around = cv2.GaussianBlur(filled, (0, 0), reach) / np.maximum(weight, 1e-6)
    return np.where(bad, np.float32(np.nan), filled - around).astype(np.float32)


def _correlation(first: FloatImage, second: FloatImage) -> float:
    a, b = (image.ravel().astype(np.float64) - float(image.mean(dtype=np.float64)) for image in (first, second))
    scale = np.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / scale if scale > 0.0 else 0.0
