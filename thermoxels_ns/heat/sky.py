"""Long-wave exchange with sky and ground, the position of the sun, and the sunlight that reaches a facet."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import partial

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import celsius_to_kelvin, kelvin_to_celsius
from thermoxels_ns.fem.problem import Quantity, Varying
from thermoxels_ns.fem.selection import Places

Vector = tuple[float, float, float]

SOLAR_CONSTANT_W_M2 = 1353.0
"""Sunlight above the atmosphere at the sun's mean distance, [W / m2], as in Meinel's fit; the modern value is 1361."""

_EPOCH = datetime(2000, 1, 1, 12, tzinfo=timezone.utc)  # Day 0 of the formulae for the sun's position


def swinbank_sky_c(air_c: float) -> float:
    """Return the temperature of a clear sky, [degrees Celsius]: T_sky = 0.0552 T_air^1.5 in kelvin (Swinbank 1963).

    A cloudy sky is nearly as warm as the air.

    >>> round(swinbank_sky_c(20.0), 2)
    3.91
    """
    return kelvin_to_celsius(0.0552 * celsius_to_kelvin(air_c) ** 1.5)


def sky_view(normals: FloatArray, up: Vector) -> FloatArray:
    """Return the view factor of the sky, (1 + cos tilt) / 2, shape (k,), for outward unit normals (k, 3).

    >>> sky_view(np.array([[0, 0, 1.0], [1, 0, 0], [0, 0, -1]]), (0.0, 0.0, 1.0)).tolist()
    [1.0, 0.5, 0.0]
    """
    return np.clip(0.5 * (1.0 + normals @ np.array(up)), 0.0, 1.0)


def ground_view(normals: FloatArray, up: Vector) -> FloatArray:
    """Return the view factor of the ground, (1 - cos tilt) / 2, shape (k,), which is 1 - `sky_view`."""
    return 1.0 - sky_view(normals, up)


def outdoor_radiation(
    emissivity: float, *, sky_c: Quantity | None = None, ground_c: float | None = None
) -> tuple[Quantity, Quantity]:
    """Return the arguments `emissivity` and `surroundings_c` of a `Radiation` to the sky, the ground or both.

    With both, T_s^4 = F_sky T_sky^4 + F_ground T_ground^4 with the view factors F, so that one effect equals the sum of
    two. With sky or ground alone, the emissivity is multiplied by its F; the rest of the view exchanges no heat. At
    least one of `sky_c` and `ground_c`, [degrees Celsius], must be given.
    """
    if sky_c is not None and ground_c is not None:
        mean = partial(_surroundings_c, sky_c, ground_c)
        return emissivity, replace(sky_c, function=mean) if isinstance(sky_c, Varying) else Varying(mean, in_time=False)
    if sky_c is not None:
        return Varying(partial(_seen, emissivity, sky_view), in_time=False), sky_c
    assert ground_c is not None, "one of the two is given"
    return Varying(partial(_seen, emissivity, ground_view), in_time=False), ground_c


# Functions of places and time are partial calls of these: a heat run that holds them can be pickled.
def _surroundings_c(sky_c: Quantity, ground_c: float, places: Places, time_s: float) -> FloatArray:
    seen = sky_view(places.normals, places.up)
    there_c = np.asarray(sky_c.function(places, time_s) if isinstance(sky_c, Varying) else sky_c, dtype=np.float64)
    fourth = seen * celsius_to_kelvin(there_c) ** 4 + (1.0 - seen) * celsius_to_kelvin(ground_c) ** 4
    return kelvin_to_celsius(fourth**0.25)


def _seen(emissivity: float, view: Callable[[FloatArray, Vector], FloatArray], places: Places, _: float) -> FloatArray:
    return emissivity * view(places.normals, places.up)


@dataclass(frozen=True)
class SunPosition:
    """The position of the sun as seen from a place on the ground."""

    azimuth_deg: float  # Direction along the horizon, clockwise from north, [degrees], 0 to 360
    elevation_deg: float
    """Elevation over the horizon, [degrees], without refraction, which lifts the sun by 0.5 degrees at the horizon and
    by 0.1 degrees at an elevation of 10 degrees."""
    distance_au: float  # Distance, [astronomical units]


@dataclass(frozen=True)
class Sunlight:
    """The strength of the sunlight, direct and diffuse."""

    direct_w_m2: float  # Direct light on a surface that faces the sun, [W / m2], at least 0
    diffuse_w_m2: float  # Diffuse light from the sky on a surface that faces up, [W / m2], at least 0


def sun_position(moment: datetime, latitude_deg: float, longitude_deg: float) -> SunPosition:
    """Return the sun's position at a moment, which must have a time zone, to 0.02 degrees from 1800 to 2200.

    The source is the low-precision formulae of the Astronomical Almanac (US Naval Observatory). Latitude is positive
    to the north, longitude to the east.

    >>> noon = sun_position(datetime(2025, 6, 21, 12, 2, tzinfo=timezone.utc), 47.0, 0.0)
    >>> round(noon.azimuth_deg), round(noon.elevation_deg, 1)
    (180, 66.4)
    """
    days = (moment - _EPOCH).total_seconds() / 86400.0
    anomaly = math.radians(357.529 + 0.98560028 * days)
    ecliptic_longitude = 280.459 + 0.98564736 * days + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2.0 * anomaly)
    along, obliquity = math.radians(ecliptic_longitude), math.radians(23.439 - 0.00000036 * days)
    right_ascension = math.atan2(math.cos(obliquity) * math.sin(along), math.cos(along))
    declination = math.asin(math.sin(obliquity) * math.sin(along))
    distance_au = 1.00014 - 0.01671 * math.cos(anomaly) - 0.00014 * math.cos(2.0 * anomaly)
    sidereal_deg = 280.460625 + 360.98564736578 * days  # at Greenwich
    hour = math.radians((sidereal_deg + longitude_deg - math.degrees(right_ascension)) % 360.0)
    latitude = math.radians(latitude_deg)
    east = -math.cos(declination) * math.sin(hour)
    north = math.sin(declination) * math.cos(latitude) - math.cos(declination) * math.cos(hour) * math.sin(latitude)
    height = math.sin(declination) * math.sin(latitude) + math.cos(declination) * math.cos(hour) * math.cos(latitude)
    azimuth = math.degrees(math.atan2(east, north)) % 360.0
    return SunPosition(azimuth, math.degrees(math.atan2(height, math.hypot(east, north))), distance_au)


def towards_sun(position: SunPosition, up: Vector, north: Vector) -> Vector:
    """Return the unit vector to the sun in the coordinates of `up` and `north`.

    The part of `north` along `up` is removed first. Raises `HeatError` if `up` and `north` are parallel.
    """
    upward, northward = (np.array(one) / np.linalg.norm(one) for one in (up, north))
    level = northward - (northward @ upward) * upward
    if float(np.linalg.norm(level)) < 1e-6:
        remedy = "Give north along the ground."
        raise HeatError("north", expected="a direction other than up", got=list(north), remedy=remedy)
    level /= np.linalg.norm(level)
    azimuth, elevation = math.radians(position.azimuth_deg), math.radians(position.elevation_deg)
    horizontal = math.cos(azimuth) * level + math.sin(azimuth) * np.cross(level, upward)
    x, y, z = math.cos(elevation) * horizontal + math.sin(elevation) * upward
    return float(x), float(y), float(z)


def air_mass(elevation_deg: float) -> float:
    """Return the relative optical air mass, which is 1 at the zenith, for 0 to 90 degrees (Kasten and Young 1989)."""
    return 1.0 / (math.sin(math.radians(elevation_deg)) + 0.50572 * (elevation_deg + 6.07995) ** -1.6364)


def meinel_clear_sky(elevation_deg: float, distance_au: float = 1.0) -> Sunlight:
    """Return the sunlight under a clear sky at sea level, to about 10 %; 0 if the sun is below the horizon.

    Direct light is E0 * 0.7^(AM^0.678) with the air mass AM (Meinel and Meinel 1976). Diffuse light is E0 sin(h)
    (0.271 - 0.294 tau) with the elevation h and the transmitted share tau of direct light (Liu and Jordan 1960). E0 is
    `SOLAR_CONSTANT_W_M2` / `distance_au`^2.
    """
    if elevation_deg <= 0.0:
        return Sunlight(0.0, 0.0)
    above_air = SOLAR_CONSTANT_W_M2 / distance_au**2
    transmitted = 0.7 ** (air_mass(elevation_deg) ** 0.678)
    diffuse = above_air * math.sin(math.radians(elevation_deg)) * (0.271 - 0.294 * transmitted)
    return Sunlight(above_air * transmitted, diffuse)


def facet_irradiance(
    normals: FloatArray, up: Vector, towards: Vector, sunlight: Sunlight, ground_reflectance: float = 0.0
) -> FloatArray:
    """Return the irradiance of facets by the sun, shape (k,), [W / m2] of the facet; no facet shades another.

    Direct light is multiplied by the cosine between normal and sun, diffuse light by (1 + cos tilt) / 2, and light from
    the ground by (1 - cos tilt) / 2 (Liu and Jordan 1963: sky and ground are evenly bright). All values are 0 if the
    sun is below the horizon. Outward `normals` (k, 3), `up` and `towards` (the sun) must be unit vectors.
    """
    height = float(np.dot(up, towards))
    if height <= 0.0:
        return np.zeros(len(normals))
    direct = sunlight.direct_w_m2 * np.maximum(normals @ np.array(towards), 0.0)
    diffuse = sunlight.diffuse_w_m2 * sky_view(normals, up)
    on_ground = sunlight.direct_w_m2 * height + sunlight.diffuse_w_m2
    return direct + diffuse + ground_reflectance * on_ground * ground_view(normals, up)
