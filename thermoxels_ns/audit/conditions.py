"""The conditions of a survey, read from a yaml file; ``configs/conditions-example.yaml`` explains every key."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Field

from thermoxels_ns.audit.heat_flow import FILMS, simple_models
from thermoxels_ns.audit.weather import survey_weather, with_weather
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured, Unit
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.core.yaml_records import as_record, raising, read_yaml, record
from thermoxels_ns.heat.scene_fields import check_one, check_only_if
from thermoxels_ns.heat.weather_file import ALL_AROUND_DEG

Share: TypeAlias = Annotated[Measured, Unit("1")]
Emissivity: TypeAlias = Annotated[Measured, Unit("1", 0.0, 1.0, above=True)]
Temperature: TypeAlias = Annotated[Measured, Unit("C", -ZERO_CELSIUS_K)]
Air: TypeAlias = Annotated[Measured, Unit("C", -90.0, 100.0)]
Difference: TypeAlias = Annotated[Measured, Unit("K")]
Hours: TypeAlias = Annotated[Measured, Unit("h")]
Conductivity: TypeAlias = Annotated[Measured, Unit("W/(m K)", 0.0, above=True)]

Side = Literal["outside", "inside"]
BALANCE = "balance"  # Film model: radiation to what each triangle sees, and convection by formulas drawn at random
_WINDLESS = ("iso-6946-combined", "given")  # Film models that need no wind speed for an outer surface

EXAMPLE = "conditions-example.yaml"
MOST_UNKNOWN = 4  # Largest number of properties that one calibration may search for


@record(AuditError)
class Camera:
    """The thermal camera and how far its readings may be off."""

    offset: Difference  # Correction to add to all readings, [K]; 0 +- 1 K: all may be 1 K too low or too high
    repeatability: Difference
    """Error that the readings of one part of the surface do not share with other parts, such as 0 +- 0.2 K, caused by
    drift between images and by the reconstruction."""
    emissivity: Emissivity = Measured(1.0)  # Emissivity that was set in the camera, above 0 and at most 1
    reflected: Temperature | None = None  # Reflected temperature set in the camera; needed for emissivities below 1
    model: str = ""
    serial_number: str = ""

    def __post_init__(self) -> None:
        if self.emissivity.low < 1.0 and self.reflected is None:
            got, remedy = "none beside an emissivity below 1", "Add what the camera was set to, such as 20 C."
            raise AuditError("reflected", expected="a temperature", got=got, remedy=remedy)


@record(AuditError)
class InsideAir:
    """The air in the building: behind the surface if seen from outside, in front of the surface if seen from inside."""

    air: Air  # Temperature at the time of the survey, [degrees Celsius]
    lowest_24h: Air | None = None  # Lowest temperature during the last 24 hours, [degrees Celsius]
    highest_24h: Air | None = None  # Highest temperature during the last 24 hours, [degrees Celsius]

    def __post_init__(self) -> None:
        low, high = self.lowest_24h, self.highest_24h
        if low is not None and high is not None and low.low > high.high:
            expected, got = "at most highest_24h", f"{low.value:g} C above {high.value:g} C"
            raise AuditError("lowest_24h", expected=expected, got=got, remedy="Exchange the two.")


@record(AuditError)
class OutsideAir(InsideAir):
    """The open air."""

    air: Air = Measured(math.nan)
    """Temperature, [degrees Celsius]; NaN if it was not stated, which is allowed in a view from inside only."""
    wind: Annotated[Measured, Unit("m/s", 0.0, surely=False)] | None = None  # Near the surface, [m/s]
    wind_direction: str = ""


@record(AuditError)
class SkyModel:
    """A sky whose radiation is computed from air temperature, dew point and cloud cover."""

    cloud: Annotated[Measured, Unit("1", 0.0, 1.0, surely=False)]  # Share of the sky that clouds cover
    dew_point: Temperature  # Dew point of the outside air, [degrees Celsius]


@record(AuditError)
class Surroundings:
    """Surroundings that the surface exchanges radiation with: one reflected temperature, or a sky and the ground."""

    reflected: Temperature | None = None  # As measured with crumpled foil; the same for all of the surface
    sky: SkyModel | None = None  # The tilt of each triangle decides how much sky, horizon and ground it sees
    ground: Temperature | None = None  # Temperature of the ground below a sky; None: as warm as the outside air

    def __post_init__(self) -> None:
        check_one(reflected=self.reflected, sky=self.sky)
        if self.ground is not None and self.sky is None:
            remedy = "Remove ground, or give a sky instead of reflected."
            raise AuditError("ground", expected="none beside reflected", got="one", remedy=remedy)


@record(AuditError)
class Film:
    """The model of heat exchange between surface and surroundings, with its uncertainty."""

    model: str = BALANCE  # `BALANCE`, "given", or the name of a formula in `thermoxels_ns.audit.heat_flow.FILMS`
    factor: Annotated[Measured, Unit("1", 0.0)] = Measured(1.0)
    """Factor of convection; for dallo and iso-6946-combined, of convection and radiation."""
    coefficient: Annotated[Measured, Unit("W/(m2 K)", 0.0)] | None = None  # Convection coefficient; model "given" only
    weights: dict[str, Annotated[float, Field(ge=0.0)]] = field(default_factory=dict)
    """Model balance only: relative frequency of each convection formula by name; unnamed formulas are never drawn."""

    def __post_init__(self) -> None:
        check_only_if("coefficient", self.coefficient, self.model == "given", f"model: {self.model}")
        if self.weights and (self.model != BALANCE or not 0.0 < sum(self.weights.values()) < math.inf):
            got = f"weights beside {self.model}" if self.model != BALANCE else "none above 0"
            remedy = f"Write model: {BALANCE} and weights: {{iso-6946: 1}}, or remove the weights."
            raise AuditError("weights", expected=f"weights above 0 beside {BALANCE}", got=got, remedy=remedy)


@record(AuditError)
class Surface:
    """The emissivity of some patches. Of several entries that match one patch, the last entry holds."""

    emissivity: Emissivity  # For long-wave radiation, above 0 and at most 1
    patches: tuple[str, ...] = ("*",)  # Names or patterns of patches


@record(AuditError)
class Reference:
    """A surface temperature that was measured by contact; the camera's offset is computed from these references."""

    at: tuple[float, float, float]  # Point of contact in the coordinates of the mesh, [m]
    temperature: Temperature  # Measured temperature, [degrees Celsius]


