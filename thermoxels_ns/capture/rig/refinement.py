"""Maximises scores of rigs, and refines a rig by windows of thermal images that follow the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.optimize import minimize

from thermoxels_ns.capture.rig.images import (
    FARTHEST_FROM_POINT,
    SURE_DISTANCE,
    FloatImage,
    PreparedFrame,
    PreparedFrames,
    RigScore,
)
from thermoxels_ns.capture.rig_types import PARAMETERS, FloatArray, RigModel

IntArray = npt.NDArray[np.int64]

_DIFFERENCE_PX = 0.05
_MOST_STEPS = 20
_GRADIENT_TOLERANCE = 3e-2
THERMAL_BLUR_PX = 0.6
"""Blur of both images before they are compared, so that interpolation between thermal pixels does not show."""
_NOISE_TO_MEDIAN = 0.6745
_NOISE_KERNEL = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
_SMALLEST_VARIANCE = 1e-8
_STEP_PX = 1e-3
_BLOCKS = 4
"""Contributions to a slope are summed over this many times as many parts of every image, which count as independent."""
_PITCH = 1.3  # pixels of the reduced photograph per thermal pixel
_WINDOW_PX = 1.0
_LENS_BLURS_PX = (0.0, 0.5, 0.8, 1.2, 1.6)
"""Blurs of the thermal camera that are tried, beside the pixel itself [thermal pixels]."""
_BLUR_FRAMES, _BLUR_WINDOWS = 8, 1000
"""From how many frames and windows of each the blur is chosen, and whether windows agree at all is seen."""
_MOST_WINDOWS = 3000
_AGREEMENT = 0.9  # R2 from which on a window counts
_REACHES_PX = (0.5, 0.25, 0.0, 0.0)
"""How far around its place a window may agree to count, in every round [thermal pixels]."""
_FEWEST_WINDOWS = 150
_ABOVE_CHANCE = 3.0
_ELSEWHERE_PX = 5.0
_MOST_SHIFT_PX = 2.0
_CORRELATED_FRAMES = 6
"""Frames that count as one. In five drawn captures of 36 frames the turn was wrong by 0.09 degrees (median) with 6, by
0.22 where all counted as one; where none did, no better in the four that were tried."""
_CENTRE = [PARAMETERS.index(name) for name in ("cx", "cy")]
_CENTRE_INFLATION = 4.0
"""By how much the windows' information on the principal point is divided. In drawn captures with known rigs its errors
were one to two times what the scatter of the windows says, up to six times in one; those of the rest were not."""


@dataclass(frozen=True, eq=False)
class RigFit:
    """Ten changes of a rig and the score that they reach."""

    change: FloatArray
    score: float


class RigMaximizer:
    """Maximises weight * score - 0.5 * sum((change / sigma)^2) over the changes whose sigma is above 0.

    The weight makes the score's curvature H the information that it carries: with G the scatter of the frames'
    contributions to the slope, the covariance of the maximum alone is H^-1 G H^-1 (the sandwich of M-estimators, Huber
    1967, frames taken as independent), which (weight * H)^-1 equals if weight * G = H. The median over H's principal
    directions is taken, because those that the images hardly determine have no reliable ratio.

    Errors of parts that show the same things are correlated: where `correlated` of them are, their scatter counts that
    many times.
    """

    def __init__(
        self, score: RigScore | WindowScore, sigmas: FloatArray, median_depth: float, correlated: float = 1.0
    ) -> None:
        """Take a score, the prior standard deviations, the scene's median depth and how many parts are correlated."""
        self._correlated = correlated
        self._score = score
        self._sigmas = sigmas
        self._free = np.flatnonzero(sigmas > 0.0)
        self._scale = sigmas[self._free]
        focal = score.rig.camera.fl_x
        reach = 0.5 * score.rig.camera.width
        per_pixel = np.array([1 / focal] * 3 + [median_depth / focal] * 3 + [1 / reach] + [1.0] * 2 + [0.2])
        self._step = _DIFFERENCE_PX * per_pixel[self._free] / self._scale

    def maximize(self, change: FloatArray) -> RigFit:
        """Maximise from `change` on (BFGS)."""
        z = change[self._free] / self._scale
        weight, information, _ = self._information(z)
        root = np.linalg.cholesky(np.linalg.inv(weight * information + np.eye(len(z))))

        def negative(y: FloatArray) -> tuple[float, FloatArray]:
            point = z + root @ y
            value, slopes = self._score.slopes(self._full(point))
            slope = weight * slopes.sum(axis=0)[self._free] * self._scale - point
            return -(weight * value - 0.5 * float(point @ point)), -(root.T @ slope)

        options = {"maxiter": _MOST_STEPS, "gtol": _GRADIENT_TOLERANCE}
        best = minimize(negative, np.zeros(len(z)), jac=True, method="BFGS", options=options)
        change = self._full(z + root @ best.x)
        return RigFit(change, self._score.value(change))

    def covariance(self, change: FloatArray) -> FloatArray:
        """Covariance of the ten changes at a maximum, shape (10, 10); 0 for those that are kept fixed."""
        weight, information, scatter = self._information(change[self._free] / self._scale)
        posterior = np.linalg.inv(weight * information + np.eye(len(self._free)))
        spread = posterior @ (weight**2 * scatter + np.eye(len(self._free))) @ posterior
        result = np.zeros((len(change), len(change)))
        result[np.ix_(self._free, self._free)] = spread * np.outer(self._scale, self._scale)
        return result

    def _full(self, z: FloatArray) -> FloatArray:
        change = np.zeros(len(self._sigmas))
        change[self._free] = z * self._scale
        return change

    def _information(self, z: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Weight, curvature made positive and scatter of the frames' slopes, in standard deviations of the start."""
        _, slopes = self._score.slopes(self._full(z))
        own = slopes[:, self._free] * self._scale
        total, frames = own.sum(axis=0), len(own)
        centred = own - own.mean(axis=0)
        scatter: FloatArray = centred.T @ centred * (self._correlated * frames / max(frames - 1, 1))
        curvature: FloatArray = np.empty((len(z), len(z)))
        for number, step in enumerate(self._step):
            moved = z.copy()
            moved[number] += step
            ahead = self._score.slopes(self._full(moved))[1].sum(axis=0)[self._free] * self._scale
            curvature[number] = (total - ahead) / step
        symmetric: FloatArray = 0.5 * (curvature + curvature.T)
        values, vectors = np.linalg.eigh(symmetric)
        values = np.maximum(np.abs(values), 1e-6 * max(float(np.abs(values).max()), 1e-12))
        ratio = np.einsum("ij,ik,kj->j", vectors, scatter, vectors) / values
        weight = 1.0 / max(float(np.median(ratio)), 1e-9)
        information = np.asarray((vectors * values) @ vectors.T, dtype=np.float64)
        return weight, information, scatter


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


@dataclass(frozen=True, eq=False)
class RefinedRig:
    """The rig after the last step."""

    change: FloatArray  # the ten changes
    covariance: FloatArray  # of the ten changes, shape (10, 10)
    windows: int  # how many windows it rests on


def refine(prepared: PreparedFrames, rig: RigModel, change: FloatArray, sigmas: FloatArray) -> RefinedRig | None:
    """Move a rig that is right to about a pixel to where the windows agree best.

    The comparison of edges leaves a bias of some tenths of a pixel, because edges in a photograph and in a thermal
    image are not of the same strength. Windows that one gain explains almost wholly do not have it; they are chosen
    anew after each maximisation. Frames show the same things, so up to six together count as one in the standard errors
    and against the prior.

    None where too few windows agree, or hardly more than by chance.
    """
    view = _View.of(prepared, rig, change)
    count = len(prepared.frames)
    some = np.unique(np.linspace(0, count - 1, min(count, _BLUR_FRAMES)).astype(int))
    few = [prepared.frames[number] for number in some]
    smooth = [SmoothThermal(frame.contrast) for frame in few]
    trials = {
        blur_px: WindowScore([_design(frame, prepared, view, blur_px, _BLUR_WINDOWS) for frame in few], smooth, rig)
        for blur_px in _LENS_BLURS_PX
    }

    def explained(tried: float) -> float:
        """How well the windows that agree do so: the sum of -log(1 - R2)."""
        counted = [found[found > _AGREEMENT] for found in trials[tried].agreement(change)]
        return float(np.sum(-np.log1p(-np.concatenate([np.zeros(0), *counted]))))

    blur_px = max(trials, key=explained)
    if not _agrees(trials[blur_px], change, _FEWEST_WINDOWS * len(few) / count):
        return None
    thermal = [SmoothThermal(frame.contrast) for frame in prepared.frames]
    designs = [_design(frame, prepared, view, blur_px, _MOST_WINDOWS) for frame in prepared.frames]
    score = WindowScore(designs, thermal, rig)
    start, chosen, maximizer = change, score, RigMaximizer(score, sigmas, prepared.median_depth)
    for reach_px in _REACHES_PX:
        steps = (-reach_px, 0.0, reach_px) if reach_px > 0.0 else (0.0,)
        around = [score.agreement(change, (x, y)) for x in steps for y in steps]
        agree = (np.max(found, axis=0) > _AGREEMENT for found in zip(*around))
        chosen = WindowScore([design.chosen(mask) for design, mask in zip(designs, agree)], thermal, rig)
        if chosen.windows < _FEWEST_WINDOWS:
            return None
        maximizer = RigMaximizer(chosen, sigmas, prepared.median_depth, min(count, _CORRELATED_FRAMES))
        change = maximizer.maximize(change).change
    points = np.concatenate([design.points for design in score.designs])
    moved = np.linalg.norm(rig.project(change, points) - rig.project(start, points), axis=1)
    if not np.nanmedian(moved) < _MOST_SHIFT_PX:
        return None
    return RefinedRig(change, inflate_centre_covariance(maximizer.covariance(change), sigmas), chosen.windows)


def inflate_centre_covariance(covariance: FloatArray, sigmas: FloatArray) -> FloatArray:
    """State the principal point, and what stands for it, as less sure than the windows' scatter says.

    Turn and principal point differ in the image only by terms of second order, some tenths of a pixel in its corners,
    which errors that all windows share reach. With C_cc the covariance of the principal point and D that of the start,
    the information gained is C_cc^-1 - D^-1; a quarter of it counts. The other numbers follow by their regression on
    the principal point, so what they would be with it known stays as it is. Where the principal point is kept fixed
    (0 in `sigmas`), the covariance is unchanged.
    """
    if np.any(sigmas[_CENTRE] <= 0.0):
        return covariance
    before = np.diag(1.0 / sigmas[_CENTRE] ** 2)
    inner = covariance[np.ix_(_CENTRE, _CENTRE)]
    known = np.linalg.inv(inner)
    gained = _positive_part(known - before)
    added = _positive_part(np.linalg.inv(before + gained / _CENTRE_INFLATION) - inner)
    follow = covariance[:, _CENTRE] @ known
    return covariance + follow @ added @ follow.T


def _positive_part(symmetric: FloatArray) -> FloatArray:
    """A symmetric matrix with its negative eigenvalues set to 0."""
    values, vectors = np.linalg.eigh(0.5 * (symmetric + symmetric.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T, dtype=np.float64)


def _agrees(score: WindowScore, change: FloatArray, fewest: float) -> bool:
    """Whether enough windows agree here, and clearly more than some pixels away."""

    def count(shift_px: tuple[float, float]) -> int:
        return sum(int(np.count_nonzero(found > _AGREEMENT)) for found in score.agreement(change, shift_px))

    far, here = _ELSEWHERE_PX, count((0.0, 0.0))
    elsewhere = np.mean([count(shift) for shift in ((far, far), (-far, far), (far, -far), (-far, -far))])
    return here >= fewest and here > _ABOVE_CHANCE * max(float(elsewhere), 1.0)


@dataclass(frozen=True, eq=False)
class _View:
    """The reduced photograph's pixels, the same for all photographs."""

    size: tuple[int, int]  # width and height
    pitch: float  # its pixels per thermal pixel
    rays: FloatArray  # points at depth 1 that the pixels see, shape (height * width, 3)
    inside: npt.NDArray[np.bool_]  # which of them the thermal camera sees too, shape (height, width)

    @classmethod
    def of(cls, prepared: PreparedFrames, rig: RigModel, change: FloatArray) -> _View:
        visible = prepared.visible
        same = rig.camera.fl_x / visible.fl_x
        scale = min(_PITCH * same, *(frame.grey.shape[1] / visible.width for frame in prepared.frames))
        size = max(round(visible.width * scale), 8), max(round(visible.height * scale), 8)
        rows, columns = np.mgrid[: size[1], : size[0]]
        rays = visible.resized(*size).rays(np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5]))
        inside = rig.camera.contains(rig.project(change, rays * prepared.median_depth))
        return cls(size, scale / same, rays, inside.reshape(size[1], size[0]))


def _design(
    frame: PreparedFrame, prepared: PreparedFrames, view: _View, lens_blur_px: float, most: int
) -> WindowDesign:
    """Windows of a photograph, reduced and blurred to what the thermal camera sees of it."""
    pitch = view.pitch
    small = cv2.resize(frame.grey, view.size, interpolation=cv2.INTER_AREA)
    # The thermal pixel is a box of 1, the reduced photograph's one of 1 / pitch; a box of w has variance w^2 / 12.
    variance = THERMAL_BLUR_PX**2 + lens_blur_px**2 + (1.0 - 1.0 / pitch**2) / 12.0
    small = cv2.GaussianBlur(small, (0, 0), np.sqrt(max(variance, 0.01)) * pitch, borderType=cv2.BORDER_REPLICATE)
    window_px = float(np.hypot(_WINDOW_PX, lens_blur_px))
    design = window_design(small.astype(np.float32), view.rays, view.inside, pitch, window_px, most)
    return design.at_depth(*frame.depth.at(design.points), FARTHEST_FROM_POINT, SURE_DISTANCE)


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
