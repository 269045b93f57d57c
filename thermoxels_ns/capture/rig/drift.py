"""Drift and vignetting of a thermal camera, from scene points that many images show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix, hstack
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.capture.rig.images import read_temperatures
from thermoxels_ns.capture.rig.score import sampled
from thermoxels_ns.capture.rig_types import DriftEstimate, FloatArray, RigFrame, radius_squared
from thermoxels_ns.core.camera import Camera

_RADIAL_TERMS = 2
_HUBER = 1.345
_MAD_TO_SIGMA = 1.4826
_ITERATIONS = 30
_CONVERGED_K = 1e-5
_HELD_OUT_EVERY = 5
_MOST_LAG = 6
_FEWEST_POINTS = 50
_GAIN_OF_OFFSETS, _GAIN_OF_RADIAL = 0.05, 0.01
_RIDGE = 1e-9
_BLUR_PX = 1.0
_SMOOTH_SHARE = 0.4
_BORDER_PX = 2.0
IntArray = npt.NDArray[np.int64]


def estimate_drift(
    frames: Sequence[RigFrame], thermal_camera: Camera, visible_to_thermal: npt.ArrayLike
) -> DriftEstimate:
    """Find one offset per thermal image and a radial term, if the images call for them.

    An uncooled camera reads some kelvin too high or too low from image to image, and warmer or colder towards the
    corners. A scene point has one temperature, so what its readings differ by shows both.

    Reading of point i in frame f = temperature_i + offset_f + c1 r^2 + c2 r^4 + error. Robust least squares (Huber's
    loss, reweighted) on the differences between two readings of one point, in which its temperature does not occur;
    mean offset 0. The correction is fitted to four fifths of the points and kept only if it lowers the differences at
    the others.

    Without anything to gain the correction is all zeros, with `used` False and the reason. A `SceneError` is raised
    where a thermal image cannot be read or has not the camera's size.
    """
    if len(frames) < 2:
        return _nothing(len(frames), np.nan, f"{len(frames)} frame: there is nothing to compare it with")
    return drift_of_samples(sample_shared_points(frames, thermal_camera, np.asarray(visible_to_thermal, np.float64)))


def drift_of_samples(samples: DriftSamples) -> DriftEstimate:
    """Find the drift from readings of scene points; see `estimate_drift`."""
    frames = samples.num_frames
    if samples.num_points < _FEWEST_POINTS:
        reason = f"only {samples.num_points} scene points are seen by two thermal images (at least {_FEWEST_POINTS})"
        return _nothing(frames, np.nan, reason)
    held_out = np.arange(samples.num_points) % _HELD_OUT_EVERY == _HELD_OUT_EVERY - 1
    fit_to, test_on = samples.of_points(~held_out), samples.of_points(held_out)
    design, difference_k = _differences(test_on)
    plain, full = _fit(fit_to, 0), _fit(fit_to, _RADIAL_TERMS)
    nothing = np.zeros_like(plain)
    before_k, plain_k, full_k = (_median(difference_k - design @ fit) for fit in (nothing, plain, full))
    radial = full_k < (1.0 - _GAIN_OF_RADIAL) * plain_k
    after_k = full_k if radial else plain_k
    if not after_k < (1.0 - _GAIN_OF_OFFSETS) * before_k:
        after = f"{after_k:.3g} K with the best correction, at points it was not fitted to"
        return _nothing(frames, before_k, f"two images differ by {before_k:.3g} K at shared points, and by {after}")
    best = _fit(samples, _RADIAL_TERMS if radial else 0)
    offsets_k, coefficients = best[:frames] - best[:frames].mean(), best[frames:]
    groups = _groups(samples)
    explanation = (
        f"Two images differ by {before_k:.3g} K at shared scene points (median), after the correction by {after_k:.3g} "
        f"K at points it was not fitted to; offsets from {offsets_k.min():+.2f} to {offsets_k.max():+.2f} K"
        + (f", image corners read {coefficients.sum():+.2f} K" if radial else ", no radial term")
        + (f"; {groups} groups of images share no points, each has mean offset 0" if groups > 1 else "")
        + "."
    )
    used = tuple(coefficients.tolist()) if radial else ()
    return DriftEstimate(offsets_k, used, before_k, after_k, True, explanation)


def _differences(samples: DriftSamples) -> tuple[csr_matrix, FloatArray]:
    """Differences between readings of one point, (n,) [K], and the matrix that makes them of offsets and radial terms.

    The unknowns are the frames' offsets and the coefficients of r^2 and r^4, shape (n, frames + 2).
    """
    lags = [np.flatnonzero(samples.point[lag:] == samples.point[:-lag]) for lag in range(1, _MOST_LAG + 1)]
    first = np.concatenate(lags)
    second = first + np.repeat(np.arange(1, _MOST_LAG + 1), [len(each) for each in lags])
    ends = np.arange(len(samples.point)), samples.frame
    in_frame = csr_matrix((np.ones(len(samples.point)), ends), shape=(len(samples.point), samples.num_frames))
    readings: Any = hstack([in_frame, csr_matrix(samples.radius2[:, None] ** np.arange(1, _RADIAL_TERMS + 1))], "csr")
    return readings[second] - readings[first], samples.temperature_c[second] - samples.temperature_c[first]


def _fit(samples: DriftSamples, radial_terms: int) -> FloatArray:
    """Offsets and radial coefficients by iteratively reweighted least squares, the latter 0 beyond `radial_terms`."""
    design: Any
    design, difference_k = _differences(samples)
    columns = samples.num_frames + radial_terms
    solution, weight = np.zeros(design.shape[1]), np.ones(len(difference_k))
    for _ in range(_ITERATIONS):
        before = solution.copy()
        product = design.multiply(weight[:, None])
        weighted = product.T.tocsr()[:columns]
        # Minimum norm: every group of frames that shares points gets mean offset 0.
        normal, right = (weighted @ design[:, :columns]).toarray(), weighted @ difference_k
        solution[:columns] = np.linalg.lstsq(normal, right, rcond=_RIDGE)[0]
        residual = np.abs(difference_k - design @ solution)
        weight = np.minimum(1.0, _HUBER * max(_MAD_TO_SIGMA * _median(residual), 1e-9) / np.maximum(residual, 1e-12))
        if np.abs(solution - before).max() < _CONVERGED_K:
            break
    return solution


def _median(difference_k: FloatArray) -> float:
    """Median size of differences [K]; NaN where there are none."""
    return float(np.median(np.abs(difference_k))) if len(difference_k) else float("nan")


def _groups(samples: DriftSamples) -> int:
    """How many groups of frames there are that share no point with another group."""
    frames, points = samples.num_frames, samples.num_points
    ends = (samples.frame, frames + samples.point)
    links = csr_matrix((np.ones(len(samples.point)), ends), shape=(frames + points,) * 2)
    _, label = connected_components(links, directed=False)
    return len(np.unique(label[:frames]))


def _nothing(frames: int, before_k: float, reason: str) -> DriftEstimate:
    return DriftEstimate(np.zeros(frames), (), before_k, before_k, False, f"No correction: {reason}.")


@dataclass(frozen=True, eq=False)
class DriftSamples:
    """Readings of scene points, sorted by point, then by frame. Only points with at least two readings."""

    point: IntArray  # number of the point, 0 to points - 1, shape (n,)
    frame: IntArray  # number of the frame, shape (n,)
    temperature_c: FloatArray  # reading [degrees C], shape (n,)
    radius2: FloatArray  # squared distance from the image's centre, 1 in the corner, shape (n,)
    num_frames: int

    @property
    def num_points(self) -> int:
        """Number of different points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    def of_points(self, keep: npt.NDArray[np.bool_]) -> DriftSamples:
        """Only the readings of some points (by number), which are numbered anew."""
        stays = keep[self.point]
        number = np.cumsum(keep) - 1
        frame, temperature_c, radius2 = self.frame[stays], self.temperature_c[stays], self.radius2[stays]
        return DriftSamples(number[self.point[stays]], frame, temperature_c, radius2, self.num_frames)