@record(AuditError)
class Survey:
    """Facts that a report after EN 13187 states; the audit computes no figures from them."""

    client: str = ""
    purpose: str = ""  # What the client wants to know
    operator: str = ""
    certificate: str = ""  # Of the operator, as ISO 6781-3 asks for: number, level, who issued it
    place: str = ""
    construction: str = ""  # Construction of the building, as far as known
    date: datetime | None = None
    camera_positions: str = ""
    parts_observed: str = ""
    parts_not_observed: str = ""
    hours_since_sun: Hours | None = None  # Hours since the sun last shone on the surface
    sun_last_12h: str = ""
    hours_dry: Hours | None = None  # Hours since the surface was last wet
    precipitation: str = ""
    least_difference_24h: Difference | None = None  # Smallest inside minus outside air of the last 24 hours, [K]
    pressure_difference: Annotated[Measured, Unit("Pa")] | None = None


@record(AuditError)
class Limits:
    """Limits that the user sets; the page says which limits are met."""

    u: dict[str, Annotated[Measured, Unit("W/(m2 K)")]] = field(default_factory=dict)
    """Largest U-value by name or pattern of patches; of several patterns that match a patch, the last one holds."""
    psi: Annotated[Measured, Unit("W/(m K)")] | None = None  # Largest psi of a linear thermal bridge
    f_rsi: Share | None = None  # Smallest temperature factor for an inside surface resistance of 0.25 m2 K / W
    loss: Annotated[Measured, Unit("W")] | None = None  # Largest heat loss of the observed surface


@record(AuditError)
class Measure:
    """A measure of renovation, which gives some patches another U-value."""

    patches: Annotated[tuple[str, ...], Field(min_length=1)]  # Names or patterns of patches that were observed
    u: Annotated[Measured, Unit("W/(m2 K)", 0.0)]  # U-value afterwards


@record(AuditError)
class Energy:
    """What the heat of a year is computed from: a climate, price and carbon dioxide of heat, and measures."""

    degree_hours: Annotated[Measured, Unit("K d", 0.0, above=True)] | None = None
    """Inside minus outside air, summed over the hours of a year with heating, in K h or K d; in place of `climate`."""
    climate: str | None = None
    """Weather file of a year beside the conditions, .epw or csv with outside_c; in place of `degree_hours`."""
    inside: Air | None = None  # Temperature inside while it is heated, [degrees Celsius]; beside `climate`
    heating_limit: Air | None = None  # Hours with a warmer outside air do not count, [degrees Celsius]; with `climate`
    price: Annotated[Measured, Unit("/kWh")] | None = None  # Price of heat, in `currency`
    currency: str = ""
    co2: Annotated[Measured, Unit("kg/kWh")] | None = None  # Carbon dioxide per heat
    measures: dict[str, Measure] = field(default_factory=dict)  # By name; the savings of each are those of it alone

    def __post_init__(self) -> None:
        check_one(climate=self.climate, degree_hours=self.degree_hours)
        for name, value in (("inside", self.inside), ("heating_limit", self.heating_limit)):
            check_only_if(name, value, self.climate is not None, "climate" if self.climate else "degree_hours")
        if self.inside is not None and self.heating_limit is not None and self.heating_limit.high > self.inside.low:
            expected, got = "surely at most the air inside", f"{self.heating_limit.high:g} above {self.inside.low:g} C"
            remedy = "Write the outside air above which nobody heats, such as 15 C."
            raise AuditError("heating_limit", expected=expected, got=got, remedy=remedy)


