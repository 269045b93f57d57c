"""Published formulas for the heat flow through a surface, the reading of a camera, and the view of the surroundings.

Heat flows are densities, [W/m2], positive from inside to outside unless stated otherwise; temperatures are in kelvin
unless the name ends in `_c`; arguments broadcast."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.heat.effects import STEFAN_BOLTZMANN_W_M2K4
from thermoxels_ns.heat.scene_fields import INSIDE_CONVECTION_W_M2K, INSIDE_RESISTANCE_M2K_W, OUTSIDE_RESISTANCE_M2K_W

Values: TypeAlias = Any  # A number or an array

WIND_W_S_M3K = 3.8054  # Coefficient of the wind in the formulas of Albatici and Tonelli and of Dall'O, [W s / (m3 K)]


def fourth_power(values: Values) -> Values:
    """Return the fourth power of values, ten times as fast as ``values**4``."""
    return np.square(np.square(values))


def net_radiation_w_m2(emissivity: Values, surface_k: Values, surroundings_k4: Values) -> Values:
    """Return the net radiation that leaves a surface, eps sigma (Ts^4 - Trefl^4), by Fokaides and Kalogirou (2011).

    `surroundings_k4` is the fourth power of the temperature of the surroundings, [K^4].
    """
    return emissivity * STEFAN_BOLTZMANN_W_M2K4 * (fourth_power(surface_k) - surroundings_k4)


def natural_w_m2k(warmer_k: Values, upward: Values) -> Values:
    """Return the coefficient of natural convection, [W/(m2 K)], of a surface `warmer_k` (dT) warmer than the air.

    9.482 |dT|^(1/3) / (7.238 - |u|) where warm air rises from the surface or cold air sinks from it, and 1.810
    |dT|^(1/3) / (1.382 + |u|) elsewhere; both are 1.31 |dT|^(1/3) for walls (Walton 1983, TARP; EnergyPlus Engineering
    Reference, "Outside Convection"). `upward`, u, is the upward part of the outward unit normal.

    >>> np.round(natural_w_m2k(8.0, np.array([0.0, 1.0, -1.0])), 2).tolist()
    [2.62, 3.04, 1.52]
    """
    free, held = 9.482 / (7.238 - np.abs(upward)), 1.810 / (1.382 + np.abs(upward))
    return np.cbrt(np.abs(warmer_k)) * np.where(np.asarray(warmer_k) * upward > 0.0, free, held)


class FilmFormula(NamedTuple):
    """A published formula for the heat exchange between a surface and the air."""

    weight: float  # Relative frequency with which the balance draws the formula if the conditions name no weights
    w_m2k: Callable[[Values, Values, Values], Values]
    """Function that returns the coefficient, [W/(m2 K)], from wind speed [m/s], surface minus air temperature [K], and
    the upward part of the surface's outward unit normal."""
    radiates: Literal["seen", "air", "included"] = "seen"
    """Radiation is added to what the surface sees, added to surroundings at air temperature, or in the coefficient."""


def _mowitt(factor: float, power: float) -> FilmFormula:
    return FilmFormula(0.5, lambda v, dt, up: np.hypot(0.84 * np.cbrt(np.abs(dt)), factor * np.power(v, power)))


def _mixed(factor: float, power: float) -> FilmFormula:
    return FilmFormula(0.5, lambda v, dt, up: natural_w_m2k(dt, up) + factor * np.power(v, power))


_SPARROW = 2.537 * 1.67 * 0.5**0.5  # For walls of brick with a perimeter over area of 0.5 per metre
_SLANT = 0.5 + 1e-9  # Sine of 30 degrees, up to which a heat flow counts as horizontal (ISO 6946)
_COMBINED = {direction: 1.0 / resistance for direction, resistance in INSIDE_RESISTANCE_M2K_W.items()}


def _by_direction(w_m2k: Mapping[Any, float]) -> Callable[[Values, Values, Values], Values]:
    """Return a formula that takes `w_m2k` by the direction of a room's heat flow: "up" for surfaces facing down."""
    return lambda v, dt, up: np.select([up < -_SLANT, up > _SLANT], [w_m2k["up"], w_m2k["down"]], w_m2k["horizontal"])


