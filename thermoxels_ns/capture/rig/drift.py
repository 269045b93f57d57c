"""Drift and vignetting of a thermal camera, from scene points that many images show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.sparse import csr_matrix

from thermoxels_ns.capture.rig.images import read_temperatures
from thermoxels_ns.capture.rig_types import DriftEstimate, FloatArray, RigFrame, radius_squared
from thermoxels_ns.capture.sfm.sfm_model import SparseDepth
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
IntArray = npt.NDArray[np.int64]

_FEWEST_PER_FRAME, _SHARE_PER_FRAME = 1000, 0.5
"""Points of each frame that are read, those that most frames share first. These lie together and can all be wrong: of
36 frames with 15,000 points each, offsets from 1000 were wrong by up to 0.35 K, from the half by up to 0.08 K."""
_BLUR_PX = 1.0
_SMOOTH_SHARE = 0.4
_DEPTH_TOLERANCE = 0.03
_BORDER_PX = 2.0


def estimate_drift(
    frames: Sequence[RigFrame], thermal_camera: Camera, visible_to_thermal: npt.ArrayLike
) -> DriftEstimate:
    """Find one offset per thermal image and a radial term, if the images call for them.

    An uncooled camera reads some kelvin too high or too low from image to image, and warmer or colder towards the
    corners. A scene point has one temperature, so what its readings differ by shows both.

    Reading of point i in frame f = temperature_i + offset_f + c1 r^2 + c2 r^4 + error. Robust least squares (Huber's
    loss, reweighted), the points' temperatures eliminated, mean offset 0. The correction is fitted to four fifths of
    the points and kept only if it lowers the disagreement at the others.

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
    before_k = _disagreement_k(test_on, np.zeros(len(test_on.point)))
    plain, full = _fit(fit_to, 0), _fit(fit_to, _RADIAL_TERMS)
    plain_k, full_k = (_disagreement_k(test_on, fit.at(test_on)) for fit in (plain, full))
    radial = full_k < (1.0 - _GAIN_OF_RADIAL) * plain_k
    after_k = full_k if radial else plain_k
    if not after_k < (1.0 - _GAIN_OF_OFFSETS) * before_k:
        after = f"{after_k:.3g} K with the best correction, at points it was not fitted to"
        return _nothing(frames, before_k, f"two images differ by {before_k:.3g} K at shared points, and by {after}")
    best = _fit(samples, _RADIAL_TERMS if radial else 0)
    corner_k = sum(best.radial)
    explanation = (
        f"Two images differ by {before_k:.3g} K at shared scene points (median), after the correction by {after_k:.3g} "
        f"K at points it was not fitted to; offsets from {best.offsets_k.min():+.2f} to {best.offsets_k.max():+.2f} K"
        + (f", image corners read {corner_k:+.2f} K" if radial else ", no radial term")
        + "."
    )
    return DriftEstimate(best.offsets_k, tuple(map(float, best.radial)), before_k, after_k, True, explanation)


@dataclass(frozen=True, eq=False)
class _Fit:
    offsets_k: FloatArray
    radial: FloatArray

    def at(self, samples: DriftSamples) -> FloatArray:
        """What readings are too high by, shape (n,) [K]."""
        powers = samples.radius2[:, None] ** np.arange(1, len(self.radial) + 1)
        return self.offsets_k[samples.frame] + powers @ self.radial


def _fit(samples: DriftSamples, radial_terms: int) -> _Fit:
    """Iteratively reweighted least squares with the points' temperatures eliminated (Schur complement)."""
    count, frames = len(samples.point), samples.num_frames
    row = np.arange(count)
    design = np.zeros((count, radial_terms))
    for power in range(radial_terms):
        design[:, power] = samples.radius2 ** (power + 1)
    incidence = csr_matrix((np.ones(count), (row, samples.point)), shape=(count, samples.num_points))
    in_frame = csr_matrix((np.ones(count), (row, samples.frame)), shape=(count, frames))
    weight = np.ones(count)
    solution = np.zeros(frames + radial_terms)
    for _ in range(_ITERATIONS):
        mass = np.maximum(incidence.T @ weight, 1e-12)

        def centred(values: FloatArray, mass: FloatArray = mass, weight: FloatArray = weight) -> FloatArray:
            return values - incidence @ ((incidence.T @ (weight[:, None] * values)) / mass[:, None])

        shared = incidence.T @ in_frame.multiply(weight[:, None]).tocsr()  # weight of frame f in point i
        normal = np.zeros((frames + radial_terms,) * 2)
        explained = (shared.T @ shared.multiply(1 / mass[:, None])).toarray()
        normal[:frames, :frames] = np.diag(in_frame.T @ weight) - explained
        flat = centred(np.column_stack([design, samples.temperature_c]))
        side = in_frame.T @ (weight[:, None] * flat)
        normal[:frames, frames:], normal[frames:, :frames] = side[:, :-1], side[:, :-1].T
        within = flat.T @ (weight[:, None] * flat)
        normal[frames:, frames:] = within[:-1, :-1]
        right = np.concatenate([side[:, -1], within[:-1, -1]])
        # Minimum norm: every group of frames that shares points gets mean offset 0.
        updated = np.linalg.lstsq(normal, right, rcond=_RIDGE)[0]
        moved = float(np.abs(updated - solution).max())
        solution = updated
        wrong = solution[samples.frame] + design @ solution[frames:]
        residual = centred((samples.temperature_c - wrong)[:, None])[:, 0]
        sigma = max(_MAD_TO_SIGMA * float(np.median(np.abs(residual))), 1e-9)
        weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(residual), 1e-12))
        if moved < _CONVERGED_K:
            break
    offsets = solution[:frames]
    return _Fit(offsets - offsets.mean(), solution[frames:])


