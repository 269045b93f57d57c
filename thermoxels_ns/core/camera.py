"""The camera that all rooms use: image size, lens and distortion, without a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.errors import SceneError

_UNDISTORT_STEPS = 20  # Fixed-point steps that remove distortion
_MOST_PIXELS = 1_000_000  # Most pixels along a side


@dataclass(frozen=True)
class Camera:
    """The projection of one camera; fields are named as in transforms.json, lengths are in pixels.

    Poses passed to methods, (3, 4) or (4, 4), are camera to world with x right, y up, z back (OpenGL), as in
    transforms.json. Points in camera axes have x right, y down, z ahead (OpenCV). The centre of the top left pixel is
    at (0.5, 0.5).
    """

    width: int
    height: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    k1: float = 0.0  # Radial distortion, coefficient of r^2, as in OpenCV
    k2: float = 0.0  # Coefficient of r^4
    p1: float = 0.0  # Tangential distortion, as in OpenCV
    p2: float = 0.0  # Tangential distortion, as in OpenCV
    k3: float = 0.0  # Coefficient of r^6
    k4: float = 0.0  # Coefficient of r^8

    def __post_init__(self) -> None:
        numbers = (self.fl_x, self.fl_y, self.cx, self.cy, *self.distortion)
        good = all(map(math.isfinite, numbers)) and min(self.fl_x, self.fl_y) > 0
        if not (good and 0 < self.width <= _MOST_PIXELS and 0 < self.height <= _MOST_PIXELS):
            expected = f"1 to {_MOST_PIXELS} pixels a side, focal lengths above 0 and finite numbers"
            remedy = "Correct the intrinsics."
            got = f"{self.width} x {self.height} pixels, {numbers}"
            raise SceneError("camera", expected=expected, got=got, remedy=remedy)

    @property
    def distortion(self) -> tuple[float, float, float, float, float, float]:
        """Distortion coefficients k1, k2, k3, k4, p1, p2, in nerfstudio's order."""
        return self.k1, self.k2, self.k3, self.k4, self.p1, self.p2

    def entries(self) -> dict[str, Any]:
        """Return image size and lens as entries of transforms.json; k3 and k4 are left out."""
        names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
        lens = {name: getattr(self, name) for name in names}
        return {"camera_model": "OPENCV", "w": self.width, "h": self.height, **lens}

    def resized(self, width: int, height: int) -> Camera:
        """Return the same camera for its image resampled to `width` x `height` pixels; distortion does not change."""
        x, y = width / self.width, height / self.height
        lengths = {"fl_x": self.fl_x * x, "fl_y": self.fl_y * y, "cx": self.cx * x, "cy": self.cy * y}
        return replace(self, width=width, height=height, **lengths)

    def scaled(self, factor: float) -> Camera:
        """Return the same camera with `factor` times as many pixels along each side, rounded down to at least 1."""
        width, height = (max(int(length * factor + 1e-6), 1) for length in (self.width, self.height))
        lengths = {name: getattr(self, name) * factor for name in ("fl_x", "fl_y", "cx", "cy")}
        return replace(self, width=width, height=height, **lengths)

    def project(self, points: npt.ArrayLike) -> FloatArray:
        """Return the pixels (n, 2) of points (n, 3) in OpenCV camera axes; NaN for points not ahead of the camera."""
        local = np.asarray(points, dtype=np.float64)
        ahead = local[:, 2] > 0.0
        scale = np.divide(1.0, local[:, 2], out=np.full(len(local), np.nan), where=ahead)
        return self._distort(local[:, :2] * scale[:, None]) * (self.fl_x, self.fl_y) + (self.cx, self.cy)

    def project_world(self, pose: npt.ArrayLike, points: npt.ArrayLike) -> FloatArray:
        """Return the pixels (n, 2) of world points (n, 3) for a camera at `pose`; NaN for points not ahead."""
        pose = np.asarray(pose, dtype=np.float64)
        local = (np.asarray(points, dtype=np.float64) - pose[:3, 3]) @ pose[:3, :3]
        return self.project(local * (1.0, -1.0, -1.0))

    def rays(self, pixels: npt.ArrayLike) -> FloatArray:
        """Return the points (n, 3) at depth 1, in OpenCV camera axes, that `project` maps to the pixels (n, 2)."""
        pixels = np.asarray(pixels, dtype=np.float64)
        distorted = (pixels - (self.cx, self.cy)) / (self.fl_x, self.fl_y)
        plane = distorted
        if any(self.distortion):
            for _ in range(_UNDISTORT_STEPS):
                plane = plane + (distorted - self._distort(plane))
        return np.column_stack([plane, np.ones(len(plane))])

    def directions(self, pose: npt.ArrayLike, samples_per_axis: int = 1) -> FloatArray:
        """Return unit ray directions in world axes through a regular grid of points in each pixel. The result has the
        shape (height, width, samples_per_axis^2, 3)."""
        s = samples_per_axis
        x, y = ((np.arange(length * s) + 0.5) / s for length in (self.width, self.height))
        local = self.rays(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)) * (1.0, -1.0, -1.0)
        local /= np.sqrt(np.einsum("ij,ij->i", local, local))[:, None]
        world = local @ np.asarray(pose, dtype=np.float64)[:3, :3].T
        blocks = world.reshape(self.height, s, self.width, s, 3).transpose(0, 2, 1, 3, 4)
        return blocks.reshape(self.height, self.width, s * s, 3)

    def contains(self, pixels: npt.ArrayLike, border: float = 0.0) -> BoolArray:
        """Return which pixels (n, 2) lie in the image, at least `border` pixels from its edge, (n,); NaN: False."""
        x, y = np.asarray(pixels, dtype=np.float64).T
        return (x >= border) & (x <= self.width - border) & (y >= border) & (y <= self.height - border)

    def _distort(self, plane: FloatArray) -> FloatArray:
        """Return points (n, 2) at depth 1 distorted by Brown's model."""
        if not any(self.distortion):
            return plane
        x, y = plane[:, 0], plane[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
        dx = 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        dy = self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return np.column_stack([x * radial + dx, y * radial + dy])
