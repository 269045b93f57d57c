"""Heat transfer coefficients of surfaces in air: by ISO 6946, and that of the original Thermoxels code.

ISO 6946 tells three directions of the heat flow apart, because warm air rises; "horizontal" is up to 30 degrees off.
Combined coefficients, 1 / Rsi and 1 / Rse, hold convection and radiation between surfaces of emissivity 0.9; separate
ones are convection alone, to which radiation is added.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K, celsius_to_kelvin
from thermoxels_ns.fem.quantities import Bounds, Places, Varying
from thermoxels_ns.heat.effects import STEFAN_BOLTZMANN_W_M2K4

HeatDirection: TypeAlias = Literal["up", "horizontal", "down"]
"""Where heat flows to."""
HeatFlow: TypeAlias = Literal["into-body", "out-of-body"]
"""Into the body: the air is warmer than the surface, as in a heated room; out of it: the air is colder."""

INSIDE_RESISTANCE_M2K_W: Mapping[HeatDirection, float] = MappingProxyType(
    {"up": 0.10, "horizontal": 0.13, "down": 0.17}
)
"""Rsi, resistance between a room and its surfaces, [m2 K / W] (ISO 6946)."""
OUTSIDE_RESISTANCE_M2K_W = 0.04
"""Rse, resistance between a surface and the open air, [m2 K / W] (ISO 6946), for all directions."""
INSIDE_CONVECTION_W_M2K: Mapping[HeatDirection, float] = MappingProxyType({"up": 5.0, "horizontal": 2.5, "down": 0.7})
"""hci, convection alone inside, [W / (m2 K)] (ISO 6946)."""

_DIRECTIONS: tuple[HeatDirection, ...] = ("up", "horizontal", "down")
_HORIZONTAL = 0.5 + 1e-9  # sine of 30 degrees, which is horizontal whatever its rounding
_WIND = Bounds("wind_m_s", "m/s", 0.0)
_EMISSIVITY = Bounds("emissivity", "1", 0.0, 1.0)
_MEAN = Bounds("mean_c", "degrees Celsius", -ZERO_CELSIUS_K)


def outside_combined() -> float:
    """Coefficient of outside surfaces, convection and radiation together, 1 / Rse, [W / (m2 K)].

    >>> outside_combined()
    25.0
    """
    return 1.0 / OUTSIDE_RESISTANCE_M2K_W


def outside_convection(wind_m_s: float) -> float:
    """Convection alone of outside surfaces, hce = 4 + 4 v, [W / (m2 K)] (ISO 6946).

    Args:
        wind_m_s: Wind speed beside the surface, [m / s], at least 0.

    Raises:
        HeatError: It is out of range.
    """
    return 4.0 + 4.0 * float(_WIND.check(wind_m_s))


def thermoxels_original(wind_m_s: float) -> float:
    """Convection alone of outside surfaces, h = 18.6 v^0.605, [W / (m2 K)], as in the original Thermoxels code.

    It is 0 in calm air, and about twice the value of ISO 6946 in wind.

    Args:
        wind_m_s: Wind speed, [m / s], at least 0.

    Raises:
        HeatError: It is out of range.
    """
    return 18.6 * float(_WIND.check(wind_m_s)) ** 0.605


def radiative_coefficient(mean_c: float, emissivity: float) -> float:
    """Radiation made linear, hr = 4 eps sigma Tm^3, [W / (m2 K)] (ISO 6946).

    Args:
        mean_c: Mean of the temperatures of the surface and of what it faces, [degrees Celsius].
        emissivity: Emissivity of the surface, 0 to 1.

    Raises:
        HeatError: A number is out of range.

    >>> round(radiative_coefficient(10.0, 1.0), 2)
    5.15
    """
    kelvin = celsius_to_kelvin(float(_MEAN.check(mean_c)))
    return 4.0 * float(_EMISSIVITY.check(emissivity)) * STEFAN_BOLTZMANN_W_M2K4 * kelvin**3


def inside_combined(heat_flow: HeatFlow = "into-body") -> Varying:
    """Coefficient of inside surfaces by orientation, convection and radiation together, 1 / Rsi, [W / (m2 K)].

    Args:
        heat_flow: Whether heat flows from the room into the body, or out of the body.
    """
    return by_orientation({key: 1.0 / value for key, value in INSIDE_RESISTANCE_M2K_W.items()}, heat_flow)


def inside_convection(heat_flow: HeatFlow = "into-body") -> Varying:
    """Convection alone of inside surfaces by orientation, hci, [W / (m2 K)].

    Args:
        heat_flow: Whether heat flows from the room into the body, or out of the body.
    """
    return by_orientation(INSIDE_CONVECTION_W_M2K, heat_flow)


def inside_separate(mean_c: float, emissivity: float, heat_flow: HeatFlow = "into-body") -> Varying:
    """Convection of inside surfaces by orientation plus radiation made linear, hci + hr, [W / (m2 K)].

    Args:
        mean_c: Mean of the temperatures of the surface and of the room, [degrees Celsius].
        emissivity: Emissivity of the surface, 0 to 1.
        heat_flow: Whether heat flows from the room into the body, or out of the body.

    Raises:
        HeatError: A number is out of range.
    """
    radiative = radiative_coefficient(mean_c, emissivity)
    return by_orientation({key: value + radiative for key, value in INSIDE_CONVECTION_W_M2K.items()}, heat_flow)


def by_orientation(coefficients: Mapping[HeatDirection, float], heat_flow: HeatFlow = "into-body") -> Varying:
    """Make a coefficient that depends on where a surface faces, for `Convection.coefficient_w_m2k`.

    Args:
        coefficients: One for each direction of the heat flow, [W / (m2 K)].
        heat_flow: Whether heat flows from the air into the body, or out of the body.

    Raises:
        HeatError: A direction is missing, or `heat_flow` is neither.
    """
    if set(coefficients) != set(_DIRECTIONS) or heat_flow not in ("into-body", "out-of-body"):
        raise HeatError(
            "surface coefficients: expected one for each of up, horizontal and down, and a heat flow into-body or "
            f"out-of-body, got {', '.join(coefficients)} and {heat_flow!r}. Correct the call."
        )
    table = np.array([coefficients[direction] for direction in _DIRECTIONS])
    return Varying(lambda places, time_s: table[_direction_index(places, heat_flow)], in_time=False)


def _direction_index(places: Places, heat_flow: HeatFlow) -> npt.NDArray[np.int64]:
    """Index into `_DIRECTIONS` of the direction in which heat crosses each facet."""
    outward = places.normals @ np.array(places.up)
    upward = -outward if heat_flow == "into-body" else outward
    return np.where(upward > _HORIZONTAL, 0, np.where(upward < -_HORIZONTAL, 2, 1)).astype(np.int64)
