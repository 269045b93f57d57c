"""The exact description of a synthetic scene: shape, colour, temperature, surroundings and camera positions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import Float32Array, FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.synthetic.camera_rings import CameraRing, CameraWalk, ring_poses
from thermoxels_ns.synthetic.solids import Box, Solid

RgbFunction = Callable[..., Float32Array]

_ASPECT = 4.0 / 3.0


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Solid things outside the scene box that photographs show too: houses opposite, trees, a room's walls."""

    solid: Solid  # all of them [m]; not part of what is scored
    colour: RgbFunction  # (points (n, 3), normals (n, 3)) to red, green, blue in [0, 1] (n, 3)
    surface_temperature_c: Callable[[npt.ArrayLike], FloatArray]  # points (n, 3) to temperatures (n,)


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """A scene whose every answer is exact. Lengths in metres, temperatures in degrees Celsius, z up."""

    name: str
    solid: Solid  # everything that is not air
    scene_box: Box  # lower and upper corner of the exact box [m]: the solid lies inside it, the surroundings outside
    temperature_bounds_c: tuple[float, float]
    """No surface and no background is colder than the first or hotter than the second."""
    colour: RgbFunction  # (points (n, 3), normals (n, 3)) to red, green, blue in [0, 1] (n, 3)
    surface_temperature_c: Callable[[npt.ArrayLike], FloatArray]
    """Points (n, 3) to temperatures (n,); the same from every direction. Off the surface it continues smoothly."""
    background_rgb: RgbFunction  # unit directions (n, 3), away from the camera, to red, green, blue in [0, 1] (n, 3)
    background_temperature_c: Callable[[npt.ArrayLike], FloatArray]
    """Unit directions (n, 3), away from the camera, to apparent temperatures (n,)."""
    rings: tuple[CameraRing | CameraWalk, ...]
    focal_share: float  # focal length over the image width, for a 4:3 image
    around: Surroundings | None = None  # what stands between the scene and what lies at infinity (`background_rgb`)
    mirror: Callable[[npt.ArrayLike, npt.ArrayLike], Float32Array] | None = None
    """(points (n, 3), normals (n, 3)) to the share of light (n,) that a surface reflects as a mirror does."""

    @property
    def size(self) -> float:
        """Longest side of the scene box [m]."""
        return float(np.subtract(self.scene_box[1], self.scene_box[0]).max())

    def camera(self, width: int, height: int) -> Camera:
        """Camera of the given image size [pixels] that frames the scene in every view of the rings."""
        focal = self.focal_share * min(float(width), height * _ASPECT)
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)

    def poses(self, num_train: int, num_eval: int) -> tuple[FloatArray, FloatArray]:
        """Training (num_train, 4, 4) and held-out evaluation poses (num_eval, 4, 4), camera to world (OpenGL)."""
        return ring_poses(self.rings, num_train, num_eval)
