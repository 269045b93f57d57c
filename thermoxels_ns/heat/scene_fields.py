"""The sections of a heat scene, checked when they are made: air, surfaces, sky, ground and sun."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from datetime import timedelta
from functools import partial
from types import MappingProxyType
from typing import Annotated, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import AfterValidator, AwareDatetime, Field

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K, celsius_to_kelvin
from thermoxels_ns.core.yaml_records import raising, record
from thermoxels_ns.fem.problem import Quantity, Varying, tabulated
from thermoxels_ns.fem.selection import Places
from thermoxels_ns.heat.effects import (
    HOTTEST_C,
    STEFAN_BOLTZMANN_W_M2K4,
    AtLeastZero,
    Celsius,
    Convection,
    Fraction,
    Names,
)
from thermoxels_ns.heat.sky import Sunlight, Vector, facet_irradiance, meinel_clear_sky, sun_position, towards_sun
from thermoxels_ns.heat.weather_file import read_weather

HeatDirection: TypeAlias = Literal["up", "horizontal", "down"]  # Direction in which heat flows
HeatFlow: TypeAlias = Literal["into-body", "out-of-body"]
"""into-body: the air is warmer than the surface, as in a heated room; out-of-body: the air is colder."""
InsideCoefficient = Literal["iso-6946-combined", "iso-6946-separate", "iso-6946-convection"]
OutsideCoefficient = Literal["iso-6946-combined", "iso-6946-separate", "iso-6946-convection", "thermoxels-original"]

INSIDE_RESISTANCE_M2K_W: Mapping[HeatDirection, float] = MappingProxyType(
    {"up": 0.10, "horizontal": 0.13, "down": 0.17}
)
"""Rsi, film resistance between a room and its surfaces, by direction of the heat flow, [m2 K / W] (ISO 6946)."""
OUTSIDE_RESISTANCE_M2K_W = 0.04
"""Rse, film resistance between a surface and the open air, [m2 K / W] (ISO 6946), for all directions."""
INSIDE_CONVECTION_W_M2K: Mapping[HeatDirection, float] = MappingProxyType({"up": 5.0, "horizontal": 2.5, "down": 0.7})
"""hci, coefficient of convection alone in a room, by direction of the heat flow, [W / (m2 K)] (ISO 6946)."""

_SUN_RESOLUTION_S = 3600.0  # `Varying.resolution_s` of the moving sun, [s]: the sun moves by 15 degrees in this time
_HORIZONTAL = 0.5 + 1e-9  # Largest sine of a heat flow that counts as horizontal: 30 degrees, plus round-off


def _by_orientation(table: FloatArray, sign: float, places: Places, _: float) -> FloatArray:
    """Return the entry of `table` for heat that flows up, horizontally (within 30 degrees) or down, (k,) (ISO 6946).
    `sign` is 1 if heat flows out of the body at the places, and -1 if it flows in."""
    upward = sign * (places.normals @ np.array(places.up))
    return table[np.where(upward > _HORIZONTAL, 0, np.where(upward < -_HORIZONTAL, 2, 1))]


def radiative_coefficient(mean_c: float, emissivity: float) -> float:
    """Return the coefficient of linearised radiation at the temperature Tm, 4 eps sigma Tm^3, [W / (m2 K)] (ISO 6946).

    >>> round(radiative_coefficient(10.0, 1.0), 2)
    5.15
    """
    return 4.0 * emissivity * STEFAN_BOLTZMANN_W_M2K4 * celsius_to_kelvin(mean_c) ** 3


OUTSIDE = ("exterior-*",)  # Default patches of outside air, surfaces and sun
INSIDE = ("interior-*",)  # Default patches of the air inside

WITH_RADIATION = ("iso-6946-combined", "iso-6946-separate")  # Coefficients that include radiation


def _direction(vector: Vector) -> Vector:
    if not 0.0 < math.hypot(*vector) < math.inf:
        raise unclear("", "a direction", list(vector), "Give three numbers, such as [0, 1, 0].")
    return vector


Direction: TypeAlias = Annotated[Vector, AfterValidator(_direction)]


@record(HeatError)
class _Air:
    """Air with a constant temperature or a temperature series from a file; raises `HeatError` if the file is unfit."""

    air_c: Celsius  # Temperature of the air, [degrees Celsius], at least -273.15
    coefficient: OutsideCoefficient | None = None  # Name of a heat transfer coefficient, see the classes below
    coefficient_w_m2k: AtLeastZero | None = None  # The coefficient itself, [W / (m2 K)], instead of a named one
    emissivity: Fraction | None = field(default=None, kw_only=True)
    """Emissivity of the surfaces, 0 to 1; only iso-6946-separate needs it."""
    air_series: str | None = field(default=None, kw_only=True)
    """A weather file beside the scene: csv with hours (since the start) and outside_c or inside_c among its columns, or
    .epw. The temperature is interpolated linearly, and constant before the first and after the last line. Named
    coefficients still use the field `air_c`. A sky whose temperature follows the air also follows this series."""
    air_start: AwareDatetime | None = field(default=None, kw_only=True)
    """Date and time of the scene's start, with a time zone, for an .epw file; the year has no influence."""

    column: ClassVar[str] = "outside_c"  # Column of a weather file that holds the air's temperature

    def __post_init__(self) -> None:
        epw = self.air_series is not None and self.air_series.lower().endswith(".epw")
        if epw != (self.air_start is not None):
            remedy = (
                "Write air_start: 2026-01-15T06:00:00+01:00." if epw else "Remove it; hours of csv files count from 0."
            )
            got = "none" if epw else "a date"
            raise unclear("air_start", "a date beside an .epw file, and none beside others", got, remedy)
        check_one(coefficient=self.coefficient, coefficient_w_m2k=self.coefficient_w_m2k)
        separate = self.coefficient == "iso-6946-separate"
        check_only_if("emissivity", self.emissivity, separate, self.coefficient or "coefficient_w_m2k")
        _ = self.temperature  # raises `HeatError` for a file that cannot be read

    @property
    def temperature(self) -> Quantity:
        """Temperature of the air, [degrees Celsius], a number or a function of time."""
        if self.air_series is None:
            return self.air_c
        hours, air_c = self.series()
        if air_c.min() < -ZERO_CELSIUS_K or air_c.max() > HOTTEST_C:
            expected, got = (
                f"temperatures from {-ZERO_CELSIUS_K} to {HOTTEST_C:g} C",
                f"{air_c.min():g} to {air_c.max():g}",
            )
            raise unclear(f"air_series: {self.air_series}", expected, got, "Correct the file.")
        return tabulated(3600.0 * hours, air_c)

    def series(self) -> tuple[FloatArray, FloatArray]:
        """Return the hours since the start and the temperatures of `air_series`, (k,) each. Raises `HeatError` if the
        file cannot be read or lacks the column."""
        assert self.air_series is not None
        with raising(HeatError, "air_series: "):
            found = read_weather(self.air_series, self.air_start, any_year=True)
        if self.column not in found:
            expected, got = f"a column {self.column}", ", ".join(found)
            raise unclear(f"air_series: {self.air_series}", expected, got, "Add it to the file.")
        return found["hours"], found[self.column]


