"""Heat transfer coefficients of surfaces in air, by ISO 6946 or the original code."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.fem.quantities import Places, Varying
from thermoxels_ns.heat.effects import STEFAN_BOLTZMANN_W_M2K4

HeatDirection: TypeAlias = Literal["up", "horizontal", "down"]
"""Where heat flows to."""
HeatFlow: TypeAlias = Literal["into-body", "out-of-body"]
"""Into the body: the air is warmer than the surface, as in a heated room; out of it: the air is colder."""
InsideCoefficient = Literal["iso-6946-combined", "iso-6946-separate", "iso-6946-convection"]
OutsideCoefficient = Literal["iso-6946-combined", "iso-6946-separate", "iso-6946-convection", "thermoxels-original"]

INSIDE_RESISTANCE_M2K_W: Mapping[HeatDirection, float] = MappingProxyType(
    {"up": 0.10, "horizontal": 0.13, "down": 0.17}
)
"""Rsi, resistance between a room and its surfaces, [m2 K / W] (ISO 6946)."""
OUTSIDE_RESISTANCE_M2K_W = 0.04
"""Rse, resistance between a surface and the open air, [m2 K / W] (ISO 6946), for all directions."""
INSIDE_CONVECTION_W_M2K: Mapping[HeatDirection, float] = MappingProxyType({"up": 5.0, "horizontal": 2.5, "down": 0.7})
"""hci, convection alone inside, [W / (m2 K)] (ISO 6946)."""

_HORIZONTAL = 0.5 + 1e-9  # sine of 30 degrees, which is horizontal whatever its rounding


def inside_coefficient(
    name: InsideCoefficient, heat_flow: HeatFlow = "into-body", mean_c: float = 20.0, emissivity: float = 0.9
) -> Varying:
    """Make the coefficient of surfaces in a room by their orientation, for `Convection.coefficient_w_m2k`.

    ISO 6946 tells three directions of the heat flow apart, because warm air rises; "horizontal" is up to 30 degrees
    off. Combined coefficients hold convection and radiation between surfaces of emissivity 0.9; separate ones are
    convection alone, to which radiation is added.

    Args:
        name: 1 / Rsi (combined), hci + hr (separate) or hci (convection).
        heat_flow: Whether heat flows from the room into the body, or out of the body.
        mean_c: Mean of the temperatures of the surface and of the room, for hr, [degrees Celsius].
        emissivity: Emissivity of the surface, for hr, 0 to 1.
    """
    directions: tuple[HeatDirection, ...] = ("up", "horizontal", "down")
    if name == "iso-6946-combined":
        table = np.array([1.0 / INSIDE_RESISTANCE_M2K_W[direction] for direction in directions])
    else:
        radiative = radiative_coefficient(mean_c, emissivity) if name == "iso-6946-separate" else 0.0
        table = np.array([INSIDE_CONVECTION_W_M2K[direction] + radiative for direction in directions])

    def by_orientation(places: Places, _: float) -> npt.NDArray[np.float64]:
        outward = places.normals @ np.array(places.up)
        upward = -outward if heat_flow == "into-body" else outward
        return table[np.where(upward > _HORIZONTAL, 0, np.where(upward < -_HORIZONTAL, 2, 1))]

    return Varying(by_orientation, in_time=False)


def outside_coefficient(
    name: OutsideCoefficient, wind_m_s: float = 4.0, mean_c: float = 0.0, emissivity: float = 0.9
) -> float:
    """Give the coefficient of surfaces in the open air, [W / (m2 K)].

    Args:
        name: 1 / Rse (combined), 4 + 4 v + hr (separate), 4 + 4 v (convection), or 18.6 v^0.605 of the original
            Thermoxels code, which is 0 in calm air and about twice the value of ISO 6946 in wind.
        wind_m_s: Wind speed v beside the surface, [m / s].
        mean_c: Mean of the temperatures of the surface and of its surroundings, for hr, [degrees Celsius].
        emissivity: Emissivity of the surface, for hr, 0 to 1.

    >>> outside_coefficient("iso-6946-combined")
    25.0
    """
    if name == "iso-6946-combined":
        return 1.0 / OUTSIDE_RESISTANCE_M2K_W
    if name == "thermoxels-original":
        return 18.6 * wind_m_s**0.605
    convection = 4.0 + 4.0 * wind_m_s
    return convection + radiative_coefficient(mean_c, emissivity) if name == "iso-6946-separate" else convection


def radiative_coefficient(mean_c: float, emissivity: float) -> float:
    """Radiation made linear, hr = 4 eps sigma Tm^3, [W / (m2 K)] (ISO 6946).

    >>> round(radiative_coefficient(10.0, 1.0), 2)
    5.15
    """
    return 4.0 * emissivity * STEFAN_BOLTZMANN_W_M2K4 * celsius_to_kelvin(mean_c) ** 3
