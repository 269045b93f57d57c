"""Surroundings of a synthetic scene: open sky or the walls of a room."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_HORIZON_BLEND = 0.08
_GROUND_RISE_K = 2.0


def sky_temperature_c(directions: npt.ArrayLike, horizon_c: float, drop_k: float) -> FloatArray:
    """Apparent temperature of the sky, linear in the sine of the elevation; of the far ground below the horizon.

    Args:
        directions: Unit directions away from the camera, shape (n, 3).
        horizon_c: Temperature at the horizon [C]; the ground straight below is 2 K warmer.
        drop_k: How much colder the zenith is [K].

    Returns:
        Temperatures [C], shape (n,).
    """
    z = np.asarray(directions, dtype=np.float64)[:, 2]
    return horizon_c - drop_k * _rise(z) + _GROUND_RISE_K * _rise(-z)


def sky_rgb(directions: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Pale haze at the horizon, blue above, grey green below: unit directions (n, 3) to colours (n, 3)."""
    z = np.asarray(directions, dtype=np.float64)[:, 2:]
    haze, blue, ground = (0.82, 0.86, 0.90), (0.26, 0.45, 0.80), (0.46, 0.48, 0.40)
    up, down = _rise(z), np.minimum(3.0 * _rise(-z), 1.0)
    colour = haze + np.subtract(blue, haze) * up + np.subtract(ground, haze) * down
    return np.clip(colour, 0.0, 1.0).astype(np.float32)


def room_rgb(directions: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Light grey walls, a little warmer to one side and darker below: unit directions (n, 3) to colours (n, 3)."""
    x, y, z = np.asarray(directions, dtype=np.float32).T
    return np.stack([0.74 + 0.04 * x + 0.06 * z, 0.73 + 0.07 * z, 0.72 + 0.03 * y + 0.08 * z], axis=1)


def _rise(z: FloatArray) -> FloatArray:
    """Height above the horizon, max(z, 0) with a smooth bend: (z + b)^2 / 4b within b of it, and 1 at the zenith."""
    b = _HORIZON_BLEND
    return np.where(z > b, z, np.square(np.maximum(z + b, 0.0)) / (4.0 * b))