@record(HeatError)
class InsideAir(_Air):
    """The air of a room."""

    column: ClassVar[str] = "inside_c"
    coefficient: InsideCoefficient | None = None
    """Heat transfer coefficient by the orientation of each surface, after ISO 6946: iso-6946-combined (1 / Rsi,
    convection and radiation together), iso-6946-separate (hci + 4 eps sigma T^3 at the temperature of the air), or
    iso-6946-convection (hci alone, for scenes that name radiation themselves)."""
    heat_flow: HeatFlow = "into-body"
    """into-body: the air is warmer than the surfaces, as in a heated room, and loses most to the ceiling. out-of-body:
    the air is colder. Named coefficients depend on this field."""
    patches: Names = INSIDE  # Patches that the air acts on, by name or pattern

    def convection(self) -> Convection:
        """Return the effect of convection between the air of the room and the body."""
        if self.coefficient_w_m2k is not None:
            return Convection(self.patches, self.coefficient_w_m2k, self.temperature)
        radiative = radiative_coefficient(self.air_c, self.emissivity or 0.0)
        table = [convection + radiative for convection in INSIDE_CONVECTION_W_M2K.values()]
        if self.coefficient == "iso-6946-combined":
            table = [1.0 / resistance for resistance in INSIDE_RESISTANCE_M2K_W.values()]
        sign = -1.0 if self.heat_flow == "into-body" else 1.0
        by_orientation = Varying(partial(_by_orientation, np.array(table), sign), in_time=False)
        return Convection(self.patches, by_orientation, self.temperature)


