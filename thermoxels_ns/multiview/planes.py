"""Plain walls as planes: what photographs show without texture is completed from most of its depths."""

from __future__ import annotations

import cv2
import numpy as np

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray
from thermoxels_ns.multiview.backdrop import even_pixels
from thermoxels_ns.multiview.photographs import Photographs

EVEN = (0.03, 0.02, 0.013, 0.009)
"""Differences of a channel from pixel to pixel, of 1, that bound plain areas: those that are no plane are cut up."""
SMALLEST = 3e-3  # Pixels of a plain area, of a photograph's; a smaller one tells no plane
LEAST_SHARE = 0.8  # Pixels of the area whose depths must lie on its plane
CURVED = 0.7  # Deviation left by a curved surface, relative to that from the plane, below which it is no plane
_TRIALS, _FITS = 64, 3


def depths_on_planes(
    photographs: Photographs,
    backdrop: BoolArray,
    depth: Float32Array,
    tolerance: float,
) -> Float32Array:
    """Depths of plain areas that are planes, shape (pixels,), [world units]; NaN elsewhere.

    Nothing in a plain area contradicts a dent in it; that most of it lies on one plane does. In a pinhole photograph
    the inverse depth of a plane is linear in the pixel, so the plane is the linear function that most of the depths
    agree with, found from three of them (random sample consensus, Fischler and Bolles 1981) and fitted to all that do.
    Areas that bend, where a quadratic function fits much better, are left alone.

    Args:
        photographs: Small photographs.
        backdrop: Pixels that show a plain backdrop, (pixels,); they belong to no wall.
        depth: Depth that a model has for each pixel, (pixels,), [world units]; NaN where it has no surface.
        tolerance: Distance along the optical axis up to which a depth agrees, [world units].
    """
    found, draw = np.full(len(depth), np.nan, np.float32), np.random.default_rng(0)
    for (width, height), first in zip(photographs.sizes, photographs.firsts):
        pixels = slice(first, first + width * height)
        wall = ~backdrop[pixels].reshape(height, width)
        y, x = np.divmod(np.arange(width * height), width)
        terms = np.column_stack((np.ones(len(x)), x / width - 0.5, y / width - 0.5))
        for most in EVEN:
            plain = even_pixels(photographs.colours[pixels].reshape(height, width, 3), most) & wall
            label = np.asarray(cv2.connectedComponents(plain.astype(np.uint8), connectivity=4)[1]).ravel()
            for number in np.flatnonzero(np.bincount(label)[1:] >= SMALLEST * width * height) + 1:
                (area,) = np.nonzero(label == number)
                plane = _plane(terms[area], depth[pixels][area].astype(np.float64), tolerance, draw)
                if plane is not None:
                    found[first + area] = 1.0 / (terms[area] @ plane)
                    wall.reshape(-1)[area] = False
    return found


def _plane(terms: FloatArray, depth: FloatArray, tolerance: float, draw: np.random.Generator) -> FloatArray | None:
    """Coefficients of the inverse depth of the plane on which most of an area lies, or None."""
    known = np.isfinite(depth)
    if known.sum() < LEAST_SHARE * len(depth):
        return None
    linear, inverse = terms[known], 1.0 / depth[known]
    allowed = tolerance * inverse * inverse
    corners = draw.integers(len(inverse), size=(_TRIALS, 3))
    corners = corners[np.abs(np.linalg.det(linear[corners])) > 1e-6]
    if len(corners) == 0:
        return None
    trials = np.linalg.solve(linear[corners], inverse[corners][..., None])[..., 0]
    agree = np.abs(linear @ trials.T - inverse[:, None]) < allowed[:, None]
    on_plane = agree[:, agree.sum(axis=0).argmax()]
    for _ in range(_FITS):
        if on_plane.sum() < LEAST_SHARE * len(depth):
            return None
        plane = np.linalg.lstsq(linear[on_plane], inverse[on_plane], rcond=None)[0]
        on_plane = np.abs(linear @ plane - inverse) < allowed
    x, y = linear[on_plane, 1], linear[on_plane, 2]
    bent = np.column_stack((linear[on_plane], x * x, x * y, y * y))
    rest, left = inverse[on_plane] - linear[on_plane] @ plane, inverse[on_plane]
    left = left - bent @ np.linalg.lstsq(bent, left, rcond=None)[0]
    if np.linalg.norm(left) < CURVED * np.linalg.norm(rest) or (terms @ plane).min() <= 0.0:
        return None
    return plane