def sample_shared_points(frames: Sequence[RigFrame], camera: Camera, visible_to_thermal: FloatArray) -> DriftSamples:
    """Read the temperature of scene points in the thermal images of the frames in which they were found.

    Points on steep temperature edges are left out, because there a pixel's error in place is a large error in degrees.
    """
    columns: list[tuple[IntArray, IntArray, FloatArray, FloatArray]] = []
    for number, frame in enumerate(frames):
        pixels = camera.project(frame.points_visible() @ visible_to_thermal[:3, :3].T + visible_to_thermal[:3, 3])
        inside = camera.contains(pixels, _BORDER_PX)
        pixels, point = pixels[inside], frame.point_ids[inside]
        reading, steepness = _read(read_temperatures(frame, camera), pixels)
        known = np.isfinite(reading) & np.isfinite(steepness)
        limit = np.quantile(steepness[known], _SMOOTH_SHARE) if known.any() else 0.0
        smooth = known & (steepness <= limit)
        radius2 = radius_squared(pixels[smooth], camera.width, camera.height)
        columns.append((point[smooth], np.full(len(radius2), number), reading[smooth], radius2))
    point, frame_number, reading, radius2 = (np.concatenate(parts) for parts in zip(*columns))
    _, point = np.unique(point, return_inverse=True)
    order = np.lexsort((frame_number, point))
    samples = DriftSamples(point[order], frame_number[order], reading[order], radius2[order], len(frames))
    return samples.of_points(np.bincount(samples.point) >= 2)


def _read(image: npt.NDArray[np.float32], pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Temperatures (n,) at pixel positions (n, 2), slightly smoothed, and how steep the image is there [K/pixel]."""
    smooth = cv2.GaussianBlur(image, (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE)  # NaN spreads, and is left out
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    value, steepness = (sampled(plane, pixels).astype(np.float64) for plane in (smooth, np.hypot(gx, gy)))
    return value, steepness
