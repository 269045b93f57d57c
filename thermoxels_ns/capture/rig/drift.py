"""Estimates drift and vignetting of a thermal camera from scene points that many thermal images show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage
from scipy.sparse import csr_matrix

from thermoxels_ns.capture.rig.images import read_temperatures
from thermoxels_ns.capture.rig_types import DriftEstimate, RigFrame, radius_squared
from thermoxels_ns.core.arrays import Float32Array, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera

_RADIAL_TERMS = 2
_HUBER = 1.345
_MAD_TO_SIGMA = 1.4826
_ITERATIONS = 30
_CONVERGED_K = 1e-3  # the fit ends when no unknown changes by more than this, less than the offsets' uncertainty
_HELD_OUT_EVERY = 5
_MOST_LAG = 6  # largest number of earlier readings of the same point with which a reading is compared
_FEWEST_POINTS = 50
_GAIN_OF_OFFSETS, _GAIN_OF_RADIAL = 0.05, 0.01
_RIDGE = 1e-9
_BLUR_PX = 1.0
_SMOOTH_SHARE = 0.4
_BORDER_PX = 2.0


def estimate_drift(samples: DriftSamples) -> DriftEstimate:
    """Return one offset per thermal image and a radial term, if they make the readings of scene points agree better.

    An uncooled camera reads some kelvin too high or too low from image to image, and warmer or colder towards the
    corners. A scene point has one temperature, so differences between its readings show both errors. The model is:
    reading of point i in frame f = temperature_i + offset_f + c1 r^2 + c2 r^4 + error. Offsets (mean 0) and
    coefficients are fitted to differences of two readings of one point by robust least squares (Huber's loss,
    iteratively reweighted). As a test, they are first fitted to four fifths of the points. If this does not lower the
    differences at the other points, the result has offsets of zero, `used` False and the reason.
    """
    frames = samples.num_frames
    points = int(samples.point[-1]) + 1 if len(samples.point) else 0
    if points < _FEWEST_POINTS:
        seen = f"only {points} scene points are seen by two thermal images (at least {_FEWEST_POINTS})"
        return DriftEstimate(np.zeros(frames), (), np.nan, np.nan, False, f"No correction: {seen}.")
    point, design, difference_k = _differences(samples)
    share = 1.0 / np.bincount(samples.point)[point]  # weight: a point's differences outnumber its readings
    held_out = point % _HELD_OUT_EVERY == _HELD_OUT_EVERY - 1
    before_k = float(np.median(np.abs(difference_k[held_out])))
    after = []
    for terms in (0, _RADIAL_TERMS):
        some = design[:, : frames + terms]
        left = difference_k - some @ _fit(some, difference_k, np.where(held_out, 0.0, share), frames + terms)
        after.append(float(np.median(np.abs(left[held_out]))))
    radial = after[1] < (1.0 - _GAIN_OF_RADIAL) * after[0]
    after_k = after[int(radial)]
    if not after_k < (1.0 - _GAIN_OF_OFFSETS) * before_k:
        why = (
            f"No correction: two images differ by {before_k:.3g} K at shared points, and by {after_k:.3g} K with the "
            "best correction, at points it was not fitted to."
        )
        return DriftEstimate(np.zeros(frames), (), before_k, before_k, False, why)
    unknowns = frames + _RADIAL_TERMS * radial
    best = _fit(design[:, :unknowns], difference_k, share, unknowns)
    offsets_k, coefficients = best[:frames] - best[:frames].mean(), best[frames:] if radial else ()
    explanation = (
        f"Two images differ by {before_k:.3g} K at shared scene points (median), after the correction by {after_k:.3g} "
        f"K at points it was not fitted to; offsets from {offsets_k.min():+.2f} to {offsets_k.max():+.2f} K"
        + (f", image corners read {sum(coefficients):+.2f} K" if radial else ", no radial term")
        + "."
    )
    return DriftEstimate(offsets_k, tuple(map(float, coefficients)), before_k, after_k, True, explanation)


def _differences(samples: DriftSamples) -> tuple[IntArray, csr_matrix, FloatArray]:
    """Return the differences of pairs of readings of one point: point numbers (n,), matrix, and differences (n,) [K].
    The matrix (n, frames + radial terms), times the offsets and radial coefficients, is what drift adds to them."""
    pairs = []
    for lag in range(1, _MOST_LAG + 1):
        first = np.flatnonzero(samples.point[lag:] == samples.point[:-lag])
        pairs.append(np.stack([first, first + lag]))
    first, second = np.concatenate(pairs, axis=1)
    frames, count = samples.num_frames, len(first)
    powers = samples.radius2[:, None] ** np.arange(1, _RADIAL_TERMS + 1)
    radial = np.broadcast_to(np.arange(frames, frames + _RADIAL_TERMS), (count, _RADIAL_TERMS))
    columns = np.column_stack([samples.frame[second], samples.frame[first], radial])
    values = np.column_stack([np.ones(count), -np.ones(count), powers[second] - powers[first]])
    starts = np.arange(0, columns.size + 1, columns.shape[1])
    design = csr_matrix((values.ravel(), columns.ravel(), starts), (count, frames + _RADIAL_TERMS))
    return samples.point[first], design, samples.temperature_c[second] - samples.temperature_c[first]


def _fit(design: csr_matrix, difference_k: FloatArray, share: FloatArray, unknowns: int) -> FloatArray:
    """Return the solution x (unknowns,) of design @ x = difference_k by Huber's least squares with weights `share`."""
    solution, weight, used = np.zeros(unknowns), share, share > 0.0
    for _ in range(_ITERATIONS):
        weighted = design.multiply(weight[:, None]).tocsr()
        before = solution
        # lstsq gives the solution of least norm: in each group of frames that share points, the mean offset is 0.
        solution = np.linalg.lstsq((weighted.T @ design).toarray(), weighted.T @ difference_k, rcond=_RIDGE)[0]
        if float(np.abs(solution - before).max()) < _CONVERGED_K:
            break
        residual = np.abs(difference_k - design @ solution)
        sigma = max(_MAD_TO_SIGMA * float(np.median(residual[used])), 1e-9)
        weight = share * np.minimum(1.0, _HUBER * sigma / np.maximum(residual, 1e-12))
    return solution


