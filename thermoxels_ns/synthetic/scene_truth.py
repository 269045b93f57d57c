"""The exact description of a synthetic scene: shape, colour, temperature, surroundings and cameras."""

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
    """A solid with the colour and temperature of its surface."""

    solid: Solid  # everything that is not air; lengths in metres
    colour: RgbFunction  # function of points (n, 3) and normals (n, 3) to red, green, blue in [0, 1] (n, 3)
    surface_temperature_c: DegreesFunction
    """Function of points (n, 3) to temperatures (n,) [C], the same from all sides; smooth, also off the surface."""


@dataclass(frozen=True, eq=False)
class SyntheticScene(Body):
    """A scene that is known exactly. Lengths are in metres, temperatures in degrees Celsius, z points up."""

    name: str
    scene_box: Box  # lower and upper corner of the box to reconstruct, which contains the solid
    temperature_bounds_c: tuple[float, float]
    """Bounds of the temperatures of all surfaces and of the background."""
    background_rgb: RgbFunction  # function of unit directions (n, 3), away from the camera, to colours (n, 3)
    background_temperature_c: DegreesFunction  # function of such directions to temperatures (n,) [C]
    rings: tuple[CameraRing | CameraWalk, ...]  # where cameras stand
    focal_share: float  # focal length over the image width, for a 4:3 image
    around: Body | None = None
    """Things between the scene and infinity that photographs show, such as houses opposite; meshes leave them out."""
    mirror: RgbFunction | None = None
    """Function of points (n, 3) and normals (n, 3) to the share of light (n,) that the surface mirrors; None: none."""

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The scene itself, then `around` if there is one."""
        return (self,) if self.around is None else (self, self.around)

    @property
    def size(self) -> float:
        """Longest side of `scene_box` [m]."""
        return float(np.subtract(self.scene_box[1], self.scene_box[0]).max())

    def camera(self, width: int, height: int) -> Camera:
        """Return a camera of the given image size [pixels] that frames the scene from every pose of the rings."""
        focal = self.focal_share * min(float(width), height * _ASPECT)
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)

    def poses(self, num_train: int, num_eval: int) -> tuple[FloatArray, FloatArray]:
        """Return training (num_train, 4, 4) and held-out poses (num_eval, 4, 4), camera to world (OpenGL axes)."""
        return ring_poses(self.rings, num_train, num_eval)
