"""Temperatures of the same scene points in many thermal images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.rig.image_pyramid import read_temperatures
from thermoxels_ns.capture.sfm.sparse_depth import SparseDepth
from thermoxels_ns.capture.stage_types import CameraModel, RigFrame, radius_squared

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_FEWEST_PER_FRAME, _SHARE_PER_FRAME = 1000, 0.5
"""Points of each frame that are read, those that most frames share first. These lie together and can all be wrong: of
36 frames with 15,000 points each, offsets from 1000 were wrong by up to 0.35 K, from the half by up to 0.08 K."""
_BLUR_PX = 1.0
_SMOOTH_SHARE = 0.4
_DEPTH_TOLERANCE = 0.03
_BORDER_PX = 2.0


@dataclass(frozen=True, eq=False)
class DriftSamples:
    """Readings of scene points, sorted by point, then by frame. Only points with at least two readings."""

    point: IntArray
    """Number of the point, 0 to points - 1, shape (n,)."""
    frame: IntArray
    """Number of the frame, shape (n,)."""
    temperature_c: FloatArray
    """Reading [degrees C], shape (n,)."""
    radius2: FloatArray
    """Squared distance from the image's centre, 1 in the corner, shape (n,)."""
    num_frames: int

    @property
    def num_points(self) -> int:
        """Number of different points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    def of_points(self, keep: npt.NDArray[np.bool_]) -> DriftSamples:
        """Only the readings of some points (by number), which are numbered anew."""
        stays = keep[self.point]
        number = np.cumsum(keep) - 1
        return DriftSamples(
            number[self.point[stays]],
            self.frame[stays],
            self.temperature_c[stays],
            self.radius2[stays],
            self.num_frames,
        )


def sample_shared_points(
    frames: Sequence[RigFrame], camera: CameraModel, visible_to_thermal: FloatArray
) -> DriftSamples:
    """Read the temperature of scene points in all thermal images that see them.

    A frame sees a point if structure from motion found it there, or if the point lies in its image at the depth
    that the frame's own points have around it. Points on steep temperature edges are left out, because there a
    pixel's error in place is a large error in degrees.

    Args:
        frames: Pairs with poses and scene points.
        camera: Thermal intrinsics.
        visible_to_thermal: x_thermal = visible_to_thermal @ x_visible (4, 4), OpenCV axes.

    Returns:
        All readings.
    """
    world, tracked = _chosen_points(frames)
    columns: list[tuple[IntArray, IntArray, FloatArray, FloatArray]] = []
    for number, frame in enumerate(frames):
        pose = np.asarray(frame.camera_to_world, dtype=np.float64)
        visible = ((world - pose[:3, 3]) @ pose[:3, :3]) * (1.0, -1.0, -1.0)
        pixels = camera.project(visible @ visible_to_thermal[:3, :3].T + visible_to_thermal[:3, 3])
        near = np.flatnonzero(camera.contains(pixels, _BORDER_PX) & (visible[:, 2] > 0.0))
        near = near[tracked[number][near] | _unhidden(visible[near], SparseDepth(frame.points_visible()))]
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
    ids, first, inverse = np.unique(
        np.concatenate([frame.point_ids for frame in frames]), return_index=True, return_inverse=True
    )
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


def _unhidden(points: FloatArray, depth: SparseDepth) -> npt.NDArray[np.bool_]:
    """Which points (n, 3) lie at the depth of the frame's own points around them."""
    if not len(points):
        return np.zeros(0, dtype=bool)
    around, distance = depth.at(points / points[:, 2:])
    return (np.abs(points[:, 2] - around) < _DEPTH_TOLERANCE * around) & (distance < _DEPTH_TOLERANCE)


def _read(image: npt.NDArray[np.float32], pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Temperatures (n,) at pixel positions (n, 2), slightly smoothed, and how steep the image is there [K/pixel]."""
    smooth = cv2.GaussianBlur(image, (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE)  # NaN spreads, and is left out
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
    planes = np.dstack([smooth, np.hypot(gx, gy)])
    if not len(pixels):
        return np.zeros(0), np.zeros(0)
    x, y = (pixels - 0.5).T
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = (x - left)[:, None], (y - top)[:, None]
    rows, columns = np.clip([top, top + 1], 0, image.shape[0] - 1), np.clip([left, left + 1], 0, image.shape[1] - 1)
    above = (1.0 - u) * planes[rows[0], columns[0]] + u * planes[rows[0], columns[1]]
    below = (1.0 - u) * planes[rows[1], columns[0]] + u * planes[rows[1], columns[1]]
    value = (1.0 - v) * above + v * below
    return value[:, 0].astype(np.float64), value[:, 1].astype(np.float64)
