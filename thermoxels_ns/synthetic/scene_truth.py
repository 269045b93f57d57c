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
DegreesFunction = Callable[[npt.ArrayLike], FloatArray]

_ASPECT = 4.0 / 3.0


@dataclass(frozen=True, eq=False)
class Body:
    """Solid things, their colour and their temperature."""

    solid: Solid  # everything that is not air [m]
    colour: RgbFunction  # (points (n, 3), normals (n, 3)) to red, green, blue in [0, 1] (n, 3)
    surface_temperature_c: DegreesFunction
    """Points (n, 3) to temperatures (n,); the same from every direction. Off the surface it continues smoothly."""


@dataclass(frozen=True, eq=False)
class SyntheticScene(Body):
    """A scene whose every answer is exact. Lengths in metres, temperatures in degrees Celsius, z up."""

    name: str
    scene_box: Box  # lower and upper corner of the exact box [m]: the solid lies inside it, the surroundings outside
    temperature_bounds_c: tuple[float, float]
    """No surface and no background is colder than the first or hotter than the second."""
    background_rgb: RgbFunction  # unit directions (n, 3), away from the camera, to red, green, blue in [0, 1] (n, 3)
    background_temperature_c: DegreesFunction  # such directions to apparent temperatures (n,)
    rings: tuple[CameraRing | CameraWalk, ...]
    focal_share: float  # focal length over the image width, for a 4:3 image
    around: Body | None = None
    """What photographs show between the scene and infinity, such as houses opposite; it is not scored."""
    mirror: RgbFunction | None = None
    """(points (n, 3), normals (n, 3)) to the share of light (n,) that a surface reflects as a mirror does."""

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The scene's own body, then what stands around it."""
        return (self,) if self.around is None else (self, self.around)

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
