"""Flaws of real cameras and poses, which synthetic scenes can imitate."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_ranges

_NOISE_SIGMAS = 6.0  # Standard deviations of the noise for which the range of thermal files leaves room
_PASSER_BY = ((0.09, 0.03, 0.03), 31.0)  # Colour and temperature, [degrees Celsius], of a person in dark clothes
_PASSER_BY_SIZE = (0.06, 0.35)  # Half width and half height, relative to the photograph's height


@dataclass(frozen=True)
class Imperfections:
    """Sizes of the flaws of cameras and poses; a size of 0 switches a flaw off. `DrawnFlaws` draws them from a seed."""

    exposure_stops: float = 0.0
    """Standard deviation of the exposure x of each photograph, [stops]: pixel values are multiplied by 2^x."""
    white_balance: float = 0.0
    """Standard deviation of the gain of each channel of each photograph, relative to 1."""
    noise_counts: float = 0.0
    """Standard deviation of the noise in every pixel of the photographs, [counts of 255]."""
    pose_error_deg: float = 0.0
    """Standard deviation of the angle, about each axis, by which given poses are turned, [degrees]. Given positions are
    also moved: along each axis by a second such angle, in radians, times the distance to the scene's middle."""
    pose_correlation: float = 0.0
    """Correlation of the pose errors of successive photographs, below 1: 0.95 for a walk."""
    focal_error: float = 0.0
    """Error of the given focal length, relative to the true one; above 0 the given focal length is too long."""
    noise_k: float = 0.0
    """Standard deviation of the noise in every thermal pixel, [K]."""
    drift_k: float = 0.0
    """Standard deviation of the temperature offset of each thermal image, [K], as uncooled cameras have it."""
    thermal_blur_px: float = 0.0
    """Standard deviation of the thermal camera's Gaussian point spread, [thermal pixels]."""
    passers_by: float = 0.0
    """Share of the pairs of images in which a person, 31 C warm, walks before the scene."""

    def __post_init__(self) -> None:
        limits = {field.name: (0.0, 1e6, "a finite number of at least 0") for field in fields(self)}
        limits |= {"passers_by": (0.0, 1.0, "from 0 to 1"), "pose_correlation": (0.0, 0.999, "from 0 to 0.999")}
        limits |= {"focal_error": (-0.5, 1.0, "from -0.5 to 1"), "white_balance": (0.0, 0.3, "from 0 to 0.3")}
        check_ranges("--", {name: (getattr(self, name), *limit) for name, limit in limits.items()})


PERFECT = Imperfections()