@record(AuditError)
class Layer:
    """A layer that the mesh does not contain, such as insulation, on the side that was not photographed."""

    patches: tuple[str, ...]  # Names or patterns of patches in `Calibrate.behind` on which the layer lies
    thickness: Annotated[Measured, Unit("m", 0.0, above=True)]
    conductivity: Conductivity


@record(AuditError)
class Unknown:
    """A property that the calibration searches for, starting from the value stated in `Calibrate`."""

    property: Literal["conductivity", "thickness"]
    of: str  # Key of the property in `conductivity` or `layers` of `Calibrate`

    def name(self) -> str:
        """Return the name that reports use, such as "conductivity of wall"."""
        return f"{self.property} of {self.of}"


@record(AuditError)
class Calibrate:
    """A model of the body behind the surface, and the properties of the model that a calibration searches for."""

    conductivity: dict[str, Conductivity]
    """Conductivity by name or pattern of regions of the mesh; of several that match a region, the last one holds."""
    unknown: tuple[Unknown, ...]  # One to `MOST_UNKNOWN` properties to search for
    layers: dict[str, Layer] = field(default_factory=dict)
    behind: tuple[str, ...] = ("interior-*",)  # Patches in contact with the air on the side not photographed
    adiabatic: tuple[str, ...] = ("cut",)  # Patches that no heat crosses
    heat_capacity: dict[str, Annotated[Measured, Unit("kJ/(m3 K)", 0.0, above=True)]] = field(default_factory=dict)
    """Heat capacity by the names of `conductivity`, [kJ/(m3 K)]: with it, walls store heat from the beginning of the
    weather file on; empty: heat flow is steady."""

    def __post_init__(self) -> None:
        if self.heat_capacity and set(self.heat_capacity) != set(self.conductivity):
            expected, got = f"one for each of {', '.join(self.conductivity)}", ", ".join(self.heat_capacity)
            remedy = "Write 1600 +- 300 kJ/(m3 K) for masonry, for example."
            raise AuditError("heat_capacity", expected=expected, got=got, remedy=remedy)
        both = sorted(set(self.conductivity) & set(self.layers))
        if both:
            remedy = "Give the layer another name."
            raise AuditError("layers", expected="names that no region has", got=both[0], remedy=remedy)
        names = [one.name() for one in self.unknown]
        if not 1 <= len(set(names)) <= MOST_UNKNOWN or len(set(names)) < len(names):
            remedy = "Write unknown: [{property: conductivity, of: wall}], for example."
            expected = f"one to {MOST_UNKNOWN} different entries"
            raise AuditError("unknown", expected=expected, got=", ".join(names) or "none", remedy=remedy)
        strange = [name for name in names if name not in self.stated()]
        if strange:
            expected, remedy = f"one out of {', '.join(self.stated())}", "Give it there, where the search is to start."
            raise AuditError("unknown", expected=expected, got=strange[0], remedy=remedy)

    def stated(self) -> dict[str, Measured]:
        """Return the stated value of every property, by names such as "conductivity of wall"."""
        every = {f"conductivity of {name}": value for name, value in self.conductivity.items()}
        every |= {f"conductivity of {name}": layer.conductivity for name, layer in self.layers.items()}
        every |= {f"thickness of {name}": layer.thickness for name, layer in self.layers.items()}
        every |= {f"capacity of {name}": value for name, value in self.heat_capacity.items()}
        return every


@record(AuditError)
class Weather:
    """A file of the weather before the survey; entries that say "weather" instead of a number get the file's value."""

    file: str
    """File beside the conditions. Either a csv, whose first line names hours (0: the survey) and columns of `COLUMNS`;
    or an .epw of the year of the survey, which needs `Survey.date`."""
    time_constant: Annotated[Measured, Unit("h", 0.0, above=True)] | None = None
    """Time constant of the walls, [h]; with it the audit states the effect of stored heat, `Audit.remembered`."""
    absorptance: Annotated[Measured, Unit("1", 0.0, 1.0)] = Measured(0.6, 0.2)  # Share of sunlight that walls absorb
    facing: Annotated[Measured, Unit("degrees")] | None = None
    """Direction that the walls face, clockwise from north, for the sunlight of an .epw file; None: all around."""


