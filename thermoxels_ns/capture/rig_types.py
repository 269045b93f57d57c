"""Types that poses, rig, drift and the scene writer share, and the ten parameters of a rig."""

# Poses are camera to world with x right, y up, z back (OpenGL), as in transforms.json. Transforms between two cameras
# and points in front of a camera have x right, y down, z ahead (OpenCV). Pixel centres lie at +0.5. Lengths are in
# world units, the unit of the model from structure from motion; its length in metres may be unknown.

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import Float32Array, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera

OPENGL_FROM_OPENCV: FloatArray = np.diag([1.0, -1.0, -1.0, 1.0])
"""Matrix from OpenCV to OpenGL camera axes and back: a pose in OpenGL axes times this matrix is in OpenCV axes."""

PARAMETERS = ("rx", "ry", "rz", "tx", "ty", "tz", "log_focal", "cx", "cy", "k1")
"""The ten changes of a rig against its start: rotation vector r [radians], shift t [world units], natural logarithm of
the focal length's ratio, shift of the principal point [thermal pixels at full size], and change of OpenCV's k1."""
_TURN_SIGMA_DEG, _K1_SIGMA = 3.0, 0.05  # a guess's standard deviations of the turn about each axis and of k1
_CENTRE_SIGMA = 0.005
"""Standard deviation of a guessed principal point, as a share of the image width. With a narrow lens, its shift looks
almost like a turn. A larger value therefore also makes the rotation more uncertain."""
_SMALLEST_DEPTH_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class RigFrame:
    """One photograph, its thermal image, and the scene points that the photograph shows."""

    photograph: npt.NDArray | Path
    """Grey or RGB array of any number type, or the photograph's file; of the visible camera's size or proportions."""
    temperature_c: npt.NDArray | Path
    """Temperatures [degrees C], shape (height, width), NaN in unknown pixels; or the path of a .npy file of them."""
    points: FloatArray
    """Scene points that structure from motion saw in this photograph, in the visible camera's OpenCV axes, (n, 3)."""
    point_ids: IntArray  # number of each scene point, equal in all frames that see the point, shape (n,)


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """A rig that was found or given, or a guess from which the search starts."""

    thermal_camera: Camera
    visible_to_thermal: FloatArray
    """x_thermal = visible_to_thermal @ x_visible, shape (4, 4), OpenCV axes, lengths in world units."""
    determined: bool  # True if the rig was found or given. False: camera and transform are a guess
    explanation: str  # text for the report: what was found, the source of a guess, why the rig is not determined
    covariance: FloatArray = field(default_factory=lambda: np.full((10, 10), np.nan))
    """Covariance of the changes `PARAMETERS`, (10, 10), NaN if unknown; for a guess, how wrong it may be."""
    projection_sigma_px: float = math.nan
    """Typical standard error of a scene point's place in the thermal image, both axes together [thermal pixels]."""

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of each parameter, by its name; units as in `PARAMETERS`."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist()))

    @property
    def turn_deg(self) -> float:
        """Angle of the rotation from the visible to the thermal camera [degrees]."""
        return float(np.degrees(np.linalg.norm(cv2.Rodrigues(self.visible_to_thermal[:3, :3])[0])))

    @property
    def turn_error_deg(self) -> float:
        """Standard error of the rotation about all axes together [degrees]; NaN if the covariance is unknown."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))


def guessed_rig(
    camera: Camera,
    source: str,
    visible_to_thermal: FloatArray | None = None,
    focal_sigma: float = 0.08,
    shift_sigma: float = math.nan,
) -> RigEstimate:
    """Return a guessed rig with the usual standard deviations.

    `source` is a text with the guess's source. `visible_to_thermal` (4, 4) None: both cameras have the same pose.
    `focal_sigma` is the focal length's standard deviation as a share of it; `shift_sigma` is the standard deviation of
    the lens's position along each axis [world units], NaN if unknown.
    """
    centre, turn = _CENTRE_SIGMA * camera.width, np.radians(_TURN_SIGMA_DEG)
    sigmas = np.array([turn] * 3 + [shift_sigma] * 3 + [focal_sigma, centre, centre, _K1_SIGMA], dtype=np.float64)
    transform = np.eye(4) if visible_to_thermal is None else visible_to_thermal
    return RigEstimate(camera, transform, False, source, np.diag(sigmas**2))


@dataclass(frozen=True, eq=False)
class RigModel:
    """A rig from which a search starts, at one size of the thermal image. Methods apply the ten changes `PARAMETERS`:
    x_thermal = R(rx, ry, rz) R_start x_visible + t_start + t, then the pinhole camera with radial distortion."""

    camera: Camera  # thermal camera of the start, resized to this size of the thermal image
    transform: FloatArray  # visible to thermal camera, shape (4, 4), OpenCV axes
    pixel_share: float = 1.0
    """Pixels at this size per pixel of the full thermal image. The changes cx and cy are pixels of the full image."""

    def changed(self, change: FloatArray) -> tuple[Camera, FloatArray]:
        """Return the thermal camera and `transform` after the ten changes `PARAMETERS`, given as `change` (10,)."""
        transform = self.transform.copy()
        transform[:3, :3] = cv2.Rodrigues(change[:3])[0] @ self.transform[:3, :3]
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
        """Return thermal pixels (n, 2) of points (n, 3) in the visible camera's OpenCV axes; NaN behind the camera."""
        camera, transform = self.changed(change)
        return camera.project(points @ transform[:3, :3].T + transform[:3, 3])

    def pull_back(self, change: FloatArray, points: FloatArray, slope: FloatArray) -> FloatArray:
        """Return the derivative (10,) of a function of projected points by the ten changes, by the chain rule.

        `slope` (n, 2) is the function's derivative by the pixels to which `project` brings `points` (n, 3) at `change`
        (10,). Points that are not clearly in front of the thermal camera are left out.
        """
        camera, transform = self.changed(change)
        ahead = points @ transform[2, :3] + transform[2, 3] > _SMALLEST_DEPTH_SHARE * np.median(points[:, 2])
        if not ahead.any():
            return np.zeros(len(PARAMETERS))
        turned = points[ahead] @ self.transform[:3, :3].T
        matrix = np.array([[camera.fl_x, 0.0, camera.cx], [0.0, camera.fl_y, camera.cy], [0.0, 0.0, 1.0]])
        lens = np.array([camera.k1, camera.k2, camera.p1, camera.p2])
        _, by_number = cv2.projectPoints(turned, change[:3], transform[:3, 3], matrix, lens)
        by = slope[ahead].ravel() @ by_number  # turn, shift, fl_x, fl_y, cx, cy, k1, ...
        by_focal = camera.fl_x * by[6] + camera.fl_y * by[7]
        return np.array([*by[:6], by_focal, *(self.pixel_share * by[8:10]), by[10]])


