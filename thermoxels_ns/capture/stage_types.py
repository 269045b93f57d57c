"""What crosses the walls between pairs, poses, rig, drift and the scene writer.

Poses are camera to world with x right, y up, z back (OpenGL), as in transforms.json. Transforms between two cameras
and points in front of a camera have x right, y down, z ahead (OpenCV). Pixel centres lie at +0.5. Lengths are those
of the world that structure from motion found; its scale may be unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import SceneError

FloatArray = npt.NDArray[np.float64]

OPENGL_FROM_OPENCV: FloatArray = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns camera axes; it is its own inverse. ``pose @ OPENGL_FROM_OPENCV`` is camera to world in OpenCV's axes."""

_UNDISTORT_STEPS = 20


@dataclass(frozen=True)
class CameraModel:
    """A pinhole camera with radial (and, where structure from motion found one, tangential) distortion."""

    width: int
    """Image width [pixels]."""
    height: int
    """Image height [pixels]."""
    fl_x: float
    """Focal length along x [pixels]."""
    fl_y: float
    """Focal length along y [pixels]."""
    cx: float
    """Principal point, x [pixels]."""
    cy: float
    """Principal point, y [pixels]."""
    k1: float = 0.0
    """Radial distortion, second order, as in OpenCV."""
    k2: float = 0.0
    """Radial distortion, fourth order."""
    p1: float = 0.0
    """Tangential distortion."""
    p2: float = 0.0
    """Tangential distortion."""

    def __post_init__(self) -> None:
        numbers = (self.fl_x, self.fl_y, self.cx, self.cy, self.k1, self.k2, self.p1, self.p2)
        good = all(map(math.isfinite, numbers)) and min(self.fl_x, self.fl_y) > 0 and min(self.width, self.height) > 0
        if not good:
            raise SceneError(
                "camera",
                expected="at least one pixel, focal lengths above 0 and finite numbers",
                got=f"{self.width} x {self.height} pixels, {numbers}",
                remedy="Correct the intrinsics.",
            )

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal_deg: float) -> CameraModel:
        """Camera with square pixels, its principal point at the centre and a given horizontal angle of view.

        >>> round(CameraModel.from_field_of_view(640, 480, 90.0).fl_x, 6)
        320.0
        """
        if not 0.0 < horizontal_deg < 179.0:
            raise SceneError(
                "field of view",
                expected="an angle above 0 and below 179 degrees",
                got=horizontal_deg,
                remedy="Pass the horizontal angle of view from the lens's data sheet.",
            )
        focal = 0.5 * width / math.tan(math.radians(0.5 * horizontal_deg))
        return cls(width, height, focal, focal, 0.5 * width, 0.5 * height)

    def resized(self, width: int, height: int) -> CameraModel:
        """Same camera, its image sampled with another number of pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fl_x=self.fl_x * x, fl_y=self.fl_y * y, cx=self.cx * x, cy=self.cy * y
        )

    def project(self, points: npt.ArrayLike) -> FloatArray:
        """Project points (n, 3) in OpenCV camera axes to pixels (n, 2); NaN for points not ahead of the camera."""
        local = np.asarray(points, dtype=np.float64)
        ahead = local[:, 2] > 0.0
        scale = np.divide(1.0, local[:, 2], out=np.full(len(local), np.nan), where=ahead)
        return self._to_pixels(local[:, :2] * scale[:, None])

    def rays(self, pixels: npt.ArrayLike) -> FloatArray:
        """Points (n, 3) at depth 1 in OpenCV camera axes that the pixels (n, 2) see (distortion removed)."""
        pixels = np.asarray(pixels, dtype=np.float64)
        distorted = (pixels - (self.cx, self.cy)) / (self.fl_x, self.fl_y)
        plane = distorted
        if any((self.k1, self.k2, self.p1, self.p2)):
            for _ in range(_UNDISTORT_STEPS):
                plane = plane + (distorted - self._distort(plane))
        return np.column_stack([plane, np.ones(len(plane))])

    def contains(self, pixels: npt.ArrayLike, border: float = 0.0) -> npt.NDArray[np.bool_]:
        """Which pixels (n, 2) lie in the image, at least `border` pixels from its edge."""
        x, y = np.asarray(pixels, dtype=np.float64).T
        return (x >= border) & (x <= self.width - border) & (y >= border) & (y <= self.height - border)

    def _to_pixels(self, plane: FloatArray) -> FloatArray:
        return self._distort(plane) * (self.fl_x, self.fl_y) + (self.cx, self.cy)

    def _distort(self, plane: FloatArray) -> FloatArray:
        if not any((self.k1, self.k2, self.p1, self.p2)):
            return plane
        x, y = plane[:, 0], plane[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * self.k2)
        dx = 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        dy = self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return np.column_stack([x * radial + dx, y * radial + dy])


@dataclass(frozen=True, eq=False)
class RigFrame:
    """One photograph with its thermal partner, its pose and the scene points that it sees."""

    name: str
    """Name of the pair, for messages."""
    photograph: npt.NDArray | Path
    """Photograph as grey or RGB array of any number type, or its file. Its size is that of the visible camera, or
    smaller by one factor."""
    temperature_c: npt.NDArray | Path
    """Temperatures [degrees C], shape (height, width), NaN where there is none; or a .npy file of them."""
    camera_to_world: FloatArray
    """Pose of the visible camera, shape (4, 4), OpenGL axes."""
    points_world: FloatArray
    """Scene points that structure from motion saw in this photograph, shape (n, 3)."""
    point_ids: npt.NDArray[np.int64]
    """Which point each of them is, the same number in all frames, shape (n,)."""

    def points_visible(self) -> FloatArray:
        """Return the points in the visible camera's OpenCV axes, shape (n, 3)."""
        pose = np.asarray(self.camera_to_world, dtype=np.float64)
        local = (np.asarray(self.points_world, dtype=np.float64) - pose[:3, 3]) @ pose[:3, :3]
        return local * (1.0, -1.0, -1.0)