class DrawnFlaws:
    """The flaws of one scene's images and poses, drawn at random; methods apply these flaws to images and poses.

    Args:
        flaws: Sizes of the flaws.
        seed: Seed of all random numbers.
        poses: True poses of the photographs (n, 4, 4), camera to world.
        middle: Middle of the scene (3,) [m]; errors of position are proportional to the distance to it.
    """

    def __init__(self, flaws: Imperfections, seed: int, poses: FloatArray, middle: npt.ArrayLike):
        self.flaws, self._seed, self._poses = flaws, seed, poses
        count, keep = len(poses), flaws.pose_correlation
        stops, balance = self._normal(count, 1, stream=(2,)), self._normal(count, 3, stream=(3,))
        self.gains = 2.0 ** (flaws.exposure_stops * stops) * (1.0 + flaws.white_balance * balance)  # (n, 3)
        self.drifts_k = flaws.drift_k * self._normal(count, stream=(0,))
        errors = self._normal(count, 6, stream=(4,))
        for number in range(1, count):
            errors[number] = keep * errors[number - 1] + np.sqrt(1.0 - keep * keep) * errors[number]
        errors *= np.deg2rad(flaws.pose_error_deg)
        far = np.linalg.norm(poses[:, :3, 3] - np.asarray(middle, dtype=np.float64), axis=1)
        self.turns_rad, self._moves = errors[:, :3], errors[:, 3:] * far[:, None]  # about, and along, each axis
        self._passing: BoolArray = np.random.default_rng([seed, 6]).random(count) < flaws.passers_by

    def _normal(self, *shape: int, stream: tuple[int, ...]) -> FloatArray:
        """Return standard normal numbers of the given shape from a stream of its own for each `stream`."""
        return np.random.default_rng([self._seed, *stream]).standard_normal(shape)

    def given_poses(self) -> FloatArray:
        """Return the true poses with the drawn errors, (n, 4, 4), camera to world: the scene folder states these."""
        from scipy.spatial.transform import Rotation  # imported here so that --help stays fast

        given = self._poses.copy()
        given[:, :3, :3] = given[:, :3, :3] @ Rotation.from_rotvec(self.turns_rad).as_matrix()
        given[:, :3, 3] += self._moves
        return given

    def bounds_c(self, lowest_c: float, highest_c: float) -> tuple[float, float]:
        """Return lowest and highest reading [C] for `lowest_c` to `highest_c` [C], with drift and 6 sigma of noise."""
        margin = _NOISE_SIGMAS * self.flaws.noise_k
        low, high = min(float(self.drifts_k.min()), 0.0), max(float(self.drifts_k.max()), 0.0)
        return lowest_c + (low - margin), highest_c + (high + margin)

    def given_camera(self, camera: Camera) -> Camera:
        """Return `camera` with the error of its focal length: the scene folder states this camera."""
        stretch = 1.0 + self.flaws.focal_error
        return replace(camera, fl_x=stretch * camera.fl_x, fl_y=stretch * camera.fl_y)

    def photograph(self, number: int, rgb: Float32Array) -> npt.NDArray[np.uint8]:
        """Return photograph `number` with its flaws, counts (h, w, 3), of the true colours `rgb` (h, w, 3), 0 to 1."""
        flaws, draw = self.flaws, np.random.default_rng([self._seed, 7, number])
        place, seen = draw.random(3)[2], rgb.astype(np.float64)
        if self._passing[number]:
            seen[_passer_by(seen.shape[:2], place)] = _PASSER_BY[0]
        counts = 255.0 * seen * self.gains[number] + flaws.noise_counts * draw.standard_normal(seen.shape)
        return np.clip(np.round(counts), 0, 255).astype(np.uint8)

    def thermogram(self, number: int, temperature_c: FloatArray) -> FloatArray:
        """Return thermal image `number` with its flaws, (h, w) [C], made from the true `temperature_c` (h, w) [C]."""
        from scipy import ndimage

        flaws, shape, seen = self.flaws, temperature_c.shape, temperature_c.copy()
        if self._passing[number]:
            place = np.random.default_rng([self._seed, 7, number]).random(3)[2]
            seen[_passer_by(shape, place)] = _PASSER_BY[1]
        seen = ndimage.gaussian_filter(seen, flaws.thermal_blur_px, mode="nearest") + self.drifts_k[number]
        seen += flaws.noise_k * self._normal(*shape, stream=(1, number))
        return seen

    def truth(self) -> dict[str, object]:
        """Return the entries of ``truth.json`` by name: sizes of the flaws, drawn values, and the true poses."""
        return {
            "imperfections": vars(self.flaws),
            "gains": self.gains.tolist(),
            "drift_k": self.drifts_k.tolist(),
            "passers_by": np.flatnonzero(self._passing).tolist(),
            "poses": self._poses.tolist(),
        }


def _passer_by(shape: tuple[int, ...], place: float) -> BoolArray:
    """Return a mask (h, w) of the pixels that a passer-by covers, an ellipse `place` times the width from the left."""
    height, width = shape
    rows, columns = np.mgrid[:height, :width] + 0.5
    x, y = (columns - place * width) / height, (rows - 0.6 * height) / height
    return (x / _PASSER_BY_SIZE[0]) ** 2 + (y / _PASSER_BY_SIZE[1]) ** 2 <= 1.0
