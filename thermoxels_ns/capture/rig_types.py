"""Types shared by poses, rig, drift and the scene writer."""

# Poses are camera to world with x right, y up, z back (OpenGL), as in transforms.json. Transforms between two cameras
# and points in front of a camera have x right, y down, z ahead (OpenCV). Pixel centres lie at +0.5. Lengths are those
# of the world that structure from motion found; its scale may be unknown.

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.camera import Camera

FloatArray = npt.NDArray[np.float64]

OPENGL_FROM_OPENCV: FloatArray = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns camera axes; it is its own inverse. ``pose @ OPENGL_FROM_OPENCV`` is camera to world in OpenCV's axes."""


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
    point_ids: npt.NDArray[np.int64]  # which point each of them is, the same number in all frames, shape (n,)

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
    """The rig as found, or the start where the images cannot tell."""

    thermal_camera: Camera
    visible_to_thermal: FloatArray
    """x_thermal = visible_to_thermal @ x_visible, shape (4, 4), OpenCV axes, lengths in world units."""
    determined: bool
    """Whether it is known where the thermal camera is. False: camera and transform are those of the start."""
    explanation: str  # one sentence for the report: what was found, or why nothing could be
    parameters: tuple[str, ...] = ()
    """Names of the parameters that the covariance is of: rx, ry, rz [rad], tx, ty, tz [world units], log_focal, cx, cy
    [thermal pixels], k1. Empty: nothing was estimated."""
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
    before_k: float  # median difference between two frames at the scene points that both see, uncorrected [K]
    after_k: float  # the same after the correction, at points that it was not fitted to [K]
    used: bool
    """Whether the correction lowers the disagreement at held-out points; False: all offsets and coefficients are 0."""
    explanation: str

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
