"""Likelihood of a rig from small windows of photographs and thermal images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.capture.rig.parameters import RigModel
from thermoxels_ns.capture.rig_types import FloatArray

FloatImage = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

THERMAL_BLUR_PX = 0.6
"""Blur of both images before they are compared, so that interpolation between thermal pixels does not show."""
_NOISE_TO_MEDIAN = 0.6745
_NOISE_KERNEL = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
_SMALLEST_VARIANCE = 1e-8
_STEP_PX = 1e-3
_BLOCKS = 4
"""Contributions to a slope are summed over this many times as many parts of every image, which count as independent."""


@dataclass(frozen=True, eq=False)
class WindowDesign:
    """Windows of one photograph as points in front of its camera, with what temperatures are fitted by in each."""

    points: FloatArray  # shape (n, 3), the visible camera's OpenCV axes
    index: IntArray  # which points each window has, shape (windows, k)
    plain: FloatArray  # orthonormal basis of weighted planes a + b x + c y, the same in all windows, shape (k, 3)
    bright: FloatArray
    """The photograph in every window, orthogonal to the planes and of length 1, weighted, shape (windows, k)."""
    weight: FloatArray  # square roots of the weights of a window's points, shape (k,)
    trust: FloatArray  # how much each window counts, shape (windows,)

    def at_depth(self, depth: FloatArray, distance: FloatArray, farthest: float, sure: float) -> WindowDesign:
        """Move the points from depth 1 to their own and leave windows out that have a point of unknown depth.

        `distance` says how far each point lies from what its depth is known by: beyond `farthest` it is not known, up
        to `sure` a window counts fully.
        """
        points = self.points * np.where(np.isfinite(depth), depth, 1.0)[:, None]
        known = (np.isfinite(depth) & (distance < farthest))[self.index].all(axis=1)
        middle = distance[self.index[:, self.index.shape[1] // 2]]
        trust = 1.0 / (1.0 + np.where(known, middle / sure, 0.0) ** 4)
        return WindowDesign(points, self.index, self.plain, self.bright, self.weight, trust).chosen(known)

    def chosen(self, keep: npt.NDArray) -> WindowDesign:
        """Some of the windows only, by mask or number."""
        used, index = np.unique(self.index[keep], return_inverse=True)
        index = index.reshape(-1, self.index.shape[1])
        return WindowDesign(self.points[used], index, self.plain, self.bright[keep], self.weight, self.trust[keep])


class SmoothThermal:
    """A thermal image as cubic splines: its values and slopes between the pixels."""

    def __init__(self, contrast: FloatImage) -> None:
        """Take local contrasts, shape (height, width) [K]; NaN where there is none."""
        bad = ~np.isfinite(contrast)
        filled = np.where(bad, 0.0, contrast).astype(np.float64)
        # From second differences along both axes at once (Immerkaer 1996).
        curved = ndimage.convolve(np.where(bad, np.nan, filled), _NOISE_KERNEL, mode="nearest")
        curved = np.abs(curved[np.isfinite(curved)])
        self.noise_k = float(np.median(curved)) / _NOISE_TO_MEDIAN if len(curved) else 0.0
        """Standard deviation of the noise from pixel to pixel [K]."""
        smooth = cv2.GaussianBlur(filled, (0, 0), THERMAL_BLUR_PX, borderType=cv2.BORDER_REFLECT)
        self._spline = np.asarray(ndimage.spline_filter(smooth, order=3, mode="mirror"))
        near_bad = cv2.dilate(bad.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        near_bad[:1], near_bad[-1:], near_bad[:, :1], near_bad[:, -1:] = True, True, True, True
        self._bad = near_bad
        self.shape = contrast.shape
        """Height and width."""

    def usable(self, pixels: FloatArray) -> npt.NDArray[np.bool_]:
        """Which pixel positions (n, 2) lie in the image, one pixel from its border and away from missing pixels."""
        height, width = self._bad.shape
        place = np.nan_to_num(pixels, nan=-9.0)
        x, y = np.floor(place[:, 0]), np.floor(place[:, 1])
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        x, y = np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int)
        return inside & ~self._bad[y, x]

    def value(self, pixels: FloatArray) -> FloatArray:
        """Local contrast at pixel positions (n, 2), shape (n,) [K]."""
        return _sampled(self._spline, pixels)

    def slope(self, pixels: FloatArray) -> FloatArray:
        """Its derivatives along x and y, shape (n, 2) [K/pixel]."""
        steps = (_STEP_PX, 0.0), (0.0, _STEP_PX)
        rises = [_sampled(self._spline, pixels + step) - _sampled(self._spline, pixels - step) for step in steps]
        return np.column_stack(rises) / (2.0 * _STEP_PX)


class WindowScore:
    """The log likelihood of rigs, from the windows of all frames.

    In a window of about three thermal pixels a photograph mostly shows two materials, and so does the thermal image:
    there the temperature is t = a + b x + c y + d p of the photograph's brightness p, seen as blurred as the thermal
    camera sees it. With R2 the share of the temperature's variance about a + b x + c y that d p explains, the
    likelihood of a rig is sum(-n / 2 log(1 - R2)) over the windows. Gains d are free in every window, so warm may be
    bright or dark; a window that shows more than two materials fits badly, and where it is left out it pulls the rig
    nowhere.
    """

    def __init__(self, designs: Sequence[WindowDesign], thermal: Sequence[SmoothThermal], rig: RigModel) -> None:
        """Take windows of photographs, thermal images of the same frames and what changes count from."""
        self.designs, self.thermal, self.rig = list(designs), list(thermal), rig
        # The same floor for all windows: no window counts as known better than the noise allows.
        self._noise = float(np.median([image.noise_k for image in thermal])) if len(thermal) else 0.0

    @property
    def windows(self) -> int:
        """Number of windows."""
        return sum(len(design.index) for design in self.designs)

    def agreement(self, change: FloatArray, shift_px: tuple[float, float] = (0.0, 0.0)) -> list[FloatArray]:
        """R2 of every window, moved by `shift_px`, by frame; 0 where a window leaves the thermal image."""
        result = []
        for design, thermal in zip(self.designs, self.thermal):
            pixels = self.rig.project(change, design.points) + shift_px
            inside = thermal.usable(pixels)
            _, gain, spread = self._fit(design, thermal.value(np.where(inside[:, None], pixels, 1.0)))
            result.append(np.where(inside[design.index].all(axis=1), gain**2 / spread, 0.0))
        return result

    def value(self, change: FloatArray) -> float:
        """Log likelihood per window."""
        total = 0.0
        for design, thermal in zip(self.designs, self.thermal):
            _, gain, spread = self._fit(design, thermal.value(self.rig.project(change, design.points)))
            total += float(design.trust @ -np.log1p(-(gain**2) / spread))
        return 0.5 * total / max(self.windows, 1)

    def slopes(self, change: FloatArray) -> tuple[float, FloatArray]:
        """Log likelihood per window, and its derivative by parts of the images, shape (parts, 10)."""
        total, rows, share = 0.0, [], 0.5 / max(self.windows, 1)
        for design, thermal in zip(self.designs, self.thermal):
            if not len(design.index):
                continue
            pixels = self.rig.project(change, design.points)
            value, gain, spread = self._fit(design, thermal.value(pixels))
            total += share * float(design.trust @ -np.log1p(-(gain**2) / spread))
            left = value - gain[:, None] * design.bright
            by_value = value / spread[:, None] - left / (spread - gain**2)[:, None]
            by_value *= 2.0 * share * design.trust[:, None] * design.weight
            slope = thermal.slope(pixels)
            centre = pixels[design.index[:, design.index.shape[1] // 2]]
            share_of_image = np.nan_to_num(centre, nan=0.0) / thermal.shape[::-1]
            column, row = np.clip((share_of_image * _BLOCKS).astype(int), 0, _BLOCKS - 1).T
            label = row * _BLOCKS + column
            for part in (np.flatnonzero(label == number) for number in np.unique(label)):
                summed = np.bincount(design.index[part].ravel(), by_value[part].ravel(), len(design.points))
                touched = np.flatnonzero(summed)
                rows.append(self.rig.pull_back(change, design.points[touched], summed[touched, None] * slope[touched]))
        return total, np.array(rows).reshape(-1, 10)

    def _fit(self, design: WindowDesign, temperature: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Temperatures in each window without their plane (weighted), how much of the photograph is in them, and their
        sum of squares with the noise that is in it at least."""
        value = temperature[design.index] * design.weight
        value = value - (value @ design.plain) @ design.plain.T
        gain = np.einsum("wk,wk->w", design.bright, value)
        floor = (self._noise**2 + _SMALLEST_VARIANCE) * float(design.weight @ design.weight)
        return value, gain, np.sum(value * value, axis=1) + floor


