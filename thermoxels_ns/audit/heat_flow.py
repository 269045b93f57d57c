"""The published formulas: heat flow through a surface from its temperature, what a camera reads, and what is around.

Heat flows are densities, [W/m2], positive from inside to outside; temperatures are in kelvin; arguments broadcast.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.heat.effects import STEFAN_BOLTZMANN_W_M2K4
from thermoxels_ns.heat.sky import ground_view, sky_view

Values: TypeAlias = Any  # A number or an array

WIND_W_S_M3K = 3.8054  # Coefficient of the wind in the formulas of Albatici and Tonelli and of Dall'O, [W s / (m3 K)]


def fourth_power(values: Values) -> Values:
    """Raise to the fourth power, ten times as fast as ``values**4``."""
    return np.square(np.square(values))


def radiation_w_m2(emissivity: Values, surface_k: Values, surroundings_k: Values) -> Values:
    """Give the net radiation from a surface, eps sigma (Ts^4 - Trefl^4) (Fokaides and Kalogirou 2011)."""
    return emissivity * STEFAN_BOLTZMANN_W_M2K4 * (fourth_power(surface_k) - fourth_power(surroundings_k))


def albatici_tonelli_w_m2(
    emissivity: Values, wind_m_s: Values, surface_k: Values, air_k: Values, factor: Values = 1.0
) -> Values:
    """Give the flow outside, 5.67 eps ((Ts/100)^4 - (Te/100)^4) + 3.8054 v (Ts - Te) (Albatici and Tonelli 2010).

    `factor` multiplies convection.
    """
    radiation = 5.67 * emissivity * (fourth_power(surface_k / 100.0) - fourth_power(air_k / 100.0))
    return radiation + factor * WIND_W_S_M3K * wind_m_s * (surface_k - air_k)


def dallo_w_m2(wind_m_s: Values, surface_k: Values, air_k: Values, factor: Values = 1.0) -> Values:
    """Give the flow outside, (5.8 + 3.8054 v) (Ts - Te) (Dall'O, Sarto and Panza 2013); `factor` multiplies it."""
    return factor * (5.8 + WIND_W_S_M3K * wind_m_s) * (surface_k - air_k)


def madding_w_m2(
    emissivity: Values, surface_k: Values, reflected_k: Values, air_k: Values, factor: Values = 1.0
) -> Values:
    """Give the flow inside, 4 eps sigma Tm^3 (Trefl - Ts) + 1.31 (Ti - Ts)^(4/3) (Madding 2008).

    Tm is the mean of Trefl and Ts. Where the surface is warmer than the air, convection changes its sign. `factor`
    multiplies convection.
    """
    mean = 0.5 * (reflected_k + surface_k)
    radiation = 4.0 * emissivity * STEFAN_BOLTZMANN_W_M2K4 * mean**3 * (reflected_k - surface_k)
    colder = air_k - surface_k
    return radiation + factor * 1.31 * colder * np.cbrt(np.abs(colder))


def surface_temperature_k(
    reading_k: Values, emissivity: Values, surroundings_k4: Values, set_emissivity: Values, set_reflected_k: Values
) -> Values:
    """Give the temperature of a surface, [K], from a camera's reading of it.

    The camera took eps_set T_read^4 + (1 - eps_set) T_set^4 for what arrives; eps Ts^4 + (1 - eps) T_surr^4 is what
    arrives. The law of total radiation stands for the camera's band.

    Args:
        reading_k: What the camera says, [K].
        emissivity: Of the surface, above 0, at most 1.
        surroundings_k4: Fourth power of the radiant temperature of what it reflects, [K^4].
        set_emissivity: What the camera was set to.
        set_reflected_k: Reflected temperature that the camera was set to, [K].

    >>> round(float(surface_temperature_k(280.0, 0.9, 260.0**4, 1.0, 0.0)), 3)
    281.974
    """
    arrives = set_emissivity * fourth_power(reading_k) + (1.0 - set_emissivity) * fourth_power(set_reflected_k)
    emitted = (arrives - (1.0 - emissivity) * surroundings_k4) / emissivity
    return np.sqrt(np.sqrt(np.maximum(emitted, 1.0)))


def reading_k(
    surface_k: Values, emissivity: Values, surroundings_k4: Values, set_emissivity: Values, set_reflected_k: Values
) -> Values:
    """Give a camera's reading of a surface, [K]: the inverse of `surface_temperature_k`, with the same arguments."""
    arrives = emissivity * fourth_power(surface_k) + (1.0 - emissivity) * surroundings_k4
    taken_for = (arrives - (1.0 - set_emissivity) * fourth_power(set_reflected_k)) / set_emissivity
    return np.sqrt(np.sqrt(np.maximum(taken_for, 1.0)))


def temperature_factor(resistance_to_outside_m2k_w: Values, inside_resistance_m2k_w: float) -> Values:
    """Give the temperature factor of an inner surface, f_Rsi = R / (R + Rsi) (ISO 13788).

    `resistance_to_outside_m2k_w` is that between the surface and the air outside, (Ts - Te) / q.
    """
    return resistance_to_outside_m2k_w / (resistance_to_outside_m2k_w + inside_resistance_m2k_w)


def sky_emissivity(dew_point_c: npt.ArrayLike, cloud: npt.ArrayLike) -> FloatArray:
    """Give the emissivity of the sky for the temperature of the air at the ground.

    eps_sky = (0.787 + 0.764 ln(T_dp / 273)) (1 + 0.0224 N - 0.0035 N^2 + 0.00028 N^3), T_dp in kelvin, N in tenths
    (EnergyPlus Engineering Reference, "Sky Radiation Modeling"; Clark and Allen 1978, Walton 1983).

    Args:
        dew_point_c: Dew point of the air, [degrees Celsius].
        cloud: Share of the sky that is covered, 0 to 1.

    >>> round(float(sky_emissivity(283.0 - 273.15, 0.0)), 4)
    0.8145
    """
    tenths = 10.0 * np.asarray(cloud, dtype=np.float64)
    clear = 0.787 + 0.764 * np.log((np.asarray(dew_point_c, dtype=np.float64) + 273.15) / 273.0)
    return clear * (1.0 + 0.0224 * tenths - 0.0035 * tenths**2 + 0.00028 * tenths**3)


def view_shares(normals: FloatArray, up: tuple[float, float, float]) -> FloatArray:
    """Give the shares of a surface's view that are sky, air near the horizon, and ground, (k, 3); rows add up to 1.

    F_ground = (1 - cos tilt) / 2; of the rest, b = sqrt((1 + cos tilt) / 2) is sky and 1 - b air near the horizon,
    which is about as warm as that at the ground (EnergyPlus Engineering Reference, "External Longwave Radiation";
    Walton 1983). A wall sees 0.354 sky, 0.146 horizon and 0.5 ground.

    Args:
        normals: Outward unit normals, shape (k, 3).
        up: Unit vector that points up.
    """
    above, below = sky_view(normals, up), ground_view(normals, up)
    sky = above * np.sqrt(above)
    return np.stack([sky, above - sky, below], axis=1)
