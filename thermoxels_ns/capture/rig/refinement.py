"""Maximises scores of rigs, and refines a rig by small windows in which temperature is linear in brightness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.optimize import approx_fprime, minimize

from thermoxels_ns.capture.rig.images import FARTHEST_FROM_POINT, SURE_DISTANCE, FloatImage, PreparedFrames, RigScore
from thermoxels_ns.capture.rig_types import RigModel
from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray

_DIFFERENCE_PX = 0.05
_MOST_STEPS = 20
_GRADIENT_TOLERANCE = 3e-2
THERMAL_BLUR_PX = 0.6
"""Standard deviation [thermal pixels] of a blur of both images, which makes errors of interpolation negligible."""
_NOISE_TO_MEDIAN = 0.6745
_NOISE_KERNEL = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
_SMALLEST_VARIANCE = 1e-8
_STEP_PX = 1e-3
_BLOCKS = 4
"""Every image is divided into _BLOCKS x _BLOCKS parts; their contributions to a derivative count as independent."""
_PITCH = 1.3  # pixels of the reduced photograph per thermal pixel
_WINDOW_PX = 1.0
_LENS_BLURS_PX = (0.0, 0.5, 0.8, 1.2, 1.6)
"""Standard deviations [thermal pixels] of the thermal lens's blur that are tried; the pixel's own blur is added."""
_BLUR_FRAMES, _BLUR_WINDOWS = 8, 1000
"""Numbers of frames, and of windows in each, with which the blur is chosen and the agreement is tested."""
_MOST_WINDOWS = 3000
_AGREEMENT = 0.9  # a window agrees if its R2 (`WindowScore`) is above this
_REACHES_PX = (0.5, 0.25, 0.0, 0.0)
"""Distance [thermal pixels] along x and y, in each round, within which a window must agree somewhere to be used."""
_FEWEST_WINDOWS = 150
_ABOVE_CHANCE = 3.0
_ELSEWHERE_PX = 5.0
_MOST_SHIFT_PX = 2.0
_CORRELATED_FRAMES = 6
"""Number of frames that together count as one independent frame. In five synthetic captures of 36 frames, the turn was
wrong by 0.09 degrees (median) with 6, and by 0.22 with 36; with 1, it was no better in four of these captures."""
_STATED_SHARE = 0.25
"""Share of the windows' information that the covariance is computed from. In synthetic captures, principal point and
turn were wrong by one to two times the standard errors that follow from the scatter of the windows."""


@dataclass(frozen=True, eq=False)
class RigPosterior:
    """A score of rigs as log likelihood, with a normal prior of mean 0 for each of the ten changes (`PARAMETERS`)."""

    score: RigScore | WindowScore
    sigmas: FloatArray  # prior standard deviations of the changes, shape (10,); a change with 0 is fixed at 0
    median_depth: float  # median depth of the scene points [world units]
    correlated: float = 1.0
    """Number of parts (rows of `score.slopes`) that show the same things; it multiplies the derivative's variance."""

    def maximum(self, change: FloatArray) -> FloatArray:
        """Return the ten changes that maximise the log posterior weight * score - sum((change / sigma)^2) / 2 (BFGS).
        The search starts at `change` (10,); `_information` finds the weight there."""
        free = self.sigmas > 0.0
        z = change[free] / self.sigmas[free]
        weight, information = self._information(z)
        root = np.linalg.cholesky(np.linalg.inv(information + np.eye(len(z))))

        def negative(y: FloatArray) -> tuple[float, FloatArray]:
            point = z + root @ y
            value, parts = self._slopes(point)
            return 0.5 * float(point @ point) - weight * value, root.T @ (point - weight * parts.sum(axis=0))

        options = {"maxiter": _MOST_STEPS, "gtol": _GRADIENT_TOLERANCE}
        best = minimize(negative, np.zeros(len(z)), jac=True, method="BFGS", options=options)
        return self._full(z + root @ best.x)

    def covariance(self, change: FloatArray, stated_share: float = 1.0) -> FloatArray:
        """Return the changes' posterior covariance (10, 10) at a maximum, with `stated_share` of the information."""
        free = self.sigmas > 0.0
        _, information = self._information(change[free] / self.sigmas[free])
        inverse = np.linalg.inv(stated_share * information + np.eye(len(information)))
        covariance = np.zeros((len(change),) * 2)
        covariance[np.ix_(free, free)] = inverse * np.outer(self.sigmas[free], self.sigmas[free])
        return covariance

    def _full(self, z: FloatArray) -> FloatArray:
        change = np.zeros(len(self.sigmas))
        change[self.sigmas > 0.0] = z * self.sigmas[self.sigmas > 0.0]
        return change

    def _slopes(self, z: FloatArray) -> tuple[float, FloatArray]:
        value, parts = self.score.slopes(self._full(z))
        return value, (parts * self.sigmas)[:, self.sigmas > 0.0]

    def _information(self, z: FloatArray) -> tuple[float, FloatArray]:
        """Return the score's weight and its information matrix, weight * H, at the free changes z in units of sigma.

        H is the negative Hessian matrix of the score, and G the scatter of its parts' contributions to the gradient. A
        maximum of the score has the covariance H^-1 G H^-1 (Huber 1967, for independent parts). It is (weight * H)^-1
        if weight * G = H. The weight is the inverse of the median of the ratio G / H over H's principal directions,
        because the ratio is unreliable in directions that the images hardly determine.
        """
        camera = self.score.rig.camera
        turn, shift = 1.0 / camera.fl_x, self.median_depth / camera.fl_x
        per_pixel = np.array([turn] * 3 + [shift] * 3 + [2.0 / camera.width, 1.0, 1.0, 0.2])
        steps = (_DIFFERENCE_PX * per_pixel)[self.sigmas > 0.0] / self.sigmas[self.sigmas > 0.0]
        curvature = -np.asarray(approx_fprime(z, lambda y: self._slopes(y)[1].sum(axis=0), steps))
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        values = np.maximum(np.abs(values), 1e-6 * max(float(np.abs(values).max()), 1e-12))
        parts = self._slopes(z)[1] @ vectors
        ratio = len(parts) * self.correlated * parts.var(axis=0, ddof=1) / values
        weight = 1.0 / max(float(np.median(ratio)), 1e-9)
        return weight, weight * (vectors * values) @ vectors.T


