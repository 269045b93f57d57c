"""The ten parameters of a rig and the projection that follows from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from thermoxels_ns.capture.rig_types import FloatArray, RigStart
from thermoxels_ns.core.camera import Camera

PARAMETERS = ("rx", "ry", "rz", "tx", "ty", "tz", "log_focal", "cx", "cy", "k1")
"""Radians, world units, natural logarithm, thermal pixels at full size, and OpenCV's k1."""

_TRANSLATION_SHARE = 0.03
_SMALLEST_DEPTH_SHARE = 1e-3
_GENERATORS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]],
    dtype=np.float64,
)


def prior_sigmas(start: RigStart, median_depth: float) -> FloatArray:
    """Standard deviations of the ten changes before the images are looked at, shape (10,)."""
    shift = _TRANSLATION_SHARE * median_depth if start.translation_sigma is None else start.translation_sigma
    turn, centre = np.radians(start.rotation_sigma_deg), start.centre_sigma * start.thermal_camera.width
    return np.array([turn] * 3 + [shift] * 3 + [start.focal_sigma, centre, centre, start.k1_sigma])


@dataclass(frozen=True, eq=False)
class RigModel:
    """The start value that the changes are counted from, at some size of the thermal image.

    A rig is a start value and ten small changes p = (rx, ry, rz, tx, ty, tz, log focal, cx, cy, k1):
    x_thermal = Rz Ry Rx R_start x_visible + t_start + t, then the pinhole camera with radial distortion.
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
        rotation, _ = _rotation(*change[:3].tolist())
        transform = self.transform.copy()
        transform[:3, :3] = rotation @ self.transform[:3, :3]
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

    def pull_back(self, change: FloatArray, points: FloatArray, slope: FloatArray) -> FloatArray:
        """Derivative of a sum over points with respect to the ten changes, shape (10,), by the chain rule.

        `slope` (n, 2) is the derivative of the sum with respect to the pixels of `points` (n, 3) of the visible camera;
        0 where a point does not count. Tangential distortion is taken as constant: it is far below a pixel's worth.
        """
        camera, transform = self.changed(change)
        _, turned = _rotation(*change[:3].tolist())
        local = points @ transform[:3, :3].T + transform[:3, 3]
        depth = local[:, 2]
        safe = np.where(depth > _SMALLEST_DEPTH_SHARE * np.median(points[:, 2]), depth, np.inf)
        x, y = local[:, 0] / safe, local[:, 1] / safe
        r2 = x * x + y * y
        radial = 1.0 + r2 * (camera.k1 + r2 * camera.k2)
        growth = 2.0 * (camera.k1 + 2.0 * r2 * camera.k2)
        along = camera.fl_x * slope[:, 0], camera.fl_y * slope[:, 1]
        outward = along[0] * x + along[1] * y
        to_x = (along[0] * radial + growth * x * outward) / safe
        to_y = (along[1] * radial + growth * y * outward) / safe
        to_local = np.column_stack([to_x, to_y, -(x * to_x + y * to_y)])
        to_rotation = to_local.T @ (points @ self.transform[:3, :3].T)
        result = np.empty(len(PARAMETERS))
        result[:3] = np.einsum("kij,ij->k", turned, to_rotation)
        result[3:6] = to_local.sum(axis=0)
        result[6] = float(np.sum(radial * outward))
        result[7:9] = self.pixel_share * slope.sum(axis=0)
        result[9] = float(np.sum(r2 * outward))
        return result


@lru_cache(maxsize=4)  # all frames ask for the same one
def _rotation(rx: float, ry: float, rz: float) -> tuple[FloatArray, FloatArray]:
    """Rotation Rz Ry Rx (3, 3) and its derivatives by the three angles (3, 3, 3)."""
    single, slope = [], []
    for angle, generator in zip((rx, ry, rz), _GENERATORS):
        cosine, sine = np.cos(angle), np.sin(angle)
        square = generator @ generator
        single.append(np.eye(3) + sine * generator + (1.0 - cosine) * square)
        slope.append(cosine * generator + sine * square)
    x, y, z = single
    return z @ y @ x, np.array([z @ y @ slope[0], z @ slope[1] @ x, slope[2] @ y @ x])
