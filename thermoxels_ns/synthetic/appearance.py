"""Colour of synthetic scenes (paints, solid texture, light), and colour and temperature of backgrounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.arrays import Float32Array, FloatArray
from thermoxels_ns.synthetic.solids import Box

_SPACINGS_VOXELS = (2.0, 4.0, 10.0)
_AMPLITUDES = (0.45, 0.55, 0.5)
_REFERENCE_RESOLUTION = 64
_HORIZON_BLEND = 0.08
_GROUND_RISE_K = 2.0
# Columns are the noise channels: brightness, then two colour differences. Rows are red, green and blue.
_CHANNELS_TO_RGB = np.array([[0.8, 0.3, 0.0], [0.8, -0.1, 0.25], [0.8, -0.15, -0.3]], dtype=np.float32)


class SolidTexture:
    """A texture in space: a random colour deviation at every point, which does not repeat within the box.

    The texture is the sum of random values on three cubic lattices, interpolated with a smoothstep. The spacing of the
    finest lattice is 2 / 64 of the box's longest side.
    """

    def __init__(self, box: Box, seed: int) -> None:
        """Draw the values of the three lattices; `box` is lower and upper corner [m]."""
        draw = np.random.default_rng(seed)
        self._lo = np.asarray(box[0], dtype=np.float64)
        voxel = float(np.subtract(box[1], box[0]).max()) / _REFERENCE_RESOLUTION
        self._octaves: list[tuple[float, float, Float32Array]] = []
        for spacing, amplitude in zip(_SPACINGS_VOXELS, _AMPLITUDES):
            size = int(np.ceil(_REFERENCE_RESOLUTION / spacing)) + 4
            values = draw.uniform(-1.0, 1.0, (size**3, 3)).astype(np.float32)
            self._octaves.append((spacing * voxel, amplitude, values.T.reshape(3, size, size, size)))

    def __call__(self, points: npt.ArrayLike) -> Float32Array:
        """Return the deviations of red, green and blue (n, 3) at points (n, 3) [m]: mean about 0, mostly in -1 to 1."""
        relative = np.asarray(points, dtype=np.float64) - self._lo
        noise = np.zeros((len(relative), 3), dtype=np.float32)
        for spacing, amplitude, values in self._octaves:
            corner = np.floor(relative.T / spacing)
            share = relative.T / spacing - corner
            place = corner + share * share * (3.0 - 2.0 * share)
            for channel, grid in enumerate(values):
                noise[:, channel] += amplitude * ndimage.map_coordinates(grid, place, order=1, mode="grid-wrap")
        return noise @ _CHANNELS_TO_RGB.T


@dataclass(frozen=True)
class Paint:
    """A base colour, the strength of the texture on it, and a share of mirroring."""

    base: tuple[float, float, float]  # red, green, blue, 0 to 1
    contrast: float = 0.22  # weight of the texture, 0 to about 0.4
    mirror: float = 0.0  # share of the light that the surface reflects as a mirror, 0 to 1; the rest shows the paint


@dataclass(frozen=True)
class SunLight:
    """Lambert shading by one distant light and an ambient part; there are no shadows."""

    towards: tuple[float, float, float] = (0.45, -0.6, 0.66)  # direction to the light, any length
    ambient: float = 0.62  # brightness of a surface that faces away from the light; facing the light it is 1

    def brightness(self, normals: npt.ArrayLike) -> Float32Array:
        """Return the brightness, `ambient` to 1, of surfaces with unit normals (n, 3), shape (n, 1)."""
        sun = np.asarray(self.towards) / np.linalg.norm(self.towards)
        facing = np.maximum(np.asarray(normals) @ sun, 0.0)
        return (self.ambient + (1.0 - self.ambient) * facing).astype(np.float32)[:, None]


def sky_temperature_c(directions: npt.ArrayLike, horizon_c: float, drop_k: float) -> FloatArray:
    """Return the apparent temperature [C] of sky and far ground along unit directions (n, 3), shape (n,).

    The temperature is `horizon_c` at the horizon, `drop_k` lower at the zenith, and 2 K higher straight below. Between
    these it is linear in z, the sine of the elevation.
    """
    z = np.asarray(directions, dtype=np.float64)[:, 2]
    return horizon_c - drop_k * _rise(z) + _GROUND_RISE_K * _rise(-z)


def plain(value: npt.ArrayLike) -> Callable[..., npt.NDArray]:
    """Return a background of one colour (red, green, blue, 0 to 1) or of one temperature [C]: a function of directions
    (n, 3) to colours (n, 3) or temperatures (n,)."""
    return lambda directions: np.full((len(np.asarray(directions)), *np.shape(value)), value)


def sky_rgb(directions: npt.ArrayLike) -> Float32Array:
    """Return colours (n, 3) for unit directions (n, 3): pale haze at the horizon, blue above, grey green below."""
    z = np.asarray(directions, dtype=np.float64)[:, 2:]
    haze, blue, ground = (0.82, 0.86, 0.90), (0.26, 0.45, 0.80), (0.46, 0.48, 0.40)
    up, down = _rise(z), np.minimum(3.0 * _rise(-z), 1.0)
    colour = haze + np.subtract(blue, haze) * up + np.subtract(ground, haze) * down
    return np.clip(colour, 0.0, 1.0).astype(np.float32)


def room_rgb(directions: npt.ArrayLike) -> Float32Array:
    """Return colours (n, 3) for unit directions (n, 3): light grey, darker below, redder towards +x, bluer to +y."""
    x, y, z = np.asarray(directions, dtype=np.float32).T
    return np.stack([0.74 + 0.04 * x + 0.06 * z, 0.73 + 0.07 * z, 0.72 + 0.03 * y + 0.08 * z], axis=1)


def _rise(z: FloatArray) -> FloatArray:
    """Return max(z, 0) with a smooth bend, (z + b)^2 / 4b for -b < z < b = 0.08; z is the sine of the elevation."""
    b = _HORIZON_BLEND
    return np.where(z > b, z, np.square(np.maximum(z + b, 0.0)) / (4.0 * b))