@record(HeatError)
class OutsideAir(_Air):
    """The open air."""

    coefficient: OutsideCoefficient | None = None
    """Heat transfer coefficient: iso-6946-combined (1 / Rse = 25, convection and radiation together), iso-6946-separate
    (4 + 4 v + 4 eps sigma T^3 at the temperature of the air), iso-6946-convection (4 + 4 v alone, for scenes that
    name radiation themselves), or thermoxels-original (18.6 v^0.605, convection alone); v is the wind speed."""
    wind_m_s: AtLeastZero | None = None
    """Wind speed v beside the surfaces, [m / s]; needed by all named coefficients but iso-6946-combined."""
    patches: Names = OUTSIDE  # Patches that the air acts on, by name or pattern

    def __post_init__(self) -> None:
        super().__post_init__()
        windy = self.coefficient not in (None, "iso-6946-combined")
        check_only_if("wind_m_s", self.wind_m_s, windy, self.coefficient or "coefficient_w_m2k")

    def convection(self) -> Convection:
        """Return the effect of convection between the open air and the body."""
        wind, coefficient = self.wind_m_s or 0.0, self.coefficient_w_m2k
        if self.coefficient == "iso-6946-combined":
            coefficient = 1.0 / OUTSIDE_RESISTANCE_M2K_W
        elif self.coefficient == "thermoxels-original":
            coefficient = 18.6 * wind**0.605
        elif coefficient is None:
            coefficient = 4.0 + 4.0 * wind + radiative_coefficient(self.air_c, self.emissivity or 0.0)
        return Convection(self.patches, coefficient, self.temperature)


@record(HeatError)
class Surface:
    """Emissivity of patches for radiation to sky and ground, and absorptivity of patches for sunlight."""

    emissivity: Fraction | None = None
    """Emissivity for long-wave radiation, 0 to 1; None: the patches exchange no radiation with sky and ground."""
    absorptivity: Fraction | None = None  # Share of the sunlight that the patches absorb, 0 to 1; None: no sunlight
    patches: Names = OUTSIDE
    """Patches, by name or pattern; if several entries give a property of one patch, the last entry holds."""

    def __post_init__(self) -> None:
        if self.emissivity is None and self.absorptivity is None:
            raise unclear("", "emissivity, absorptivity or both", "neither", "Give one of them.")


@record(HeatError)
class Sky:
    """The sky to which surfaces radiate; exactly one of the three fields must be given."""

    temperature_c: Celsius | None = None  # Effective temperature of the sky, [degrees Celsius], at least -273.15
    model: Literal["swinbank"] | None = None  # swinbank: a clear sky, 0.0552 T^1.5 for T of the outside air in kelvin
    below_air_k: AtLeastZero | None = None
    """Temperature of the outside air minus that of the sky, [K]; 6 is common with some clouds (Whillier 1967)."""

    def __post_init__(self) -> None:
        check_one(temperature_c=self.temperature_c, model=self.model, below_air_k=self.below_air_k)


@record(HeatError)
class Ground:
    """The ground to which surfaces radiate and which reflects sunlight; at least one field must be given."""

    surface_c: Celsius | None = None
    """Temperature of the ground's surface, [degrees Celsius], at least -273.15; None: nothing radiates to it."""
    reflectance: Fraction | None = None
    """Share of the sunlight that the ground reflects, 0 to 1 (grass 0.2, fresh snow 0.8); None: it reflects none."""

    def __post_init__(self) -> None:
        if self.surface_c is None and self.reflectance is None:
            raise unclear("", "surface_c, reflectance or both", "neither", "Give one of them.")


