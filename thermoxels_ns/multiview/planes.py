"""Plain walls as planes: what photographs show without texture is completed from depths that lie on one."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.multiview.backdrop import even_pixels
from thermoxels_ns.multiview.stereo import Depths

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

EVEN = (0.03, 0.02, 0.013, 0.009)
"""Differences of a channel from pixel to pixel, of 1, that bound plain areas: those that are no plane are cut up."""
SMALLEST = 3e-3  # Pixels of a plain area, of a photograph's; a smaller one tells no plane
LEAST_KNOWN = 0.8  # Pixels of the area for which the model must have a depth
LEAST_SHARE = 0.3  # Of these, how many must lie on the plane; others lie in dents behind it
MOST_BEFORE = 0.1  # How many may lie before it
LEAST_AGREED = 0.5  # Depths of photographs in the area and beside it that make a plane without the model's
FEWEST_AGREED = 12  # How many of these there must be for them to count
SURE_PLANES = 0.5  # How far they may be off, in planes of their sweep
MOST_IN_AIR = 0.05  # Pixels of the area whose points on the plane may lie where rays to what is seen say that air is
CURVED = 0.7  # Deviation left by a curved surface, relative to that from the plane, below which it is no plane
_TRIALS, _FITS = 64, 3


def depths_on_planes(
    depths: Depths,
    backdrop: BoolArray,
    model_depth: npt.NDArray[np.float32],
    tolerance: float,
    is_air: Callable[[FloatArray], BoolArray],
) -> npt.NDArray[np.float32]:
    """Depths of plain areas that are planes, shape (pixels,), [world units]; NaN elsewhere.

    Nothing in a plain area contradicts a dent in it; that a part of it lies on one plane and hardly anything before it
    does. In a pinhole photograph the inverse depth of a plane is linear in the pixel, so the plane is the linear
    function that most of the model's depths and of those of photographs, in the area and beside it, agree with. It is
    found from three of them (random sample consensus, Fischler and Bolles 1981) and fitted to all that agree, each by
    its tolerance. Areas that bend, where a quadratic function fits much better, are left alone, and so are those before
    which air would have to be solid, as where a wall of the same colour runs back from the plane.

    Args:
        depths: Depths of small photographs, on which these agree.
        backdrop: Pixels that show a plain backdrop, (pixels,); they belong to no wall.
        model_depth: Depth that a model has for each pixel, (pixels,), [world units]; NaN where it has no surface.
        tolerance: Distance along the optical axis up to which such a depth agrees, [world units].
        is_air: Tells which points (n, 3) are known to be air.
    """
    photographs, beside = depths.photographs, np.ones((5, 5), np.uint8)
    found, draw = np.full(len(model_depth), np.nan, np.float32), np.random.default_rng(0)
    for (width, height), first in zip(photographs.sizes, photographs.firsts):
        pixels = slice(first, first + width * height)
        wall = ~backdrop[pixels].reshape(height, width)
        y, x = np.divmod(np.arange(width * height), width)
        terms = np.column_stack((np.ones(len(x)), x / width - 0.5, y / width - 0.5))
        modelled, agreed = (values[pixels].astype(np.float64) for values in (model_depth, depths.depth))
        for most in EVEN:
            plain = even_pixels(photographs.colours[pixels].reshape(height, width, 3), most) & wall
            label = np.asarray(cv2.connectedComponents(plain.astype(np.uint8), connectivity=4)[1])
            for number in np.flatnonzero(np.bincount(label.ravel())[1:] >= SMALLEST * width * height) + 1:
                own = label == number
                (area,), (known,) = np.nonzero(own.ravel()), np.nonzero(own.ravel() & np.isfinite(modelled))
                if len(known) < LEAST_KNOWN * len(area):
                    continue
                around = cv2.dilate(own.astype(np.uint8), beside).ravel() > 0
                (sure,) = np.nonzero(around & np.isfinite(agreed))
                sure = sure if len(sure) >= FEWEST_AGREED else sure[:0]
                near = np.concatenate((np.full(len(known), tolerance), SURE_PLANES * depths.error[pixels][sure]))
                inverse = 1.0 / np.concatenate((modelled[known], agreed[sure]))
                both = terms[np.concatenate((known, sure))]
                plane = _plane(both, inverse, near * inverse * inverse, len(known), draw)
                if plane is None or (terms[area] @ plane).min() <= 0.0:
                    continue
                depth = 1.0 / (terms[area] @ plane)
                origins, along = photographs.of_pixels(first + area)
                if is_air(origins + depth[:, None] * along).mean() <= MOST_IN_AIR:
                    found[first + area] = depth
                    wall[own] = False
    return found


def _plane(
    terms: FloatArray, inverse: FloatArray, allowed: FloatArray, modelled: int, draw: np.random.Generator
) -> FloatArray | None:
    """Coefficients of a plane on or behind which an area lies, or None.

    Args:
        terms: Constant, column and row of each depth, shape (n, 3).
        inverse: Inverse depths, shape (n,), [1 / world unit].
        allowed: How far each may be off, shape (n,), same unit.
        modelled: How many of them, the first, are the model's; the others are those of photographs.
        draw: Source of the triples that are tried.
    """
    count, of_model = len(inverse), np.arange(len(inverse)) < modelled
    corners = draw.integers(modelled, size=(_TRIALS, 3))
    if count > modelled:
        corners = np.concatenate((corners, draw.integers(modelled, count, size=(_TRIALS, 3))))
    corners = corners[np.abs(np.linalg.det(terms[corners])) > 1e-6]
    if len(corners) == 0:
        return None
    trials = np.linalg.solve(terms[corners], inverse[corners][..., None])[..., 0]
    nearer = (inverse[:, None] - terms @ trials.T) / allowed[:, None]
    agree = np.abs(nearer) < 1.0
    score = agree[of_model].mean(axis=0) + (agree[~of_model].mean(axis=0) if count > modelled else 0.0)
    before = (nearer[of_model] >= 1.0).mean(axis=0)
    on_plane = agree[:, np.where(before <= MOST_BEFORE, score, -1.0).argmax()]
    for _ in range(_FITS):
        enough = on_plane[of_model].mean() >= LEAST_SHARE
        if not enough and not (count > modelled and on_plane[~of_model].mean() >= LEAST_AGREED):
            return None
        rows, values = terms[on_plane] / allowed[on_plane, None], inverse[on_plane] / allowed[on_plane]
        plane = np.linalg.lstsq(rows, values, rcond=None)[0]
        off = (inverse - terms @ plane) / allowed
        on_plane = np.abs(off) < 1.0
    if np.mean(off[of_model] >= 1.0) > MOST_BEFORE or on_plane.sum() < FEWEST_AGREED:
        return None
    x, y = terms[on_plane, 1], terms[on_plane, 2]
    bent = np.column_stack((terms[on_plane], x * x, x * y, y * y)) / allowed[on_plane, None]
    left = off[on_plane] - bent @ np.linalg.lstsq(bent, off[on_plane], rcond=None)[0]
    return None if np.linalg.norm(left) < CURVED * np.linalg.norm(off[on_plane]) else plane
