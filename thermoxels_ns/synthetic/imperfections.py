"""What real cameras do to photographs, as switches of the synthetic scenes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_ranges

_NOISE_SIGMAS = 6.0  # Noise that thermal files leave room for
_PASSER_BY = ((0.09, 0.03, 0.03), 31.0)  # Colour and temperature, [degrees Celsius], of somebody in dark clothes
_PASSER_BY_SIZE = (0.06, 0.35)  # Half width and half height, relative to the photograph's height


@dataclass(frozen=True)
class Imperfections:
    """Flaws of cameras and of their poses. All are off unless given; random ones are drawn from the scene's seed."""

    exposure_stops: float = 0.0
    """Standard deviation of the exposure of each photograph, [stops]: pixel values are multiplied by 2^x."""
    white_balance: float = 0.0
    """Standard deviation of each channel's gain of each photograph, relative."""
    vignetting: float = 0.0
    """Share of the light that the corners of the photographs lose; it grows with the square of the distance."""
    noise_counts: float = 0.0
    """Standard deviation of the noise in every pixel of the photographs, [counts of 255]."""
    jpeg_quality: int = 92
    """Quality of JPEG files, 1 to 95."""
    motion_blur_px: float = 0.0
    """Length of the line, in a direction of its own in each photograph, along which pixels are blurred, [pixels]."""
    rolling_shutter_px: float = 0.0
    """How far the photograph moves between its first and its last row, [pixels]; the pose is that of the middle row."""
    pose_error_deg: float = 0.0
    """Standard deviation of the angle, about each axis, by which the poses given are turned, [degrees]; they are also
    moved, by as much as that turn moves what the scene's middle shows."""
    pose_correlation: float = 0.0
    """Share of a pose's error that the next photograph has too, below 1: 0.95 for a walk."""
    focal_error: float = 0.0
    """How much longer the focal length given is than the true one, relative."""
    noise_k: float = 0.0
    """Standard deviation of the noise in every thermal pixel, [K]."""
    drift_k: float = 0.0
    """Standard deviation of one temperature offset per thermal image, [K], as uncooled cameras have it."""
    thermal_blur_px: float = 0.0
    """Standard deviation of the thermal camera's Gaussian point spread, [thermal pixels]."""
    thermal_vignetting_k: float = 0.0
    """How much too cold the corners of the thermal images read, [K]; it grows with the square of the distance."""
    fixed_pattern_k: float = 0.0
    """Standard deviation of an offset of each thermal pixel that is the same in all images, [K]."""
    dead_pixels: float = 0.0
    """Share of the thermal pixels that always read the same value."""
    rig_error_deg: float = 0.0
    """Standard deviation of the angle, about each axis, by which all given poses of a thermal camera of its own are
    turned against the photographs', [degrees]."""
    passers_by: float = 0.0
    """Share of the pairs in which somebody walks before the scene, 31 C warm."""

    def check(self) -> None:
        """Refuse what cannot be drawn.

        Raises:
            ThermoxelsError: Names the option, what it takes and what it got.
        """
        limits = {field.name: (0.0, 1e6, "a finite number of at least 0") for field in fields(self)}
        limits |= dict.fromkeys(("vignetting", "dead_pixels", "passers_by"), (0.0, 1.0, "from 0 to 1"))
        limits |= {"pose_correlation": (0.0, 0.999, "from 0 to 0.999"), "focal_error": (-0.5, 1.0, "from -0.5 to 1")}
        limits |= {"jpeg_quality": (1, 95, "from 1 to 95"), "white_balance": (0.0, 0.3, "from 0 to 0.3")}
        check_ranges("--", {name: (getattr(self, name), *limit) for name, limit in limits.items()})


PERFECT = Imperfections()


