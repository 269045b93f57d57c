"""Long-wave exchange with the sky and the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.units import celsius_to_kelvin, kelvin_to_celsius
from thermoxels_ns.fem.quantities import Places, Quantity, Varying

Vector = tuple[float, float, float]


def swinbank_sky_c(air_c: float) -> float:
    """Temperature of a clear sky from that of the air, T_sky = 0.0552 T_air^1.5 in kelvin (Swinbank 1963).

    A cloudy sky is nearly as warm as the air.

    >>> round(swinbank_sky_c(20.0), 2)
    3.91
    """
    return kelvin_to_celsius(0.0552 * celsius_to_kelvin(air_c) ** 1.5)


def sky_view(normals: npt.NDArray[np.float64], up: Vector) -> npt.NDArray[np.float64]:
    """Share of the view of surfaces that is sky, (1 + cos tilt) / 2, shape (k,); normals point out, shape (k, 3).

    >>> sky_view(np.array([[0, 0, 1.0], [1, 0, 0], [0, 0, -1]]), (0.0, 0.0, 1.0)).tolist()
    [1.0, 0.5, 0.0]
    """
    return np.clip(0.5 * (1.0 + normals @ np.array(up)), 0.0, 1.0)


def ground_view(normals: npt.NDArray[np.float64], up: Vector) -> npt.NDArray[np.float64]:
    """Share of the view of surfaces that is ground, (1 - cos tilt) / 2, shape (k,)."""
    return 1.0 - sky_view(normals, up)


def outdoor_radiation(
    emissivity: float, *, sky_c: Quantity | None = None, ground_c: float | None = None
) -> tuple[Quantity, Quantity]:
    """Make the emissivity and the surroundings of a `Radiation` to the sky, the ground or both, [degrees Celsius].

    With both, T_s^4 = F_sky T_sky^4 + F_ground T_ground^4: one effect that is exactly the sum of two. With one
    alone, the emissivity is multiplied by its view factor, and the rest of the view exchanges nothing.
    """
    if sky_c is not None and ground_c is not None:
        varying = sky_c if isinstance(sky_c, Varying) else Varying(lambda *_: sky_c, in_time=False)
        ground = celsius_to_kelvin(ground_c) ** 4

        def mean(places: Places, time_s: float) -> npt.NDArray[np.float64]:
            seen = sky_view(places.normals, places.up)
            sky = celsius_to_kelvin(np.asarray(varying.function(places, time_s), dtype=np.float64)) ** 4
            return kelvin_to_celsius((seen * sky + (1.0 - seen) * ground) ** 0.25)

        return emissivity, replace(varying, function=mean)
    if sky_c is not None:
        return Varying(lambda places, _: emissivity * sky_view(places.normals, places.up), in_time=False), sky_c
    assert ground_c is not None, "one of the two is given"
    return Varying(lambda places, _: emissivity * ground_view(places.normals, places.up), in_time=False), ground_c
