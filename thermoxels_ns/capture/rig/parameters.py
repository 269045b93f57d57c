"""The ten parameters of a rig and the projection that follows from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from thermoxels_ns.capture.rig_types import FloatArray, RigStart
from thermoxels_ns.core.camera import Camera

PARAMETERS = ("rx", "ry", "rz", "tx", "ty", "tz", "log_focal", "cx", "cy", "k1")
"""Radians, world units, natural logarithm, thermal pixels at full size, and OpenCV's k1."""

_TRANSLATION_SHARE = 0.03


def prior_sigmas(start: RigStart, median_depth: float) -> FloatArray:
    """Standard deviations of the ten changes before the images are looked at, shape (10,)."""
    shift = _TRANSLATION_SHARE * median_depth if start.translation_sigma is None else start.translation_sigma
    turn, centre = np.radians(start.rotation_sigma_deg), start.centre_sigma * start.thermal_camera.width
    return np.array([turn] * 3 + [shift] * 3 + [start.focal_sigma, centre, centre, start.k1_sigma])


def standard_errors(covariance: FloatArray) -> dict[str, float]:
    """Standard errors of the parameters by name, from the covariance (10, 10) of their changes."""
    return dict(zip(PARAMETERS, np.sqrt(np.diag(covariance)).tolist()))


@dataclass(frozen=True, eq=False)
class RigModel:
    """The start value that the changes are counted from, at some size of the thermal image.

    A rig is a start value and ten small changes p = (rx, ry, rz, tx, ty, tz, log focal, cx, cy, k1):
    x_thermal = R R_start x_visible + t_start + t with R the rotation by the vector (rx, ry, rz), then the pinhole
    camera with distortion.
    """

    camera: Camera  # thermal camera of the start, resized to the level's pixels
    transform: FloatArray  # visible to thermal, shape (4, 4), OpenCV axes
    pixel_share: float = 1.0
    """Pixels of the level per pixel of the full thermal image; the changes of cx and cy are in the latter."""

    def at_size(self, width: int, height: int) -> RigModel:
        """Same rig for a thermal image of another size."""
        share = width / self.camera.width * self.pixel_share
        return RigModel(self.camera.resized(width, height), self.transform, share)

    def changed(self, change: FloatArray) -> tuple[Camera, FloatArray]:
        """Thermal camera and transform with the ten changes applied."""
        transform = self.transform.copy()
        transform[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ self.transform[:3, :3]
        transform[:3, 3] += change[3:6]
        growth = float(np.exp(change[6]))
        camera = replace(
            self.camera,
            fl_x=self.camera.fl_x * growth,
            fl_y=self.camera.fl_y * growth,
            cx=self.camera.cx + float(change[7]) * self.pixel_share,
            cy=self.camera.cy + float(change[8]) * self.pixel_share,
            k1=self.camera.k1 + float(change[9]),
        )
        return camera, transform

    def project(self, change: FloatArray, points: FloatArray) -> FloatArray:
        """Where points (n, 3) of the visible camera fall in the thermal image (n, 2); NaN behind it."""
        camera, transform = self.changed(change)
        return camera.project(points @ transform[:3, :3].T + transform[:3, 3])

    def slopes(self, change: FloatArray, points: FloatArray) -> FloatArray:
        """Derivatives of `project` with respect to the ten changes, shape (n, 2, 10); 0 behind the camera."""
        camera, transform = self.changed(change)
        turned, shift = points @ self.transform[:3, :3].T, transform[:3, 3]
        matrix = np.array([[camera.fl_x, 0.0, camera.cx], [0.0, camera.fl_y, camera.cy], [0.0, 0.0, 1.0]])
        distortion = np.array([camera.k1, camera.k2, camera.p1, camera.p2])
        # Columns: rotation vector, shift, both focal lengths, principal point, distortion.
        table = cv2.projectPoints(turned, change[:3], shift, matrix, distortion)[1].reshape(len(points), 2, -1)
        by_focal = camera.fl_x * table[..., 6:7] + camera.fl_y * table[..., 7:8]
        centre, k1 = self.pixel_share * table[..., 8:10], table[..., 10:11]
        ahead = points @ transform[2, :3] + shift[2] > 0.0
        return np.concatenate([table[..., :6], by_focal, centre, k1], axis=2) * ahead[:, None, None]