@dataclass(frozen=True, eq=False)
class DriftEstimate:
    """Errors of the readings of thermal images: an offset for each image, and a radial term for all (vignetting)."""

    offsets_k: FloatArray
    """Error of each frame's temperatures, to subtract, in the frames' order, mean 0, shape (frames,) [K]."""
    radial: tuple[float, ...]
    """Coefficients c of the error sum(c[i] * r ** (2 * i + 2)) [K] of all frames, r = 1 in the image's corner."""
    before_k: float  # median absolute difference of two readings of a held-out scene point, uncorrected [K]
    after_k: float  # the same median after a correction fitted to the other points [K]
    used: bool  # True if the correction lowers this median. False: all offsets are 0 and `radial` is empty
    explanation: str  # text for the report

    def radial_k(self, width: int, height: int) -> FloatArray:
        """Return the radial term at every pixel's centre, shape (height, width) [K]; 0 at the image's centre."""
        r2 = radius_squared(np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1), width, height)
        return np.sum([c * r2 ** (power + 1) for power, c in enumerate(self.radial)], axis=0) + np.zeros_like(r2)

    def corrected(self, frame: int, temperature_c: npt.NDArray) -> Float32Array:
        """Return temperatures [degrees C] of frame number `frame` without drift and vignetting, shape unchanged."""
        height, width = temperature_c.shape
        return (temperature_c - self.offsets_k[frame] - self.radial_k(width, height)).astype(np.float32)


def radius_squared(pixels: npt.ArrayLike, width: int, height: int) -> FloatArray:
    """Return the squared distance of pixels (..., 2) from the image's centre, shape (...); 1 in the corner.

    >>> radius_squared([[0.0, 0.0], [4.0, 3.0]], 8, 6).tolist()
    [1.0, 0.0]
    """
    offset = np.asarray(pixels, dtype=np.float64) - (0.5 * width, 0.5 * height)
    return np.sum(offset * offset, axis=-1) / (0.25 * (width * width + height * height))