@record(HeatError)
class Sun:
    """Sunlight of a sun that moves from `start` on, or that is fixed in the direction `towards`.

    Its strength is given or that of a clear sky. No part of the body shades another part.
    """

    start: AwareDatetime | None = None
    """Date and time of the scene's start, with a time zone, such as 2025-06-21T12:00:00+02:00; the sun moves on."""
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = (
        None  # Latitude of the place, north positive, [degrees], -90 to 90; goes with `start`
    )
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)] | None = None
    """Longitude of the place, east positive, [degrees], -180 to 180; goes with `start`."""
    north: Direction | None = None  # Direction that points north in the coordinates of the mesh; goes with `start`
    towards: Direction | None = None
    """Direction from the mesh to the sun in the coordinates of the mesh, instead of date and place."""
    clear_sky: Literal["meinel"] | None = None
    """meinel: direct and diffuse light under a clear sky at sea level, by the sun's elevation; goes with `start`."""
    direct_w_m2: AtLeastZero | None = None
    """Direct light on a surface that faces the sun, [W / m2], at least 0, as long as the sun is up."""
    diffuse_w_m2: AtLeastZero = 0.0
    """Light from the sky on a surface that faces up, [W / m2], at least 0, as long as the sun is up."""
    patches: Names = OUTSIDE  # Patches that sunlight may reach, by name or pattern

    def __post_init__(self) -> None:
        check_one(start=self.start, towards=self.towards)
        for name in ("latitude_deg", "longitude_deg", "north"):
            given = getattr(self, name)
            if self.start is None and given is not None:
                raise unclear(name, "a date and time in start beside it", "none", f"Add start or remove {name}.")
            if self.start is not None and given is None:
                raise unclear("start", f"{name} beside it", "none", f"Add {name}.")
        check_one(clear_sky=self.clear_sky, direct_w_m2=self.direct_w_m2)
        if self.clear_sky is not None and self.start is None:
            raise unclear("clear_sky", "a date and time in start beside it", "none", "Give direct_w_m2 instead.")
        if self.clear_sky is not None and self.diffuse_w_m2 > 0.0:
            got = f"{self.diffuse_w_m2:g}"
            raise unclear("diffuse_w_m2", "none beside clear_sky", got, "Remove one of the two.")

    def irradiance(self, ground_reflectance: float = 0.0) -> Varying:
        """Return the sunlight on facets, [W / m2]; the ground reflects the share `ground_reflectance` of it."""
        resolution_s = math.inf if self.start is None else _SUN_RESOLUTION_S
        return Varying(partial(_sunlight, self, ground_reflectance), self.start is not None, resolution_s)


def _sunlight(sun: Sun, ground_reflectance: float, places: Places, time_s: float) -> FloatArray:
    light = Sunlight(sun.direct_w_m2 or 0.0, sun.diffuse_w_m2)
    if sun.start is None:
        assert sun.towards is not None
        x, y, z = (np.array(sun.towards) / np.linalg.norm(sun.towards)).tolist()
        return facet_irradiance(places.normals, places.up, (x, y, z), light, ground_reflectance)
    assert sun.latitude_deg is not None and sun.longitude_deg is not None and sun.north is not None
    try:
        moment = sun.start + timedelta(seconds=time_s)
    except OverflowError:
        expected, got = "a date of the years 1 to 9999", f"{sun.start} and {time_s:g} s"
        raise unclear("sun", expected, got, "Follow the body for a shorter time.") from None
    position = sun_position(moment, sun.latitude_deg, sun.longitude_deg)
    if sun.clear_sky is not None:
        light = meinel_clear_sky(position.elevation_deg, position.distance_au)
    towards = towards_sun(position, places.up, sun.north)
    return facet_irradiance(places.normals, places.up, towards, light, ground_reflectance)


def check_one(**values: object) -> None:
    """Raise `HeatError` unless exactly one of the fields `values` is not None."""
    given = [name for name, value in values.items() if value is not None]
    if len(given) != 1:
        names = list(values)
        expected = f"one of {', '.join(names)}"
        remedy = f"Remove all but one: {', '.join(given)}." if given else f"Add {names[0]}, for example."
        raise unclear(" or ".join(names), expected, " and ".join(given) or "none", remedy)


def check_only_if(name: str, value: object, needed: bool, what: str) -> None:
    """Raise `HeatError` if the field `name` is None although `what` needs it (`needed`), or given although not."""
    if needed and value is None:
        raise unclear(name, f"one, because {what} needs it", "none", f"Add {name}.")
    if not needed and value is not None:
        raise unclear(name, f"none, because {what} does not need it", "one", f"Remove {name}.")


def unclear(name: str, expected: str, got: object, remedy: str) -> HeatError:
    """Return an error about the entry `name` of a scene."""
    return HeatError(name, expected=expected, got=got, remedy=remedy)
