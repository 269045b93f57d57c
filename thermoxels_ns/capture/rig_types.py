"""Types shared by poses, rig, drift and the scene writer, and the ten numbers of a rig."""

# Poses are camera to world with x right, y up, z back (OpenGL), as in transforms.json. Transforms between two cameras
# and points in front of a camera have x right, y down, z ahead (OpenCV). Pixel centres lie at +0.5. Lengths are those
# of the world that structure from motion found; its scale may be unknown.

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
"""Turns camera axes; it is its own inverse. ``pose @ OPENGL_FROM_OPENCV`` is camera to world in OpenCV's axes."""

PARAMETERS = ("rx", "ry", "rz", "tx", "ty", "tz", "log_focal", "cx", "cy", "k1")
"""Rotation vector [radians], world units, natural logarithm, thermal pixels at full size, and OpenCV's k1."""
_TRANSLATION_SHARE = 0.03
_SMALLEST_DEPTH_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class RigFrame:
    """One photograph with its thermal partner, its pose and the scene points that it sees."""

    name: str
    photograph: npt.NDArray | Path
    """Photograph as grey or RGB array of any number type, or its file. Its size is that of the visible camera, or
    smaller by one factor."""
    temperature_c: npt.NDArray | Path
    """Temperatures [degrees C], shape (height, width), NaN where there is none; or a .npy file of them."""
    camera_to_world: FloatArray  # pose of the visible camera, shape (4, 4), OpenGL axes
    points_world: FloatArray  # scene points that structure from motion saw in this photograph, shape (n, 3)
    point_ids: IntArray  # which point each of them is, the same number in all frames, shape (n,)

    def points_visible(self) -> FloatArray:
        """Return the points in the visible camera's OpenCV axes, shape (n, 3)."""
        pose = np.asarray(self.camera_to_world, dtype=np.float64)
        local = (np.asarray(self.points_world, dtype=np.float64) - pose[:3, 3]) @ pose[:3, :3]
        return local * (1.0, -1.0, -1.0)