def window_design(
    photograph: FloatImage, rays: FloatArray, usable: npt.NDArray[np.bool_], pitch: float, window_px: float, most: int
) -> WindowDesign:
    """Choose the windows of a photograph with most contrast; their points lie at depth 1.

    Args:
        photograph: Brightness, as blurred as the thermal camera sees it, shape (height, width).
        rays: Points at depth 1 that its pixels see, shape (height * width, 3), the visible camera's OpenCV axes.
        usable: Pixels that windows may have, shape (height, width).
        pitch: Pixels of this photograph per thermal pixel.
        window_px: Standard deviation of a window's weights [thermal pixels].
        most: How many windows to choose at most.
    """
    reach = int(np.ceil(2.0 * window_px * pitch))
    down, across = (axis.ravel() for axis in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    near = down**2 + across**2 <= (2.0 * window_px * pitch) ** 2
    down, across = down[near], across[near]
    weight = np.exp(-0.25 * (down**2 + across**2) / (window_px * pitch) ** 2)
    planes = np.column_stack([np.ones(len(down)), across, down]) * weight[:, None]
    plain = np.asarray(np.linalg.qr(planes)[0])
    height, width = photograph.shape
    whole = ndimage.minimum_filter(usable.astype(np.uint8), size=2 * reach + 1, mode="constant") > 0
    step = max(round(window_px * pitch), 1)
    picked = np.zeros_like(whole)
    picked[reach : height - reach : step, reach : width - reach : step] = True
    contrast = _contrast(photograph, near, plain, weight)
    strong = np.flatnonzero(whole & picked & (contrast > _SMALLEST_VARIANCE))
    strong = np.sort(strong[np.argsort(-contrast.ravel()[strong], kind="stable")[:most]])
    index = strong[:, None] + down * width + across
    bright = photograph.ravel()[index].astype(np.float64) * weight
    bright = bright - (bright @ plain) @ plain.T
    length = np.sqrt(np.sum(bright * bright, axis=1))
    index, bright, length = (each[length > _SMALLEST_VARIANCE] for each in (index, bright, length))
    used, number = np.unique(index, return_inverse=True)
    number, bright = number.reshape(-1, len(down)), bright / length[:, None]
    return WindowDesign(rays[used], number, plain, bright, weight, np.ones(len(index)))


def _contrast(photograph: FloatImage, near: npt.NDArray[np.bool_], plain: FloatArray, weight: FloatArray) -> FloatArray:
    """Length of what the window around each pixel has beside planes, shape (height, width)."""
    # |w p|^2 less the squares of (w p)'s parts along the planes, all of them correlations with small images.

    def correlated(image: FloatArray, entries: FloatArray) -> FloatArray:
        side = round(np.sqrt(near.size))
        kernel = np.zeros(near.size)
        kernel[near] = entries
        return np.asarray(cv2.filter2D(image, cv2.CV_64F, kernel.reshape(side, side)), dtype=np.float64)

    level: FloatArray = photograph.astype(np.float64) - float(np.mean(photograph))
    left = correlated(level * level, weight * weight)
    for along in plain.T:
        left -= correlated(level, weight * along) ** 2
    return np.sqrt(np.maximum(left, 0.0))


def _sampled(spline: FloatArray, pixels: FloatArray) -> FloatArray:
    place = np.nan_to_num(pixels, nan=-9.0)[:, ::-1].T - 0.5
    return np.asarray(ndimage.map_coordinates(spline, place, order=3, prefilter=False, mode="nearest"))
