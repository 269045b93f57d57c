"""What an audit finds: elements of the envelope, thermal bridges, limits and a heating season, with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from thermoxels_ns.audit.conditions import Conditions
from thermoxels_ns.audit.defects import DefectKind, FoundDefect
from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.audit.surface import AuditedSurface
from thermoxels_ns.audit.survey_rules import SurveyCheck
from thermoxels_ns.core.arrays import FloatArray

Verdict = Literal["met", "not met", "cannot tell"]
Severity = Literal["severe", "moderate", "slight", "uncertain"]


@dataclass(frozen=True)
class Limit:
    """What was asked for, and whether it is met."""

    name: str
    limit: float
    unit: str
    at_most: bool  # Whether it is an upper limit
    found: Interval
    verdict: Verdict


@dataclass(frozen=True)
class Element:
    """A part of the envelope: a patch, a storey, or all that was observed."""

    name: str
    area_m2: float  # True area that counts
    unobserved_m2: float  # True area of it of which nothing is known, or that is left out
    surface_c: Interval  # Mean surface temperature, [degrees Celsius]
    loss_w: Interval  # Heat flow to the outside, [W]
    u_w_m2k: Interval
    u_by_model: Mapping[str, float]  # U-value that each film model would give of the stated values
    unsupported_share: float  # Share of the area that smoothness alone has placed, 0 to 1


@dataclass(frozen=True)
class Defect:
    """A thermal bridge or defect; heat flows are beyond those of the undisturbed surface."""

    kind: DefectKind
    patch: str
    storey: str  # Empty if the conditions name none there
    centre_m: tuple[float, float, float]
    height_m: float  # Of its middle above the lowest point of the mesh
    length_m: float  # Of a line, else its largest extent
    area_m2: float  # Of what departs by more than noise
    departure_k: float  # Of its worst square decimetre from the undisturbed surface near by, above 0
    spot_c: Interval  # Temperature of that, [degrees Celsius]
    undisturbed_c: float  # Mean temperature of that, [degrees Celsius]
    incidence: Interval | None  # I_tb; None where the undisturbed surface may be as warm as the air
    extra_w: Interval  # Extra heat flow
    coefficient: Interval
    """psi of a line, [W/(m K)], chi of a point, or extra heat flow per kelvin of an area, [W/K]."""
    f_rsi: tuple[Interval, ...]  # Temperature factors for `F_RSI_M2K_W`; empty if seen from outside
    severity: Severity
    not_counted: str  # Why it is not to be believed; else empty


@dataclass(frozen=True)
class YearResult:
    """A heating season of what was observed."""

    heat_kwh: Interval
    cost: Interval | None  # In the user's currency
    co2_kg: Interval | None


@dataclass(frozen=True)
class Calibration:
    """Properties with which the computed surface temperature meets the measured one."""

    found: Mapping[str, Interval]  # By name, such as "conductivity of wall"; empty if refused
    units: Mapping[str, str]  # Of each property, known or unknown
    refused: str  # Why no values are given, in sentences; else empty
    moved_most_by: Mapping[str, str]  # Which stated quantity moves each most within its range
    misfit_k: float  # Root mean square of measured minus computed, by area, [K]
    difference_k: FloatArray
    """Measured minus computed surface temperature of each triangle, shape (f,), NaN where it does not count, [K]."""


@dataclass(frozen=True)
class Audit:
    """All that was found."""

    conditions: Conditions
    surface: AuditedSurface
    check: SurveyCheck
    patches: tuple[Element, ...]
    storeys: tuple[Element, ...]
    whole: Element
    defects: tuple[Defect, ...]  # Those with the most extra heat flow first, those that do not count last
    found: tuple[FoundDefect, ...]  # The triangles of each defect
    limits: tuple[Limit, ...]
    year: YearResult | None
    calibration: Calibration | None
    f_rsi: tuple[Interval, ...]  # Of the coldest square decimetre of all, for `F_RSI_M2K_W`; empty seen from outside
    budget: Mapping[str, float]  # How far each uncertain quantity alone moves the loss from lowest to highest, [W]
    not_counted_m2: Mapping[str, float]  # True area that does not count, by reason
    triangle_surface_c: FloatArray  # Surface temperature, NaN where it does not count, shape (f,), [degrees Celsius]
    triangle_flow_w_m2: FloatArray  # Heat flow to the outside, likewise, shape (f,)
    triangle_u: FloatArray  # U-value, its lower and its upper end, likewise, shape (f, 3), [W/(m2 K)]