def _disagreement_k(samples: DriftSamples, wrong: FloatArray) -> float:
    """Median difference of two readings of one point, over pairs of frames that see it [K]."""
    reading = samples.temperature_c - wrong
    differences = [np.zeros(0)]
    for lag in range(1, _MOST_LAG + 1):
        same = samples.point[lag:] == samples.point[:-lag]
        differences.append(np.abs(reading[lag:] - reading[:-lag])[same])
    every = np.concatenate(differences)
    return float(np.median(every)) if len(every) else float("nan")


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
    """Read the temperature of scene points in all thermal images that see them.

    A frame sees a point if structure from motion found it there, or if the point lies in its image at the depth
    that the frame's own points have around it. Points on steep temperature edges are left out, because there a
    pixel's error in place is a large error in degrees.
    """
    world, tracked = _chosen_points(frames)
    columns: list[tuple[IntArray, IntArray, FloatArray, FloatArray]] = []
    for number, frame in enumerate(frames):
        pose = np.asarray(frame.camera_to_world, dtype=np.float64)
        visible = ((world - pose[:3, 3]) @ pose[:3, :3]) * (1.0, -1.0, -1.0)
        pixels = camera.project(visible @ visible_to_thermal[:3, :3].T + visible_to_thermal[:3, 3])
        near = np.flatnonzero(camera.contains(pixels, _BORDER_PX) & (visible[:, 2] > 0.0))
        ahead = visible[near]
        around, distance = SparseDepth(frame.points_visible()).at(ahead / ahead[:, 2:])
        unhidden = (np.abs(ahead[:, 2] - around) < _DEPTH_TOLERANCE * around) & (distance < _DEPTH_TOLERANCE)
        near = near[tracked[number][near] | unhidden]
        reading, steepness = _read(read_temperatures(frame, camera), pixels[near])
        known = np.isfinite(reading) & np.isfinite(steepness)
        near, reading, steepness = near[known], reading[known], steepness[known]
        if len(near):
            smooth = steepness <= np.quantile(steepness, _SMOOTH_SHARE)
            near, reading = near[smooth], reading[smooth]
        radius2 = radius_squared(pixels[near], camera.width, camera.height)
        columns.append((near, np.full(len(near), number), reading, radius2))
    point, frame_number, reading, radius2 = (np.concatenate(parts) for parts in zip(*columns))
    order = np.lexsort((frame_number, point))
    samples = DriftSamples(point[order], frame_number[order], reading[order], radius2[order], len(frames))
    return samples.of_points(np.bincount(samples.point, minlength=len(world)) >= 2)


def _chosen_points(frames: Sequence[RigFrame]) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """World positions (n, 3) of the points that most frames share, some from every frame, and who tracks them."""
    every = np.concatenate([frame.point_ids for frame in frames])
    ids, first, inverse = np.unique(every, return_index=True, return_inverse=True)
    world = np.concatenate([np.asarray(frame.points_world, dtype=np.float64).reshape(-1, 3) for frame in frames])[first]
    views = np.bincount(inverse.ravel(), minlength=len(ids))
    seen = np.split(inverse.ravel(), np.cumsum([len(frame.point_ids) for frame in frames])[:-1])
    chosen = np.zeros(len(ids), dtype=bool)
    for members in seen:
        shared = members[views[members] >= 2]
        most = max(_FEWEST_PER_FRAME, round(_SHARE_PER_FRAME * len(members)))
        chosen[shared[np.argsort(-views[shared], kind="stable")[:most]]] = True
    tracked = np.zeros((len(frames), len(ids)), dtype=bool)
    for number, members in enumerate(seen):
        tracked[number, members] = True
    return world[chosen], tracked[:, chosen]


def _read(image: npt.NDArray[np.float32], pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Temperatures (n,) at pixel positions (n, 2), slightly smoothed, and how steep the image is there [K/pixel]."""
    smooth = cv2.GaussianBlur(image, (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE)  # NaN spreads, and is left out
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    place = pixels[:, ::-1].T - 0.5
    value, steepness = (
        ndimage.map_coordinates(plane, place, order=1, mode="nearest") for plane in (smooth, np.hypot(gx, gy))
    )
    return value.astype(np.float64), steepness.astype(np.float64)