class DrawnFlaws:
    """What was drawn for the photographs of one scene: the truth that corrections are to find.

    Args:
        flaws: How large the flaws are.
        seed: Seed of all that is drawn.
        poses: True poses of the photographs (n, 4, 4), camera to world.
        middle: Middle of the scene (3,) [m], by whose distance poses are moved.
        range_c: Between which dead thermal pixels read [degrees Celsius].
    """

    def __init__(
        self,
        flaws: Imperfections,
        seed: int,
        poses: FloatArray,
        middle: npt.ArrayLike,
        range_c: tuple[float, float],
    ):
        self.flaws, self._seed, self._poses, self._range_c = flaws, seed, poses, range_c
        count, keep = len(poses), flaws.pose_correlation
        stops, balance = self._normal(count, 1, stream=2), self._normal(count, 3, stream=3)
        self.gains = 2.0 ** (flaws.exposure_stops * stops) * (1.0 + flaws.white_balance * balance)  # (n, 3)
        self.drifts_k = flaws.drift_k * np.random.default_rng([seed, 0]).standard_normal(count)
        errors = self._normal(count, 6, stream=4)
        for number in range(1, count):
            errors[number] = keep * errors[number - 1] + np.sqrt(1.0 - keep * keep) * errors[number]
        errors *= np.deg2rad(flaws.pose_error_deg)
        far = np.linalg.norm(poses[:, :3, 3] - np.asarray(middle, dtype=np.float64), axis=1)
        self.turns_rad, self._moves = errors[:, :3], errors[:, 3:] * far[:, None]  # about, and along, each axis
        self._rig_turn_rad = np.deg2rad(flaws.rig_error_deg) * self._normal(3, stream=5)
        self._passing: BoolArray = np.random.default_rng([seed, 6]).random(count) < flaws.passers_by

    def _normal(self, *shape: int, stream: int, number: int | None = None) -> FloatArray:
        """Normal deviates of a stream, of one photograph of it or of all."""
        return np.random.default_rng(
            [self._seed, stream] if number is None else [self._seed, stream, number]
        ).standard_normal(shape)

    def given_poses(self) -> FloatArray:
        """The poses (n, 4, 4) that a scene folder gives in place of the true ones."""
        given = self._poses.copy()
        given[:, :3, :3] = given[:, :3, :3] @ _turned(self.turns_rad)
        given[:, :3, 3] += self._moves
        return given

    def given_rig_turn(self) -> FloatArray:
        """Transform (4, 4) by which all poses of a thermal camera of its own are turned."""
        turn = np.eye(4)
        turn[:3, :3] = _turned(self._rig_turn_rad)
        return turn

    def bounds_c(self, lowest_c: float, highest_c: float) -> tuple[float, float]:
        """Lowest and highest reading [degrees Celsius] of thermal images of a scene with these temperatures."""
        flaws = self.flaws
        margin = _NOISE_SIGMAS * float(np.hypot(flaws.noise_k, flaws.fixed_pattern_k))
        low = min(float(self.drifts_k.min()), 0.0) - margin - flaws.thermal_vignetting_k
        return lowest_c + low, highest_c + (max(float(self.drifts_k.max()), 0.0) + margin)

    def given_camera(self, camera: Camera) -> Camera:
        """The intrinsics that a scene folder gives."""
        stretch = 1.0 + self.flaws.focal_error
        return replace(camera, fl_x=stretch * camera.fl_x, fl_y=stretch * camera.fl_y)

    def photograph(self, number: int, rgb: Float32Array) -> npt.NDArray[np.uint8]:
        """What the camera stores of a view (h, w, 3) in [0, 1]: counts (h, w, 3)."""
        flaws, draw = self.flaws, np.random.default_rng([self._seed, 7, number])
        angle, side, place = draw.uniform(0.0, 2.0 * np.pi), draw.random(), draw.random()
        seen = rgb.astype(np.float64)
        if self._passing[number]:
            seen[_passer_by(seen.shape[:2], place)] = _PASSER_BY[0]
        if flaws.rolling_shutter_px > 0.0:
            seen = _sheared(seen, flaws.rolling_shutter_px * (1.0 if side < 0.5 else -1.0))
        if flaws.motion_blur_px > 0.0:
            seen = _moved_along(seen, flaws.motion_blur_px, angle)
        seen *= 1.0 - flaws.vignetting * _corner_distance(seen.shape[:2])[..., None] ** 2
        counts = 255.0 * seen * self.gains[number] + flaws.noise_counts * draw.standard_normal(seen.shape)
        return np.clip(np.round(counts), 0, 255).astype(np.uint8)

    def thermogram(self, number: int, temperature_c: FloatArray) -> FloatArray:
        """What the thermal camera reads of true apparent temperatures (h, w), [degrees Celsius]."""
        from scipy import ndimage

        flaws, shape, seen = self.flaws, temperature_c.shape, temperature_c.copy()
        if self._passing[number]:
            place = np.random.default_rng([self._seed, 7, number]).random(3)[2]
            seen[_passer_by(shape, place)] = _PASSER_BY[1]
        seen = ndimage.gaussian_filter(seen, flaws.thermal_blur_px, mode="nearest") + self.drifts_k[number]
        seen -= flaws.thermal_vignetting_k * _corner_distance(shape) ** 2
        seen += flaws.noise_k * self._normal(*shape, stream=1, number=number)
        seen += flaws.fixed_pattern_k * self._normal(*shape, stream=8)
        draw = np.random.default_rng([self._seed, 9])
        return np.where(draw.random(shape) < flaws.dead_pixels, draw.uniform(*self._range_c, shape), seen)

    def truth(self) -> dict[str, object]:
        """What ``truth.json`` says of the flaws."""
        return {
            "imperfections": vars(self.flaws),
            "gains": self.gains.tolist(),
            "drift_k": self.drifts_k.tolist(),
            "rig_turn_deg": np.rad2deg(self._rig_turn_rad).tolist(),
            "passers_by": np.flatnonzero(self._passing).tolist(),
            "poses": self._poses.tolist(),
        }