@dataclass(frozen=True, eq=False)
class Windows:
    """Small windows of one photograph, each of k points in space, and the functions that are fitted to temperatures."""

    points: FloatArray  # points of all windows, in the visible camera's OpenCV axes, shape (n, 3) [world units]
    index: IntArray  # indices into `points` of each window's points, shape (windows, k)
    plain: FloatArray  # orthonormal basis of the weighted planes a + b x + c y of each window, shape (k, 3)
    bright: FloatArray
    """Weighted brightness of every window, orthogonal to the planes and of length 1, shape (windows, k)."""
    weight: FloatArray  # square roots of the weights of a window's points, shape (k,)
    trust: FloatArray  # weight of each window in the likelihood, 0 to 1, shape (windows,)

    @property
    def middle(self) -> IntArray:
        """Index into `points` of the middle point of each window, shape (windows,)."""
        return self.index[:, self.index.shape[1] // 2]

    def chosen(self, keep: npt.NDArray) -> Windows:
        """Return the windows that the mask or the indices `keep` select."""
        used, index = np.unique(self.index[keep], return_inverse=True)
        index = index.reshape(-1, self.index.shape[1])
        return Windows(self.points[used], index, self.plain, self.bright[keep], self.weight, self.trust[keep])


class SmoothThermal:
    """A thermal image's local contrast, slightly blurred and interpolated by a cubic spline."""

    def __init__(self, contrast: FloatImage) -> None:
        """Fit the spline to the local contrast (height, width) [K], which is NaN in unknown pixels."""
        bad = ~np.isfinite(contrast)
        # The noise is estimated from second differences along both axes at once (Immerkaer 1996).
        curved = np.abs(ndimage.convolve(contrast.astype(np.float64), _NOISE_KERNEL, mode="nearest"))
        curved = curved[np.isfinite(curved)]
        self.noise_k = float(np.median(curved)) / _NOISE_TO_MEDIAN if len(curved) else 0.0
        """Standard deviation of the pixels' independent noise [K]."""
        filled = np.where(bad, 0.0, contrast).astype(np.float64)
        smooth = cv2.GaussianBlur(filled, (0, 0), THERMAL_BLUR_PX, borderType=cv2.BORDER_REFLECT)
        self._spline = np.asarray(ndimage.spline_filter(smooth, order=3, mode="mirror"))
        good = np.logical_not(ndimage.binary_dilation(bad, np.ones((5, 5))))
        self._good = np.pad(good[1:-1, 1:-1], 1).astype(np.float64)
        self.shape = contrast.shape
        """Height and width of the image, [pixels]."""

    def usable(self, pixels: FloatArray) -> BoolArray:
        """Return a mask (n,) of the pixels (n, 2) that lie inside the image's border and away from missing pixels."""
        return ndimage.map_coordinates(self._good, _place(pixels), order=0, mode="constant") > 0.0

    def value(self, pixels: FloatArray) -> FloatArray:
        """Return the local contrast at pixel positions (n, 2), shape (n,) [K]."""
        sampled = ndimage.map_coordinates(self._spline, _place(pixels), order=3, prefilter=False, mode="nearest")
        return np.asarray(sampled)

    def slope(self, pixels: FloatArray) -> FloatArray:
        """Return the derivatives of `value` along x and y at pixel positions (n, 2), shape (n, 2) [K/pixel]."""
        steps = (_STEP_PX, 0.0), (0.0, _STEP_PX)
        rises = [self.value(pixels + step) - self.value(pixels - step) for step in steps]
        return np.column_stack(rises) / (2.0 * _STEP_PX)


def _place(pixels: FloatArray) -> FloatArray:
    """Return pixel positions (n, 2), x and y, as array rows and columns (2, n); NaN becomes a place outside."""
    return np.nan_to_num(pixels, nan=-9.0)[:, ::-1].T - 0.5


class WindowScore:
    """Score of a rig: how well brightness explains temperature in small windows of all frames.

    A window of about three thermal pixels mostly shows two materials. Its temperatures then are t = a + b x + c y + d p
    with the photograph's brightness p, blurred as by the thermal camera. R2 is the share of the temperature's variance
    about the plane a + b x + c y that d p explains. The log likelihood of n independent readings is -n / 2 log(1 - R2);
    n is the window's trust (`Windows.trust`), and `RigPosterior` scales the sum. The gain d is free in every window, so
    warm things may be bright or dark. Windows with more than two materials should be left out by the caller.
    """

    def __init__(self, windows: Sequence[Windows], thermal: Sequence[SmoothThermal], rig: RigModel) -> None:
        """Store the windows of each photograph, the thermal images of the same frames and the start `rig`."""
        self.frames, self.rig = list(zip(windows, thermal)), rig
        self.count = sum(len(each.index) for each in windows)
        """Number of windows in all frames."""
        # One noise level for all images: no window counts as more certain than the noise allows.
        self._noise = float(np.median([image.noise_k for image in thermal])) if len(thermal) else 0.0

    def agreement(self, change: FloatArray, shift_px: tuple[float, float] = (0.0, 0.0)) -> list[FloatArray]:
        """Return R2 of every window at the ten changes `change` (10,), one array (windows,) per frame. Projected
        windows are moved by `shift_px`, x and y [thermal pixels]. R2 is 0 if a window leaves the image."""
        result = []
        for windows, thermal in self.frames:
            pixels = self.rig.project(change, windows.points) + shift_px
            _, gain, spread = self._fit(windows, thermal.value(pixels))
            result.append(np.where(thermal.usable(pixels)[windows.index].all(axis=1), gain**2 / spread, 0.0))
        return result

    def slopes(self, change: FloatArray) -> tuple[float, FloatArray]:
        """Return the score (a mean over windows) at `change` (10,), and each image part's share of its derivative. The
        shares have the shape (parts, 10); the derivative is their sum. For the parts see `_BLOCKS`."""
        total, rows, share = 0.0, [np.zeros((0, 10))], 0.5 / max(self.count, 1)
        for windows, thermal in self.frames:
            pixels = self.rig.project(change, windows.points)
            value, gain, spread = self._fit(windows, thermal.value(pixels))
            total -= share * float(windows.trust @ np.log1p(-(gain**2) / spread))
            left = value - gain[:, None] * windows.bright
            by_value = value / spread[:, None] - left / (spread - gain**2)[:, None]
            by_value *= 2.0 * share * windows.trust[:, None] * windows.weight
            slope = thermal.slope(pixels)
            share_of_image = np.nan_to_num(pixels[windows.middle], nan=0.0) / thermal.shape[::-1]
            column, row = np.clip((share_of_image * _BLOCKS).astype(int), 0, _BLOCKS - 1).T
            block = row * _BLOCKS + column
            for part in (block == number for number in np.unique(block)):
                summed = np.bincount(windows.index[part].ravel(), by_value[part].ravel(), len(windows.points))
                touched = np.flatnonzero(summed)
                row_of_part = self.rig.pull_back(
                    change, windows.points[touched], summed[touched, None] * slope[touched]
                )
                rows.append(row_of_part[None])
        return total, np.concatenate(rows)

    def _fit(self, windows: Windows, temperature: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fit each window's `temperature` (of all points) by plane and brightness; R2 is gain^2 / spread. Returns the
        weighted temperatures minus their plane (windows, k), the gain of the brightness (windows,), and the spread
        (windows,): the sum of squares of the first plus a floor for noise."""
        value = temperature[windows.index] * windows.weight
        value = value - (value @ windows.plain) @ windows.plain.T
        gain = np.einsum("wk,wk->w", windows.bright, value)
        floor = (self._noise**2 + _SMALLEST_VARIANCE) * float(windows.weight @ windows.weight)
        return value, gain, np.sum(value * value, axis=1) + floor


def refine(
    prepared: PreparedFrames, rig: RigModel, change: FloatArray, sigmas: FloatArray
) -> tuple[FloatArray, FloatArray, int] | None:
    """Return the changes of a rig at which the windows of photographs and thermal images agree best (`WindowScore`).

    The search starts at `change` (10,), which may be wrong by about a pixel; `sigmas` (10,) are prior standard
    deviations. The comparison of edges leaves a bias of some tenths of a pixel, because edges differ in strength in
    photographs and thermal images. Windows with R2 above `_AGREEMENT` do not have this bias; they are chosen again
    before each maximisation. Frames show the same things, so `_CORRELATED_FRAMES` frames count as one.

    Returns the ten changes, their covariance (10, 10) and the number of windows that agree. Returns None if too few
    windows agree, if hardly more agree than by chance, or if points would move by `_MOST_SHIFT_PX` or more (median).
    """
    visible, frames = prepared.visible, prepared.frames
    same = rig.camera.fl_x / visible.fl_x  # scale that makes the photograph's pixels as wide as thermal pixels
    scale = min(_PITCH * same, *(frame.grey.shape[1] / visible.width for frame in frames))
    pitch, reduced = scale / same, visible.resized(*(max(round(n * scale), 8) for n in (visible.width, visible.height)))
    shape = reduced.height, reduced.width
    rays = reduced.rays(np.argwhere(np.ones(shape))[:, ::-1] + 0.5)
    inside = rig.camera.contains(rig.project(change, rays * prepared.median_depth))
    surfaces = [frame.depth.at(rays[inside]) for frame in frames]  # depths, and distances to the next scene point

    def windows_of(number: int, lens_blur_px: float, most: int) -> Windows:
        grey = cv2.resize(frames[number].grey, shape[::-1], interpolation=cv2.INTER_AREA)
        # A pixel is a box: of width 1 in the thermal image, 1 / pitch in the photograph; width w has variance w^2 / 12.
        variance = THERMAL_BLUR_PX**2 + lens_blur_px**2 + (1.0 - 1.0 / pitch**2) / 12.0
        blurred = cv2.GaussianBlur(grey, (0, 0), np.sqrt(max(variance, 0.01)) * pitch, borderType=cv2.BORDER_REPLICATE)
        depth, distance = surfaces[number]
        known = distance < FARTHEST_FROM_POINT
        usable, points, trust = inside.copy(), rays.copy(), np.zeros(len(rays))
        usable[inside] = known
        points[usable] *= depth[known, None]
        trust[usable] = 1.0 / (1.0 + (distance[known] / SURE_DISTANCE) ** 4)
        window_px = float(np.hypot(_WINDOW_PX, lens_blur_px))
        return choose_windows(blurred.astype(np.float32), points, usable.reshape(shape), trust, pitch, window_px, most)

    thermal = [SmoothThermal(frame.contrast) for frame in frames]
    some = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _BLUR_FRAMES)).astype(int))

    def trial(blur_px: float) -> WindowScore:
        return WindowScore([windows_of(n, blur_px, _BLUR_WINDOWS) for n in some], [thermal[n] for n in some], rig)

    def agreeing(score: WindowScore, shift_px: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
        every = np.concatenate(score.agreement(change, shift_px))
        return every[every > _AGREEMENT]

    trials = [(blur_px, trial(blur_px)) for blur_px in _LENS_BLURS_PX]
    blur_px, score = max(trials, key=lambda tried: float(-np.log1p(-agreeing(tried[1])).sum()))
    here, far = len(agreeing(score)), _ELSEWHERE_PX
    elsewhere = np.mean([len(agreeing(score, shift)) for shift in ((far, far), (-far, far), (far, -far), (-far, -far))])
    if here < _FEWEST_WINDOWS * len(some) / len(frames) or here <= _ABOVE_CHANCE * max(float(elsewhere), 1.0):
        return None
    every = [windows_of(number, blur_px, _MOST_WINDOWS) for number in range(len(frames))]
    score, start = WindowScore(every, thermal, rig), change
    posterior, count = RigPosterior(score, sigmas, prepared.median_depth), score.count
    for reach_px in _REACHES_PX:
        steps = sorted({-reach_px, 0.0, reach_px})
        around = [score.agreement(change, (x, y)) for x in steps for y in steps]
        agree = (np.max(found, axis=0) > _AGREEMENT for found in zip(*around))
        chosen = WindowScore([windows.chosen(mask) for windows, mask in zip(every, agree)], thermal, rig)
        count = chosen.count
        if count < _FEWEST_WINDOWS:
            return None
        posterior = RigPosterior(chosen, sigmas, prepared.median_depth, min(len(frames), _CORRELATED_FRAMES))
        change = posterior.maximum(change)
    points = np.concatenate([windows.points for windows in every])
    moved = np.linalg.norm(rig.project(change, points) - rig.project(start, points), axis=1)
    if not np.nanmedian(moved) < _MOST_SHIFT_PX:
        return None
    return change, posterior.covariance(change, _STATED_SHARE), count


def choose_windows(
    photograph: FloatImage,
    points: FloatArray,
    usable: BoolArray,
    trust: FloatArray,
    pitch: float,
    window_px: float,
    most: int,
) -> Windows:
    """Return those windows of a photograph whose brightness has the most contrast.

    Args:
        photograph: Brightness, blurred as by the thermal camera, shape (height, width).
        points: Scene point at each pixel in the visible camera's OpenCV axes, shape (height * width, 3).
        usable: True for pixels that a window may contain, shape (height, width).
        trust: Trust in a window whose middle is at each pixel, shape (height * width,).
        pitch: Pixels of this photograph per thermal pixel.
        window_px: Standard deviation of a window's weights [thermal pixels].
        most: Largest number of windows.
    """
    sigma, reach = window_px * pitch, int(np.ceil(2.0 * window_px * pitch))
    down, across = (axis.ravel() for axis in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    near = down**2 + across**2 <= 4.0 * sigma**2
    down, across = down[near], across[near]
    weight = np.exp(-0.25 * (down**2 + across**2) / sigma**2)
    plain = np.asarray(np.linalg.qr(np.column_stack([np.ones(len(down)), across, down]) * weight[:, None])[0])
    whole = ndimage.minimum_filter(usable, size=2 * reach + 1, mode="constant")
    step = max(round(sigma), 1)
    picked = np.zeros_like(whole)
    picked[reach::step, reach::step] = whole[reach::step, reach::step]
    index = np.flatnonzero(picked)[:, None] + down * photograph.shape[1] + across
    bright = photograph.ravel()[index] * weight
    bright -= (bright @ plain) @ plain.T
    length = np.linalg.norm(bright, axis=1)
    best = np.sort(np.argsort(-length, kind="stable")[:most])
    bright /= np.maximum(length, _SMALLEST_VARIANCE)[:, None]
    every = Windows(points, index, plain, bright, weight, trust[index[:, index.shape[1] // 2]])
    return every.chosen(best[length[best] > _SMALLEST_VARIANCE])