@dataclass(frozen=True, eq=False)
class RigStart:
    """What is known of the rig before the images are compared, and how well: a guess with standard deviations."""

    thermal_camera: Camera  # start value of the thermal intrinsics, at the thermal images' size
    visible_to_thermal: FloatArray = field(default_factory=lambda: np.eye(4))
    """x_thermal = visible_to_thermal @ x_visible, shape (4, 4), OpenCV axes, lengths in world units."""
    focal_sigma: float = 0.08  # standard deviation of the focal length, as a share of it
    rotation_sigma_deg: float = 3.0  # standard deviation of the rotation about each axis [degrees]
    translation_sigma: float | None = None
    """Standard deviation of the shift along each axis [world units]. None: 3 % of the median depth of the points."""
    centre_sigma: float = 0.005
    """Standard deviation of the principal point, as a share of the image width. A turn moves the image of a narrow lens
    almost as the principal point does, so what is allowed here is what the rotation remains unsure by."""
    k1_sigma: float = 0.05  # standard deviation of the radial distortion; 0 keeps it as given
    source: str = "a guess: same place and direction as the visible camera"
    """Where the start comes from, for the report."""


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """The rig that was found, or the start value where the images do not determine the rig."""

    thermal_camera: Camera
    visible_to_thermal: FloatArray
    """x_thermal = visible_to_thermal @ x_visible, shape (4, 4), OpenCV axes, lengths in world units."""
    determined: bool
    """Whether it is known where the thermal camera is. False: camera and transform are those of the start."""
    explanation: str  # one sentence for the report: what was found, or why nothing could be
    parameters: tuple[str, ...] = ()
    """Names of the parameters (`PARAMETERS`) that the covariance is of. Empty: nothing was estimated."""
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """Covariance of the parameters, shape (n, n)."""
    score_before: float = math.nan
    """Agreement of thermal and visible edges with the start value, -1 to 1; NaN: not compared."""
    score_after: float = math.nan  # the same with the values returned
    projection_sigma_px: float = math.nan
    """Standard error of where a scene point falls in the thermal image, median over the points [thermal pixels]."""

    @property
    def standard_errors(self) -> dict[str, float]:
        """Square roots of the covariance's diagonal by parameter."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist()))

    @property
    def turn_deg(self) -> float:
        """Angle between the directions of the two cameras, about any axis [degrees]."""
        return float(np.degrees(np.linalg.norm(cv2.Rodrigues(self.visible_to_thermal[:3, :3])[0])))

    @property
    def turn_error_deg(self) -> float:
        """Standard error of the turn about all axes together [degrees]; NaN where it is not known."""
        errors = self.standard_errors
        return float(np.degrees(np.linalg.norm([errors.get(name, math.nan) for name in ("rx", "ry", "rz")])))

    def thermal_pose(self, camera_to_world: npt.ArrayLike) -> FloatArray:
        """Pose of the thermal camera (4, 4) from that of the visible one, both OpenGL."""
        pose = np.asarray(camera_to_world, dtype=np.float64)
        return pose @ OPENGL_FROM_OPENCV @ np.linalg.inv(self.visible_to_thermal) @ OPENGL_FROM_OPENCV


def prior_sigmas(start: RigStart, median_depth: float) -> FloatArray:
    """Standard deviations of the ten changes before the images are looked at, shape (10,)."""
    shift = _TRANSLATION_SHARE * median_depth if start.translation_sigma is None else start.translation_sigma
    turn, centre = np.radians(start.rotation_sigma_deg), start.centre_sigma * start.thermal_camera.width
    return np.array([turn] * 3 + [shift] * 3 + [start.focal_sigma, centre, centre, start.k1_sigma])


@dataclass(frozen=True, eq=False)
class RigModel:
    """The start value that the changes are counted from, at some size of the thermal image.

    A rig is a start value and ten small changes (`PARAMETERS`): x_thermal = R(rx, ry, rz) R_start x_visible + t_start +
    t, then the pinhole camera with radial distortion.
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
        """Where points (n, 3) of the visible camera fall in the thermal image (n, 2); NaN behind it."""
        camera, transform = self.changed(change)
        return camera.project(points @ transform[:3, :3].T + transform[:3, 3])

    def pull_back(self, change: FloatArray, points: FloatArray, slope: FloatArray) -> FloatArray:
        """Derivative of a sum over points with respect to the ten changes, shape (10,), by the chain rule.

        `slope` (n, 2) is the derivative of the sum with respect to the pixels of `points` (n, 3) of the visible camera;
        points behind the thermal camera do not count.
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
    """How far each thermal image reads too high, and how the error grows towards the image's corners."""

    offsets_k: FloatArray
    """To be subtracted from each frame's temperatures, in the order of the frames, mean 0, shape (frames,) [K]."""
    radial: tuple[float, ...]
    """Coefficients c of sum(c[i] * r ** (2 * i + 2)) [K], r = 1 in the image's corner; subtracted from all frames."""
    before_k: float  # median difference between two frames at the scene points that both see, uncorrected [K]
    after_k: float  # the same after the correction, at points that it was not fitted to [K]
    used: bool
    """Whether the correction lowers the disagreement at held-out points; False: all offsets and coefficients are 0."""
    explanation: str

    def radial_k(self, width: int, height: int) -> FloatArray:
        """Radial term at every pixel's centre, shape (height, width) [K]; 0 at the image's centre."""
        r2 = radius_squared(np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1), width, height)
        return np.sum([c * r2 ** (power + 1) for power, c in enumerate(self.radial)], axis=0) + np.zeros_like(r2)

    def corrected(self, frame: int, temperature_c: npt.NDArray) -> Float32Array:
        """Temperatures of a frame (by its number) without drift and vignetting, shape (height, width) [degrees C]."""
        height, width = temperature_c.shape
        return (temperature_c - self.offsets_k[frame] - self.radial_k(width, height)).astype(np.float32)


def radius_squared(pixels: npt.ArrayLike, width: int, height: int) -> FloatArray:
    """Squared distance of pixels (..., 2) from the image's centre; 1 in the corner.

    >>> radius_squared([[0.0, 0.0], [4.0, 3.0]], 8, 6).tolist()
    [1.0, 0.0]
    """
    offset = np.asarray(pixels, dtype=np.float64) - (0.5 * width, 0.5 * height)
    return np.sum(offset * offset, axis=-1) / (0.25 * (width * width + height * height))