FILMS: Mapping[str, Mapping[str, FilmFormula]] = {
    "outside": {
        "iso-6946": FilmFormula(1.0, lambda v, dt, up: 4.0 + 4.0 * v),
        "jurges": FilmFormula(0.0, lambda v, dt, up: 5.8 + 3.94 * v),
        "mcadams": FilmFormula(0.0, lambda v, dt, up: 5.7 + 3.8 * v),
        "watmuff": FilmFormula(1.0, lambda v, dt, up: 2.8 + 3.0 * v),
        "mowitt-windward": _mowitt(3.26, 0.89),
        "mowitt-leeward": _mowitt(3.55, 0.617),
        "tarp-windward": _mixed(_SPARROW, 0.5),
        "tarp-leeward": _mixed(0.5 * _SPARROW, 0.5),
        "emmel-windward": _mixed(5.15, 0.81),
        "emmel-leeward": _mixed(3.54, 0.76),
        "iso-6946-combined": FilmFormula(0.0, lambda v, dt, up: 1.0 / OUTSIDE_RESISTANCE_M2K_W, "included"),
        "albatici-tonelli": FilmFormula(0.0, lambda v, dt, up: WIND_W_S_M3K * v, "air"),
        "dallo": FilmFormula(0.0, lambda v, dt, up: 5.8 + WIND_W_S_M3K * v, "included"),
    },
    "inside": {
        "iso-6946": FilmFormula(1.0, _by_direction(INSIDE_CONVECTION_W_M2K)),
        "walton": FilmFormula(1.0, lambda v, dt, up: natural_w_m2k(dt, up)),
        "khalifa": FilmFormula(
            1.0,
            lambda v, dt, up: np.where(np.abs(up) > _SLANT, natural_w_m2k(dt, up), 2.30 * np.power(np.abs(dt), 0.24)),
        ),
        "madding": FilmFormula(0.0, lambda v, dt, up: 1.31 * np.cbrt(np.abs(dt))),
        "iso-6946-combined": FilmFormula(0.0, _by_direction(_COMBINED), "included"),
    },
}
"""Formulas by the side of the surface.

Outside, with the wind v: iso-6946, 4 + 4 v (ISO 6946, annex C); jurges, 5.8 + 3.94 v (Nusselt and Juerges 1922) and
mcadams, 5.7 + 3.8 v (McAdams 1954), both from one wind tunnel; both contain radiation and free convection, and are
drawn only if weights name them; watmuff, 2.8 + 3 v, the same without radiation and free convection (Watmuff, Charters
and Proctor 1977); mowitt, sqrt((0.84 dT^(1/3))^2 + (3.26 v^0.89)^2) windward, with 3.55 v^0.617 leeward (Yazdanian and
Klems 1994, measured on windows; coefficients by Booten and others 2012, as in EnergyPlus); tarp, `natural_w_m2k` +
2.537 Rf sqrt(v P/A), leeward with half of the second term (Sparrow and others 1979, Walton 1983), Rf 1.67 for brick,
P/A 0.5 per metre; emmel, `natural_w_m2k` + 5.15 v^0.81 windward, 3.54 v^0.76 leeward (Emmel, Abadie and Mendes 2007,
walls; sum as in EnergyPlus). Windward and leeward formulas have half the weight, as surveys rarely know the side. v of
ISO, Juerges, McAdams, Watmuff is the wind beside the surface, v of the others the wind that comes up to the building.
Inside: iso-6946, hci by the direction of the heat flow; walton, `natural_w_m2k`; khalifa, 2.30 dT^0.24 for walls
without a heater (Khalifa and Marshall 1990), elsewhere as walton; madding, 1.31 dT^(1/3) for all surfaces (Madding
2008), drawn only if weights name it.
Simple models assume that all that a surface sees is as warm as the air: iso-6946-combined, 1 / Rse, and inside 1 / Rsi
by the direction of the heat flow; albatici-tonelli, 3.8054 v beside radiation to the air (Albatici and Tonelli 2010);
dallo, 5.8 + 3.8054 v (Dall'O, Sarto and Panza 2013)."""