@dataclass(frozen=True, eq=False)
class RigStart:
    """What is known of the rig before the images are compared, and how well: a guess with standard deviations."""

    thermal_camera: CameraModel
    """Start value of the thermal intrinsics, at the thermal images' size."""
    visible_to_thermal: FloatArray = field(default_factory=lambda: np.eye(4))
    """x_thermal = visible_to_thermal @ x_visible, shape (4, 4), OpenCV axes, lengths in world units."""
    focal_sigma: float = 0.08
    """Standard deviation of the focal length, as a share of it."""
    rotation_sigma_deg: float = 3.0
    """Standard deviation of the rotation about each axis [degrees]."""
    translation_sigma: float | None = None
    """Standard deviation of the shift along each axis [world units]. None: 3 % of the median depth of the points."""
    centre_sigma: float = 0.005
    """Standard deviation of the principal point, as a share of the image width. A turn moves the image of a narrow lens
    almost as the principal point does, so what is allowed here is what the rotation remains unsure by."""
    k1_sigma: float = 0.05
    """Standard deviation of the radial distortion; 0 keeps it as given."""
    source: str = "a guess: same place and direction as the visible camera"
    """Where the start comes from, for the report."""


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """The rig as found, or the start where the images cannot tell."""

    thermal_camera: CameraModel
    """Thermal intrinsics."""
    visible_to_thermal: FloatArray
    """x_thermal = visible_to_thermal @ x_visible, shape (4, 4), OpenCV axes, lengths in world units."""
    parameters: tuple[str, ...]
    """Names of the parameters that the covariance is of: rx, ry, rz [rad], tx, ty, tz [world units], log_focal, cx, cy
    [thermal pixels], k1."""
    covariance: FloatArray
    """Covariance of the parameters, shape (n, n)."""
    determined: bool
    """Whether the images say where the thermal camera is. False: camera and transform are those of the start."""
    explanation: str
    """One sentence for the report: what was found, or why nothing could be."""
    score_before: float
    """Agreement of thermal and visible edges with the start value, -1 to 1."""
    score_after: float
    """The same with the values returned."""
    projection_sigma_px: float
    """Standard error of where a scene point falls in the thermal image, median over the points [thermal pixels]."""

    @property
    def standard_errors(self) -> dict[str, float]:
        """Square roots of the covariance's diagonal by parameter."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist()))

    def thermal_pose(self, camera_to_world: npt.ArrayLike) -> FloatArray:
        """Pose of the thermal camera (4, 4) from that of the visible one, both OpenGL."""
        pose = np.asarray(camera_to_world, dtype=np.float64)
        return pose @ OPENGL_FROM_OPENCV @ np.linalg.inv(self.visible_to_thermal) @ OPENGL_FROM_OPENCV


@dataclass(frozen=True, eq=False)
class DriftEstimate:
    """How far each thermal image reads too high, and how that grows towards the image's corners."""

    offsets_k: FloatArray
    """To be subtracted from each frame's temperatures, in the order of the frames, mean 0, shape (frames,) [K]."""
    radial: tuple[float, ...]
    """Coefficients c of sum(c[i] * r ** (2 * i + 2)) [K], r = 1 in the image's corner; subtracted from all frames."""
    before_k: float
    """Median difference between two frames at the scene points that both see, uncorrected [K]."""
    after_k: float
    """The same after the correction, at points that it was not fitted to [K]."""
    used: bool
    """Whether the correction lowers the disagreement at held-out points; False: all offsets and coefficients are 0."""
    explanation: str
    """One sentence for the report."""

    def radial_k(self, width: int, height: int) -> FloatArray:
        """Radial term at every pixel's centre, shape (height, width) [K]; 0 at the image's centre."""
        r2 = radius_squared(np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1), width, height)
        return np.sum([c * r2 ** (power + 1) for power, c in enumerate(self.radial)], axis=0) + np.zeros_like(r2)

    def corrected(self, frame: int, temperature_c: npt.NDArray) -> npt.NDArray[np.float32]:
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