def _turned(rotation_vectors: FloatArray) -> FloatArray:
    """Matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    from scipy.spatial.transform import Rotation  # not loaded by --help

    return Rotation.from_rotvec(rotation_vectors).as_matrix()


def _corner_distance(shape: tuple[int, ...]) -> FloatArray:
    """Distance of pixels from the middle of an image (h, w), 1 at its corners."""
    y, x = (np.linspace(-1.0, 1.0, side + 2)[1:-1] for side in shape)
    return np.sqrt(0.5 * (y[:, None] ** 2 + x**2))


def _passer_by(shape: tuple[int, ...], place: float) -> BoolArray:
    """Pixels (h, w) of somebody who walks by at a share of the width: an upright ellipse."""
    height, width = shape
    rows, columns = np.mgrid[:height, :width] + 0.5
    x, y = (columns - place * width) / height, (rows - 0.6 * height) / height
    return (x / _PASSER_BY_SIZE[0]) ** 2 + (y / _PASSER_BY_SIZE[1]) ** 2 <= 1.0


def _sheared(image: FloatArray, pixels: float) -> FloatArray:
    """An image (h, w, 3) whose last row stands so many pixels to the side of its first."""
    from scipy import ndimage

    height = len(image)
    shift = pixels * ((np.arange(height) + 0.5) / height - 0.5)
    return np.stack([ndimage.shift(row, (by, 0.0), order=1, mode="nearest") for row, by in zip(image, shift)])


def _moved_along(image: FloatArray, length: float, angle: float) -> FloatArray:
    """Mean of an image (h, w, 3) over shifts along a line of some pixels at an angle [rad]."""
    from scipy import ndimage

    steps = 2 * int(np.ceil(length)) + 1
    shifts = np.linspace(-0.5, 0.5, steps)[:, None] * length * np.array([np.sin(angle), np.cos(angle)])
    return np.mean([ndimage.shift(image, (*by, 0.0), order=1, mode="nearest") for by in shifts], axis=0)