@dataclass(frozen=True, eq=False)
class DriftSamples:
    """Readings of scene points, sorted by point, then by frame; every point has at least two readings."""

    point: IntArray  # number of the point, 0 to points - 1, shape (n,)
    frame: IntArray  # number of the frame, shape (n,)
    temperature_c: FloatArray  # reading [degrees C], shape (n,)
    radius2: FloatArray  # squared distance from the image's centre, 1 in the corner, shape (n,)
    num_frames: int


def sample_shared_points(frames: Sequence[RigFrame], camera: Camera, visible_to_thermal: FloatArray) -> DriftSamples:
    """Return the readings of each scene point in the thermal images of all frames whose photographs show the point.

    `visible_to_thermal` (4, 4) is the rig's transform. Points on steep temperature edges are left out, because a small
    error of their place is a large error of temperature.
    """
    columns = []
    for number, frame in enumerate(frames):
        pixels = camera.project(frame.points @ visible_to_thermal[:3, :3].T + visible_to_thermal[:3, 3])
        inside = camera.contains(pixels, _BORDER_PX)
        ids, pixels = frame.point_ids[inside], pixels[inside]
        reading, steepness = _read(read_temperatures(frame), pixels)
        known = np.isfinite(reading) & np.isfinite(steepness)
        smooth = known & (steepness <= np.quantile(steepness[known], _SMOOTH_SHARE) if known.any() else known)
        radius2 = radius_squared(pixels[smooth], camera.width, camera.height)
        columns.append((ids[smooth], np.full(len(radius2), number), reading[smooth], radius2))
    point, frame_number, reading, radius2 = (np.concatenate(parts) for parts in zip(*columns))
    _, number, count = np.unique(point, return_inverse=True, return_counts=True)
    order = np.lexsort((frame_number, point))
    order = order[count[number[order]] >= 2]
    number = np.unique(point[order], return_inverse=True)[1].ravel()
    return DriftSamples(number, frame_number[order], reading[order], radius2[order], len(frames))


def _read(image: Float32Array, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return slightly smoothed temperatures (n,) at pixels (n, 2), and their gradients' magnitudes (n,) [K/pixel]."""
    smooth = cv2.GaussianBlur(image, (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE)  # NaN spreads; left out later
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    place = pixels[:, ::-1].T - 0.5
    value, steepness = (
        ndimage.map_coordinates(plane, place, order=1, mode="nearest") for plane in (smooth, np.hypot(gx, gy))
    )
    return value.astype(np.float64), steepness.astype(np.float64)