@record(AuditError)
class Conditions:
    """Conditions of an audit, as the user's yaml file states them: air, surroundings, camera, surfaces, weather."""

    side: Side  # Side from which the surface was photographed
    inside: InsideAir
    surroundings: Surroundings
    camera: Camera
    surfaces: Annotated[tuple[Surface, ...], Field(min_length=1)]
    film: Film = field(default_factory=Film)
    outside: OutsideAir = field(default_factory=OutsideAir)  # May be left out if the surface was seen from inside
    leave_out: tuple[str, ...] = ()  # Names or patterns of patches that do not count, such as glass or metal
    references: tuple[Reference, ...] = ()  # If there are none, `Camera.offset` is used as stated
    survey: Survey = field(default_factory=Survey)
    limits: Limits = field(default_factory=Limits)
    energy: Energy | None = None
    calibrate: Calibrate | None = None
    weather: Weather | None = None
    title: str = ""

    def __post_init__(self) -> None:
        known, model = (BALANCE, *FILMS[self.side], "given"), self.film.model
        inside, outside = self.inside.air, self.outside.air
        if model not in known:
            name, remedy = f"film: model of surfaces seen from {self.side}", f"Write model: {known[0]}, for example."
            raise AuditError(name, expected=f"one of {', '.join(known)}", got=model, remedy=remedy)
        formulas = [name for name in FILMS[self.side] if name not in simple_models(self.side)]
        strange = sorted(set(self.film.weights) - set(formulas))
        if strange:
            remedy = f"Choose from {', '.join(formulas)}."
            raise AuditError("film: weights", expected=f"formulas for {self.side}", got=strange[0], remedy=remedy)
        if self.side == "outside" and model not in _WINDLESS and self.outside.wind is None:
            expected, remedy = f"a speed, because {model} needs it", "Add wind: 1.5 +- 0.5 m/s, for example."
            raise AuditError("outside: wind", expected=expected, got="none", remedy=remedy)
        needed = {"calibrate": self.calibrate is not None, "energy": self.energy is not None}
        for name, there in {"seen from outside": self.side == "outside", **needed}.items():
            if there and not self.outside_known:
                remedy = "Add air: 0.0 +- 0.5 C, as measured or from a weather station."
                raise AuditError("outside: air", expected=f"a temperature beside {name}", got="none", remedy=remedy)
        if self.calibrate is not None and self.calibrate.heat_capacity and self.weather is None:
            remedy = "Add weather: {file: weather.csv}, or remove heat_capacity for steady heat flow."
            raise AuditError("calibrate: heat_capacity", expected="weather beside it", got="none", remedy=remedy)
        if inside.low <= outside.high:
            expected = "air that is warmer than outside by more than both may be off"
            got = f"{inside.value:g} +- {inside.off_by:g} C inside, {outside.value:g} +- {outside.off_by:g} C outside"
            remedy = "Measure while the building is heated and it is cold outside; no U-value follows from this."
            raise AuditError("inside: air", expected=expected, got=got, remedy=remedy)
        if self.side == "inside" and self.surroundings.sky is not None:
            remedy = "Write surroundings: {reflected: 19.5 +- 0.5 C}."
            raise AuditError("surroundings", expected="a reflected temperature inside", got="a sky", remedy=remedy)

    @property
    def outside_known(self) -> bool:
        """True if the conditions state an air temperature outside."""
        return math.isfinite(self.outside.air.value)

    def history(self) -> dict[str, FloatArray]:
        """Return the columns of `survey_weather`; raises `AuditError` if the file is unfit. `weather` must be given."""
        assert self.weather is not None
        facing = ALL_AROUND_DEG if self.weather.facing is None else (self.weather.facing.value,)
        return survey_weather(self.weather.file, self.survey.date, facing)

    @property
    def film_shares(self) -> FloatArray:
        """Probability of each formula of `FILMS`, in the order there; the sum is 1, or 0 for the model "given"."""
        formulas, model = FILMS[self.side], self.film.model
        weights = self.film.weights or {
            name: one.weight if model == BALANCE else float(name == model) for name, one in formulas.items()
        }
        shares = np.array([weights.get(name, 0.0) for name in formulas])
        return shares / (shares.sum() or 1.0)

    @property
    def difference_k(self) -> float:
        """Stated inside minus outside air temperature, [K]; NaN if `outside_known` is False."""
        return self.inside.air.value - self.outside.air.value


@raising(AuditError)
def load_conditions(path: Path | str | Mapping[str, Any]) -> Conditions:
    """Read conditions from a yaml file, or a mapping of its keys; raises `AuditError` if it is missing or wrong."""
    if isinstance(path, Mapping):
        return as_record("conditions", with_weather(deepcopy(dict(path)), Path()), Conditions)
    path = Path(path)
    return as_record(path.name, with_weather(read_yaml(path), path.parent), Conditions)