def simple_models(side: str) -> tuple[str, ...]:
    """Return the names of the simple models in `FILMS`, which the balance never draws; `side`: outside or inside."""
    return tuple(name for name, film in FILMS[side].items() if film.radiates != "seen")


def surface_temperature_k(
    reading_k: Values, emissivity: Values, surroundings_k4: Values, set_emissivity: Values, set_reflected_k: Values
) -> Values:
    """Return the temperature of a surface, [K], from a camera's reading of the surface.

    Ts solves eps Ts^4 + (1 - eps) T_surr^4 = eps_set T_read^4 + (1 - eps_set) T_set^4: the radiation from the surface
    equals that which the camera assumes. Total radiation stands in for the radiation in the camera's band.

    Args:
        reading_k: Temperature that the camera reads, [K].
        emissivity: True emissivity of the surface, above 0, at most 1.
        surroundings_k4: Fourth power of the radiant temperature of the surroundings, [K^4].
        set_emissivity: Emissivity that the camera was set to.
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
    """Return a camera's reading, [K], of a surface of temperature `surface_k`; inverse of `surface_temperature_k`."""
    arrives = emissivity * fourth_power(surface_k) + (1.0 - emissivity) * surroundings_k4
    taken_for = (arrives - (1.0 - set_emissivity) * fourth_power(set_reflected_k)) / set_emissivity
    return np.sqrt(np.sqrt(np.maximum(taken_for, 1.0)))


def temperature_factor(resistance_to_outside_m2k_w: Values, inside_resistance_m2k_w: float) -> Values:
    """Return f_Rsi = R / (R + Rsi) (ISO 13788); R = (Ts - Te) / q is the resistance from surface to outside air."""
    return resistance_to_outside_m2k_w / (resistance_to_outside_m2k_w + inside_resistance_m2k_w)


def sky_emissivity(dew_point_c: npt.ArrayLike, cloud: npt.ArrayLike) -> FloatArray:
    """Return the emissivity of a sky that radiates at the temperature of the air at the ground.

    eps_sky = (0.787 + 0.764 ln(T_dp / 273)) (1 + 0.0224 N - 0.0035 N^2 + 0.00028 N^3), T_dp in kelvin, N in tenths
    (EnergyPlus Engineering Reference, "Sky Radiation Modeling"; Clark and Allen 1978, Walton 1983). `dew_point_c` is
    that of the outside air; `cloud` is the share of the sky that clouds cover, 0 to 1.

    >>> round(float(sky_emissivity(283.0 - 273.15, 0.0)), 4)
    0.8145
    """
    tenths = 10.0 * np.asarray(cloud, dtype=np.float64)
    clear = 0.787 + 0.764 * np.log((np.asarray(dew_point_c, dtype=np.float64) + 273.15) / 273.0)
    return clear * (1.0 + 0.0224 * tenths - 0.0035 * tenths**2 + 0.00028 * tenths**3)


def view_shares(upward: FloatArray) -> FloatArray:
    """Return the view factors of sky, air near the horizon, and ground from a surface, (k, 3); rows add up to 1.

    F_ground = (1 - cos tilt) / 2. Of the rest, a share b = sqrt((1 + cos tilt) / 2) is sky, and 1 - b is air near the
    horizon, about as warm as the air at the ground (EnergyPlus Engineering Reference, "External Longwave Radiation";
    Walton 1983). A wall sees 0.354 sky, 0.146 horizon and 0.5 ground. `upward`, the cosine of the tilt, is the upward
    part of outward unit normals, shape (k,).
    """
    above = np.clip(0.5 * (1.0 + upward), 0.0, 1.0)
    sky = above * np.sqrt(above)
    return np.stack([sky, above - sky, 1.0 - above], axis=1)
