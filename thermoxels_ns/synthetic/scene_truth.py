"""The exact description of a synthetic scene: shape, colour, temperature, surroundings and cameras."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import Float32Array, FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.solids import Box, Solid, Vector

RgbFunction = Callable[..., Float32Array]
DegreesFunction = Callable[[npt.ArrayLike], FloatArray]

_ASPECT = 4.0 / 3.0


def look_at(position: npt.ArrayLike, target: npt.ArrayLike) -> FloatArray:
    """Return the camera-to-world pose (4, 4) of a camera at `position` (3,) that looks at `target` (3,).

    The camera's axes are x right, y up, z back (OpenGL); the world's z is up. The caller must not pass a target that is
    straight above or below the camera.
    """
    position = np.asarray(position, dtype=np.float64)
    back = position - np.asarray(target, dtype=np.float64)
    right = np.cross((0.0, 0.0, 1.0), back)
    assert np.linalg.norm(right) > 1e-9 * np.linalg.norm(back)
    right /= np.linalg.norm(right)
    back /= np.linalg.norm(back)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(back, right), back, position
    return pose


@dataclass(frozen=True)
class CameraRing:
    """Cameras on a horizontal circle, or on an arc of it, that all look at one point."""

    target: Vector  # point at which all cameras look, on the axis of the circle [m]
    radius_m: float  # horizontal distance from the axis [m]
    height_m: float  # z of the cameras [m]
    start_deg: float = 0.0  # azimuth of the arc's begin, counted from x towards y [degrees]
    span_deg: float = 360.0  # length of the arc [degrees]; 360 closes the ring

    def pose(self, share: float) -> FloatArray:
        """Return the camera-to-world pose (4, 4) at `share` of the arc, 0 (begin) to 1 (end), see `look_at`."""
        azimuth = math.radians(self.start_deg + self.span_deg * share)
        x = self.target[0] + self.radius_m * math.cos(azimuth)
        y = self.target[1] + self.radius_m * math.sin(azimuth)
        return look_at((x, y, self.height_m), self.target)


def rings_around(middle: tuple[float, float], *rings: Vector, **arc: float) -> tuple[CameraRing, ...]:
    """Return a `CameraRing` around `middle` (x, y) for each of `rings`: z of the target, radius, z of the cameras [m].

    `arc` are further arguments of every `CameraRing`: `start_deg` and `span_deg`.
    """
    return tuple(CameraRing((*middle, aim), radius, height, **arc) for aim, radius, height in rings)


@dataclass(frozen=True)
class CameraWalk:
    """Cameras on a straight line; each looks at the point at the same share of the length of a second line."""

    ends: tuple[Vector, Vector]  # begin and end of the line of cameras [m]
    aims: tuple[Vector, Vector]  # points at which cameras at begin and end look [m]

    def pose(self, share: float) -> FloatArray:
        """Return the camera-to-world pose (4, 4) at `share` of the line, 0 (begin) to 1 (end), see `look_at`."""
        position, aim = (np.add(a, share * np.subtract(b, a)) for a, b in (self.ends, self.aims))
        return look_at(position, aim)


@dataclass(frozen=True, eq=False)
class Body:
    """A solid with the colour and temperature of its surface."""

    solid: Solid  # everything that is not air; lengths in metres
    colour: RgbFunction  # function of points (n, 3) and normals (n, 3) to red, green, blue in [0, 1] (n, 3)
    surface_temperature_c: DegreesFunction
    """Function of points (n, 3) to temperatures (n,) [C], the same from all directions; smooth also off the surface."""


@dataclass(frozen=True, eq=False)
class SyntheticScene(Body):
    """A scene that is known exactly. Lengths are in metres, temperatures in degrees Celsius, z points up."""

    scene_box: Box  # lower and upper corner of the box to reconstruct, which contains the solid
    temperature_bounds_c: tuple[float, float]  # bounds of the temperatures of all surfaces and of the background
    background_rgb: RgbFunction  # function of unit directions (n, 3), away from the camera, to colours (n, 3)
    background_temperature_c: DegreesFunction  # function of unit directions (n, 3) to temperatures (n,) [C]
    rings: tuple[CameraRing | CameraWalk, ...]  # circles, arcs and lines on which cameras stand
    focal_share: float  # focal length over the image width, for a 4:3 image
    around: Body | None = None
    """Surroundings, such as houses opposite, that photographs show and that meshes leave out; None: no surroundings."""
    mirror: RgbFunction | None = None
    """Function of points (n, 3) and normals (n, 3) to the share of light (n,) that the surface mirrors; None: 0."""
    name: str = ""  # name by which `make_scene` returns this scene

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The scene itself, then `around` if there is one."""
        return (self,) if self.around is None else (self, self.around)

    @property
    def size(self) -> float:
        """Longest side of `scene_box` [m]."""
        return float(np.subtract(self.scene_box[1], self.scene_box[0]).max())

    def camera(self, width: int, height: int) -> Camera:
        """Return a camera of this image size [pixels] that shows the whole scene from every pose of the rings."""
        focal = self.focal_share * min(float(width), height * _ASPECT)
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)

    def poses(self, num_train: int, num_eval: int) -> tuple[FloatArray, FloatArray]:
        """Return camera-to-world poses of training (num_train, 4, 4) and of evaluation cameras (num_eval, 4, 4).

        Cameras are dealt out to the rings in turn. On a ring, training cameras are evenly spaced; each ring starts a
        fraction of a step later than the ring before. Evaluation cameras divide gaps between training cameras evenly.
        Raises `SceneError` if `num_train` is below 1 or `num_eval` below 0.
        """
        if num_train < 1 or num_eval < 0:
            expected, got = "at least 1 for training and at least 0 for evaluation", f"{num_train} and {num_eval}"
            raise SceneError("number of views", expected=expected, got=got, remedy="Raise num_train or num_eval.")
        used = self.rings[:num_train]
        train, held_out = [np.eye(4)] * num_train, [np.eye(4)] * num_eval
        for number, ring in enumerate(used):
            slots, wanted = len(range(number, num_train, len(used))), len(range(number, num_eval, len(used)))
            phase = 0.25 + 0.5 * (number + 0.5) / len(used)
            closed = isinstance(ring, CameraRing) and ring.span_deg >= 360.0  # the last camera stands beside the first
            gaps = slots if closed else max(slots - 1, 1)
            for slot in range(slots):
                train[number + slot * len(used)] = ring.pose((slot + phase) / slots)
            chosen = [int((q + 0.5) * gaps / wanted) for q in range(wanted)]
            for q, gap in enumerate(chosen):
                within = (chosen[:q].count(gap) + 1) / (chosen.count(gap) + 1)
                held_out[number + q * len(used)] = ring.pose((gap + phase + within) / slots)
        return np.array(train), np.array(held_out).reshape(-1, 4, 4)
