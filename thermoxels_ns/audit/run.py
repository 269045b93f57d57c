"""The steps of an audit: heat flows, U-values and defects with intervals, from a mesh with readings and conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from thermoxels_ns.audit.calibration import Calibration, calibrated
from thermoxels_ns.audit.conditions import BALANCE, Conditions, Film, Survey, load_conditions
from thermoxels_ns.audit.defects import DefectKind, FoundDefect, find_defects
from thermoxels_ns.audit.draws import (
    GEOMETRY,
    REPEATABILITY,
    Draws,
    Interval,
    causes,
    draw,
    interval_of,
    uncertain,
    width_of,
)
from thermoxels_ns.audit.energy import EnergyResult, year_of
from thermoxels_ns.audit.exchange import (
    Exchange,
    Parts,
    most_u_w_m2k,
    reference_doubts,
    triangle_exchange,
    with_references,
)
from thermoxels_ns.audit.heat_flow import simple_models, temperature_factor
from thermoxels_ns.audit.surface import WHY_NOT, AuditedSurface, audited_surface
from thermoxels_ns.audit.weather import remembered_share
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import check_direction
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.core.tables import HasTables, lines_of
from thermoxels_ns.fem.selection import matching_names
from thermoxels_ns.mesh.files.vtu import AnyMesh, any_mesh, boundary_surface
from thermoxels_ns.mesh.tetrahedra import TetMesh

if TYPE_CHECKING:
    from thermoxels_ns.mesh.files.vtu import pv

F_RSI_M2K_W = (0.13, 0.25)
"""Inside surface resistances Rsi of the two temperature factors, [m2 K / W]; for mould ISO 13788 takes the second."""
_LEAST_FLOW_W_M2 = 1e-9
_FEW = 2000  # Number of draws from which is computed by how much each cause widens an interval

LEAST_DIFFERENCE_K, MOST_WIND_M_S, LEAST_HOURS_WITHOUT_SUN, LEAST_HOURS_DRY = 10.0, 5.0, 2.0, 24.0
"""Limits of EN 13187: least inside minus outside air, largest wind speed, least hours since sun and since wetness."""

_MEANT_AS_EXACT = ("emissivity set in the camera", "reflected temperature set in the camera")
_NAMES = {
    "hours_since_sun": "hours since the sun last shone on the surface",
    "sun_last_12h": "sun during the last 12 hours",
    "hours_dry": "hours since the surface was last wet",
    "least_difference_24h": "smallest difference of the airs during the last 24 hours",
}

Verdict = Literal["met", "not met", "cannot tell"]
_NOT_OF_EN_13187 = ("purpose", "certificate", "parts_not_observed")  # Fields of `Survey` that EN 13187 does not ask for


@dataclass(frozen=True)
class Limit:
    """One limit of `Conditions.limits`, the value found for it, and whether the limit is met."""

    name: str
    limit: float
    unit: str
    at_most: bool  # True: `found` must not exceed the limit; False: `found` must not fall below the limit
    found: Interval
    verdict: Verdict
    missed_share: float  # Share of the draws that miss the limit, 0 to 1; NaN if `found.value` is NaN


@dataclass(frozen=True)
class Element:
    """Results for one part of the envelope: a patch, or all observed patches together."""

    name: str
    area_m2: float  # Area of the part's triangles that count
    area_range_m2: Interval  # Interval of `area_m2`: the borders of the reconstructed part are uncertain
    unobserved_m2: float  # Area of the part's triangles that do not count, without triangles that are cut ("cut")
    surface_c: Interval  # Mean surface temperature, [degrees Celsius]
    loss_w: Interval  # Heat flow from inside to outside, [W]
    u_w_m2k: Interval  # U-value, [W/(m2 K)]; NaN if the air temperature outside is not known
    width_shares: Mapping[str, float]
    """Causes of uncertainty, largest share first. The share, 0 to 1, says how much narrower the interval of the U-value
    (of `loss_w` if no U-value is known) would be if the cause were known exactly. Shares need not add up to 1."""
    unsupported_share: float  # Share of the area whose position no photograph supports, 0 to 1
    most_u_w_m2k: float  # Largest possible U-value, of the films of air without a wall, see `exchange.most_u_w_m2k`


@dataclass(frozen=True)
class Defect:
    """Results for one thermal bridge or other defect; "extra" heat flow is the excess over an undisturbed surface."""

    kind: DefectKind
    patch: str
    centre_m: tuple[float, float, float]  # Centroid of the core in the coordinates of the mesh
    height_m: float  # Mean height of the core above the lowest point of the mesh
    length_m: float  # Length of a line; largest extent of a point or an area
    area_m2: float  # Area of the core: the triangles that depart by more than noise
    departure_k: float  # Absolute difference between `spot_c` and `undisturbed_c`, [K]
    spot_c: Interval  # Mean temperature of the square decimetre that departs most, [degrees Celsius]
    undisturbed_c: float  # Mean temperature of the undisturbed surface near by, [degrees Celsius]
    extra_w: Interval  # Extra heat flow from inside to outside, [W]
    coefficient: Interval
    """`extra_w` per kelvin between the airs; of a line per metre (psi), [W/(m K)], of a point (chi) or area, [W/K]."""
    f_rsi: tuple[Interval, ...]  # Temperature factors of the place of `spot_c` for `F_RSI_M2K_W`; seen from outside: ()
    not_counted: str  # Sentence that says why the defect does not count; empty if the defect counts


@dataclass(frozen=True)
class Asked:
    """A condition that a standard asks a survey to meet, in words for the report."""

    what: str
    asked: str
    stated: str  # What the conditions state; empty if they state nothing
    verdict: Literal["met", "not met", "not stated"]


@dataclass(frozen=True)
class SurveyCheck:
    """Shortcomings of a survey, in words for the report."""

    asked: tuple[Asked, ...]  # The conditions that EN 13187 and ISO 6781-3 ask for, met or not
    doubts: tuple[str, ...]  # Sentences on what makes the figures less certain than their intervals say
    missing: tuple[str, ...]  # Names of facts that EN 13187 wants in a report and that the conditions do not state

    @property
    def forbidden(self) -> tuple[str, ...]:
        """Sentences on conditions that EN 13187 does not allow."""
        wrong = [one for one in self.asked if one.verdict == "not met"]
        return tuple(
            f"{one.what[0].upper()}{one.what[1:]}: {one.stated}. EN 13187 asks for {one.asked}." for one in wrong
        )


@dataclass(frozen=True)
class Audit(HasTables):
    """All results of one audit, with the conditions and the surface that the results follow from."""

    conditions: Conditions
    surface: AuditedSurface
    check: SurveyCheck
    patches: tuple[Element, ...]
    whole: Element
    defects: tuple[Defect, ...]  # By falling extra heat flow; defects that do not count come last
    found: tuple[FoundDefect, ...]  # Triangles of each defect, in the order of `defects`
    limits: tuple[Limit, ...]
    energy: EnergyResult | None
    calibration: Calibration | None
    f_rsi: tuple[Interval, ...]  # Temperature factors of the coldest square decimetre, see `Defect.f_rsi`
    budget: Mapping[str, float]
    """By cause, largest first: how much narrower `whole.loss_w` would be if the cause were known exactly, [W]."""
    draws: int  # Number of random draws behind each interval
    remembered: Interval | None  # Interval of `remembered_share`; None if no time constant is stated
    not_counted_m2: Mapping[str, float]  # Area of triangles that do not count, by the texts of `WHY_NOT`
    triangle_surface_c: FloatArray  # Surface temperature, shape (f,), [degrees Celsius]; NaN: does not count
    triangle_flow_w_m2: FloatArray  # Heat flow from inside to outside, shape (f,), [W/m2]; NaN: does not count
    triangle_u: FloatArray  # U-value, shape (f,), [W/(m2 K)]; NaN: does not count, or no U-value is known

    @property
    def impossible(self) -> tuple[str, ...]:
        """One sentence if the U-value interval of a patch reaches above `Element.most_u_w_m2k`; else none.

        The sentence names the two inputs that widen the U-value of `whole` most: one of them contradicts the readings.
        """
        over = [one for one in self.patches if one.u_w_m2k.high > one.most_u_w_m2k]
        if not over:
            return ()
        shares = self.whole.width_shares.items()
        widest = [name for name, share in shares if share > 0.0 and name not in (GEOMETRY, REPEATABILITY)]
        return (
            f"Impossible: the U-value of {', '.join(one.name for one in over)} reaches beyond the "
            f"{min(one.most_u_w_m2k for one in over):.1f} W/(m² K) that the films of air on both sides allow without a "
            "wall (ISO 6946). What is stated clashes with the readings; look at "
            f"{' and '.join(widest[:2]) or 'the airs and the camera'} first.",
        )

    def __repr__(self) -> str:
        loss, u = self.whole.loss_w, self.whole.u_w_m2k
        defects = sum(not one.not_counted for one in self.defects)
        told = f"loss {loss.value:.4g} W ({loss.low:.4g} to {loss.high:.4g})"
        return f"Audit({told}, U {u.value:.3g} W/(m2 K) ({u.low:.3g} to {u.high:.3g}), {defects} defects)"

    def tables(self) -> dict[str, list[dict[str, Any]]]:
        """Return the tables of results; an interval has the columns NAME (its value), NAME_low and NAME_high."""
        year = self.energy
        return {
            "patches": lines_of((*self.patches, self.whole)),
            "defects": lines_of(self.defects),
            "limits": lines_of(self.limits),
            "energy": [] if year is None else lines_of((*year.elements, year.whole)),
            "savings": [] if year is None else lines_of(year.savings),
        }

    def to_pyvista(self) -> pv.PolyData:
        """Return `vtu.boundary_surface` with a cell array of each result; NaN: the triangle does not count.

        The array `defect` is the place in `defects`, from 1, of the defect to whose core a triangle belongs; 0: none.
        """
        data, calibration = boundary_surface(self.surface.mesh), self.calibration
        numbers = np.zeros(len(self.surface.mesh.facets), dtype=np.int32)
        for number, one in enumerate(self.found, start=1):
            numbers[one.core] = number
        for name, values in {
            "surface_temperature_c": self.triangle_surface_c,
            "heat_flow_w_m2": self.triangle_flow_w_m2,
            "u_w_m2k": self.triangle_u,
            "counted": self.surface.counted.astype(np.uint8),
            "defect": numbers,
            **({} if calibration is None else {"measured_minus_computed_k": calibration.difference_k}),
        }.items():
            data.cell_data[name] = values
        return data


def audit_mesh(
    mesh: AnyMesh, conditions: Conditions | Mapping[str, Any] | Path | str, *, up: Sequence[float] | None = None
) -> Audit:
    """Return heat loss, U-values and thermal bridges, each as an interval, from the temperatures that a mesh holds.

    `mesh` is what `thermoxels_ns.solve` takes. `conditions` is a `Conditions`, the path of a yaml file, or a mapping of
    the keys of such a file. `up` points up in the coordinates of the mesh; None: as stored with the mesh, or else z.
    Raises `AuditError` if the conditions are wrong or do not fit the mesh, `ThermoxelsError` if the mesh is not sound.
    """
    if not isinstance(conditions, Conditions):
        conditions = load_conditions(conditions)
    body, about = any_mesh(mesh, up)
    x, y, z = check_direction("up", about.get("up") or (0.0, 0.0, 1.0), "Pass up=(0, 0, 1).", AuditError).tolist()
    with threadpool_limits(1, "blas"):  # with more, the last bits would depend on the number of threads
        return audit(body, conditions, (x, y, z))


def audit(
    mesh: TetMesh, conditions: Conditions, up: tuple[float, float, float] = (0.0, 0.0, 1.0), least_bridge_w: float = 0.0
) -> Audit:
    """Return heat flows, U-values, thermal bridges and all else that an `Audit` holds, with intervals.

    `up` is the unit vector that points up. Defects whose extra heat flow is below `least_bridge_w`, [W], do not count
    and are not judged by limits. Raises `AuditError` if the conditions do not fit the mesh.
    """
    surface = audited_surface(mesh, conditions, up)
    draws = with_references(surface, conditions, draw(conditions))
    stated = triangle_exchange(conditions, surface, draws)
    off_by = conditions.camera.repeatability.off_by
    found = find_defects(surface, stated.surface_c, conditions.side == "outside", off_by)
    work = _Work(conditions, surface, draws, stated, found)
    patches, whole, budget = work.elements()
    _check_film(conditions, surface, draws, [one.element for one in patches])
    bridges = [(one, *work.defect(number, one, least_bridge_w)) for number, one in enumerate(found)]
    bridges.sort(key=lambda item: (bool(item[1].not_counted), -item[1].extra_w.value))
    factors = work.temperature_factors(len(work.flow_w) - 1, work.own_error_k(3 * len(found)))
    check, (remembered, told) = check_survey(conditions), _remembered(conditions)
    left = {why: float(surface.area_m2[surface.why_not == n].sum()) for n, why in enumerate(WHY_NOT.values())}
    return Audit(
        conditions=conditions,
        surface=surface,
        check=replace(check, doubts=(*check.doubts, *reference_doubts(conditions, draws), *told)),
        patches=tuple(one.element for one in patches),
        whole=whole.element,
        defects=tuple(one for _, one, _ in bridges),
        found=tuple(one for one, _, _ in bridges),
        limits=_limits(conditions, patches, [(one, psi) for _, one, psi in bridges], whole, factors),
        energy=year_of(conditions, draws, [(one.element.name, one.area_m2, one.u) for one in patches]),
        calibration=calibrated(conditions, surface, draws),
        f_rsi=tuple(interval_of(one) for one in factors),
        budget=budget,
        draws=draws.count - 1,
        remembered=remembered,
        not_counted_m2={why: area for why, area in left.items() if area > 0.0},
        triangle_surface_c=stated.surface_c,
        triangle_flow_w_m2=stated.flow_w_m2,
        triangle_u=stated.flow_w_m2 / draws.difference_k[0],
    )


def _largest_first(amounts: Mapping[str, float]) -> dict[str, float]:
    return dict(sorted(amounts.items(), key=lambda item: -item[1]))


class _Drawn(NamedTuple):
    """An element, and its heat flow, [W], area, [m2], and U-value, [W/(m2 K)], in every draw, shape (k,) each."""

    element: Element
    flow_w: FloatArray
    area_m2: FloatArray
    u: FloatArray


class _Work:
    """Heat flow and temperature of all parts of a surface in every draw, and the results that follow.

    `parts`: the patches, then zone, reference and spot of each defect, then the coldest spot (from outside: hottest).
    """

    def __init__(
        self,
        conditions: Conditions,
        surface: AuditedSurface,
        draws: Draws,
        stated: Exchange,
        found: Sequence[FoundDefect],
    ) -> None:
        self.conditions, self.surface, self.draws = conditions, surface, draws
        counted = np.flatnonzero(surface.counted)
        patch = surface.selection.facet_patch[counted]
        self.patches = np.unique(patch)
        parts = [counted[patch == n] for n in self.patches]
        parts += [part for one in found for part in (one.zone, one.reference, one.spot)]
        worst = np.flatnonzero(surface.counted & ~surface.rim)
        worst = worst if len(worst) else counted
        parts.append(surface.spot(worst, stated.surface_c[worst] * (-1.0 if conditions.side == "inside" else 1.0)))
        self.parts = Parts(conditions, surface, draws, parts)
        self.surface_c, self.flow_w = self.parts.in_draws(draws)

    def elements(self) -> tuple[list[_Drawn], _Drawn, dict[str, float]]:
        """Return each patch as an element, their sum as one element, and `Audit.budget`.

        Each patch has a reading error (repeatability) and an error of its border that other patches do not share.
        """
        surface, conditions, patches, count = self.surface, self.conditions, self.patches, len(self.patches)
        of_facet, members = surface.selection.facet_patch, np.vstack([np.eye(count), np.ones(count)])
        area_m2, slope_w_k = self.parts.area_m2[:count], self.parts.slope_w_k[:count, None]
        border_m2 = np.bincount(of_facet, surface.border_m2 * surface.counted)[patches]
        wider = np.minimum(border_m2 / area_m2, 0.9)
        off_by = conditions.camera.repeatability.off_by

        def drawn(draws: Draws, flow_w: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            """Return flow, area, U-value of p patches and of all together, (p + 1, k), with each patch's errors."""
            off_k = np.stack([draws.local(off_by, n) for n in range(count)])
            size = np.stack([1.0 + one * draws.geometry(n) for n, one in enumerate(wider.tolist())])
            flow_w, area = members @ ((flow_w + slope_w_k * off_k) * size), members @ (area_m2[:, None] * size)
            return flow_w, area, flow_w / area / draws.difference_k

        def widths(draws: Draws) -> tuple[FloatArray, FloatArray]:
            draws = with_references(surface, conditions, draws)
            flow_w, _, u = drawn(draws, self.parts.in_draws(draws, count)[1])
            return width_of(flow_w), width_of(u if conditions.outside_known else flow_w)

        few, budget, shares = self.draws.first(_FEW), dict[str, float](), [dict[str, float]() for _ in members]
        every_w, every_u = widths(few)
        for cause in causes(conditions) + [GEOMETRY] * bool(surface.border_m2.any()):
            frozen_w, frozen_u = widths(few.frozen(cause))
            budget[cause] = max(float(every_w[-1] - frozen_w[-1]), 0.0)
            narrower = np.maximum(1.0 - frozen_u / np.maximum(every_u, 1e-300), 0.0).tolist()
            for one, share in zip(shares, narrower):
                one[cause] = share

        flow_w, area, u = drawn(self.draws, self.flow_w[:count])
        surface_c = members @ (area_m2[:, None] * self.surface_c[:count]) / (members @ area_m2)[:, None]
        observed, most_u = np.isin(of_facet, patches), most_u_w_m2k(surface, conditions.side)
        named = [(surface.selection.patch_names[n], of_facet == n) for n in patches]
        found = list[_Drawn]()
        for n, (name, where) in enumerate([*named, ("all that was observed", observed)]):
            counted, uncut = where & surface.counted, where & (surface.why_not != list(WHY_NOT).index("cut"))
            element = Element(
                name=name,
                area_m2=float(area[n, 0]),
                area_range_m2=interval_of(area[n]),
                unobserved_m2=max(float(surface.area_m2[uncut].sum() - area[n, 0]), 0.0),
                surface_c=interval_of(surface_c[n]),
                loss_w=interval_of(flow_w[n]),
                u_w_m2k=interval_of(u[n]),
                width_shares=_largest_first(shares[n]),
                unsupported_share=float(surface.area_m2[counted & surface.unsupported].sum() / area[n, 0]),
                most_u_w_m2k=float(np.average(most_u[counted], weights=surface.area_m2[counted])),
            )
            found.append(_Drawn(element, flow_w[n], area[n], u[n]))
        return found[:-1], found[-1], _largest_first(budget)

    def own_error_k(self, number: int) -> FloatArray:
        """Return draws of the reading error of one defect or spot alone, (k,), [K]; each `number` has its own error."""
        return self.draws.local(self.conditions.camera.repeatability.off_by, len(self.patches) + number)

    def temperature_factors(self, part: int, off_k: FloatArray) -> tuple[FloatArray, ...]:
        """Return draws, (k,), of the temperature factor for each of `F_RSI_M2K_W`; empty if seen from outside.

        `part` is a place in `parts`; `off_k` are draws of the reading error of this part alone, shape (k,), [K].
        """
        if self.conditions.side == "outside":
            return ()
        flow = self.flow_w[part] + self.parts.slope_w_k[part] * off_k
        flow = np.maximum(flow / max(self.parts.area_m2[part], 1e-12), _LEAST_FLOW_W_M2)
        above = self.surface_c[part] + off_k - self.draws["outside air"]
        return tuple(np.asarray(temperature_factor(above / flow, one)) for one in F_RSI_M2K_W)

    def defect(self, number: int, one: FoundDefect, least_w: float) -> tuple[Defect, FloatArray]:
        """Return the results of `one`, found defect `number`, and its `Defect.coefficient` in every draw, (k,).

        Extra heat flow is that of the zone minus that of undisturbed surface of the area `base_area_m2` (psi = q_tb -
        q_uniform per metre, O'Grady and others 2017; areas are of the seen side); below `least_w` it does not count.
        """
        surface, zone, off_k = self.surface, len(self.patches) + 3 * number, self.own_error_k(number)
        calm, spot = zone + 1, zone + 2
        extra = self.flow_w[zone] + self.parts.slope_w_k[zone] * off_k
        extra = extra - self.flow_w[calm] / max(self.parts.area_m2[calm], 1e-12) * one.base_area_m2
        if surface.border_m2.any():  # both ends of its length lie within half a triangle's edge
            edge = float(np.sqrt(2.0 * surface.area_m2[one.core].mean()))
            extra = extra * (1.0 + self.draws.geometry(zone) * min(edge / one.length_m, 0.9))
        per_kelvin = extra / self.draws.difference_k / (one.length_m if one.kind == "line" else 1.0)
        extra_w, f_rsi = interval_of(extra), tuple(map(interval_of, self.temperature_factors(spot, off_k)))
        around_c, why = float(self.surface_c[calm, 0]), one.not_counted
        if not why and max(extra_w.value, 0.0) < least_w:
            why = f"It loses less than {least_w:g} W extra (--least-bridge-w)."
        area, spot_c = surface.area_m2[one.core], interval_of(self.surface_c[spot] + off_k)
        x, y, z = np.average(surface.centroid_m[one.core], axis=0, weights=area).tolist()
        defect = Defect(
            kind=one.kind,
            patch=surface.selection.patch_names[one.patch],
            centre_m=(x, y, z),
            height_m=float(np.average(surface.height_m[one.core], weights=area)),
            length_m=one.length_m,
            area_m2=float(area.sum()),
            departure_k=abs(spot_c.value - around_c),
            spot_c=spot_c,
            undisturbed_c=around_c,
            extra_w=extra_w,
            coefficient=interval_of(per_kelvin),
            f_rsi=f_rsi,
            not_counted=why,
        )
        return defect, per_kelvin


def _limits(
    conditions: Conditions,
    patches: Sequence[_Drawn],
    defects: Sequence[tuple[Defect, FloatArray]],
    whole: _Drawn,
    f_rsi: tuple[FloatArray, ...],
) -> tuple[Limit, ...]:
    """Return the verdict on each limit: U-values of patches, psi of the worst line, temperature factor, heat loss.

    `defects` are pairs of a defect and its coefficient in every draw, (k,). `f_rsi` are draws, (k,), for `F_RSI_M2K_W`.
    """
    limits, found = conditions.limits, list[Limit]()

    def judge(name: str, limit: Measured, unit: str, drawn: FloatArray, at_most: bool = True) -> None:
        value, edge = interval_of(drawn), limit.value
        beyond = interval_of(drawn - edge if at_most else edge - drawn)  # above 0: the limit is not kept
        verdict: Verdict = "met" if beyond.high <= 0.0 else "not met" if beyond.low > 0.0 else "cannot tell"
        missed = float(np.mean(drawn[1:] > edge if at_most else drawn[1:] < edge))
        missed = missed if np.isfinite(value.value) else np.nan
        found.append(Limit(name, edge, unit, at_most, value, verdict, missed))

    for one in patches:
        chosen = [limit for pattern, limit in limits.u.items() if matching_names([one.element.name], pattern)]
        if chosen:
            judge(f"U-value of {one.element.name}", chosen[-1], "W/(m2 K)", one.u)
    lines = [(one, drawn) for one, drawn in defects if one.kind == "line" and not one.not_counted]
    if limits.psi is not None and lines:
        worst, drawn = max(lines, key=lambda item: item[0].coefficient.value)
        judge(f"psi of the worst linear thermal bridge, in {worst.patch}", limits.psi, "W/(m K)", drawn)
    if limits.f_rsi is not None and f_rsi:
        judge("lowest temperature factor for Rsi = 0.25", limits.f_rsi, "", f_rsi[-1], at_most=False)
    if limits.loss is not None:
        judge("heat loss of what was observed", limits.loss, "W", whole.flow_w)
    return tuple(found)


def _check_film(conditions: Conditions, surface: AuditedSurface, draws: Draws, patches: Sequence[Element]) -> None:
    """Raise `AuditError` if a patch has a U-value up to 0 by a simple film model, but one above 0 by the balance.

    Zhang, Lucchi and Garzulino 2026, after EN ISO 6781-1, describe nights with this result.
    """
    chosen, balance_works = conditions.film.model, conditions.side == "inside" or conditions.outside.wind is not None
    failing = [one for one in patches if one.u_w_m2k.value <= 0.0]
    if chosen not in simple_models(conditions.side) or not failing or not balance_works:
        return
    balance = replace(conditions, film=Film(factor=conditions.film.factor))
    flow_w = surface.area_m2 * triangle_exchange(balance, surface, draws).flow_w_m2
    for one in failing:
        on = surface.selection.facet_patch == surface.selection.patch_names.index(one.name)
        u = flow_w[surface.counted & on].sum() / one.area_m2 / draws.difference_k[0]
        if u > 0.0:
            expected = f"one that knows what the surface sees, which is not as warm as the air {conditions.side}"
            got = f"{chosen}, by which {one.name} has a U-value of {one.u_w_m2k.value:.2f}; by the balance, {u:.2f}"
            raise AuditError("film: model", expected=expected, got=got, remedy=f"Write model: {BALANCE}.")


def asked_of_survey(survey: Survey, conditions: Conditions | None = None) -> tuple[Asked, ...]:
    """Return the conditions that EN 13187 and ISO 6781-3 (certificate) ask a survey to meet, with verdicts.

    `conditions` is None before a survey: it is then taken as one from outside, and airs and wind as not stated.
    """
    found, wind, difference = list[Asked](), None, None
    if conditions is not None:
        wind = conditions.outside.wind
        difference = Measured(conditions.difference_k) if conditions.outside_known else None

    def ask(what: str, stated: Measured | None, limit: float, unit: str, least: bool = True) -> None:
        asked = f"at {'least' if least else 'most'} {limit:g} {unit}"
        if stated is None:
            found.append(Asked(what, asked, "", "not stated"))
        else:
            met = stated.value >= limit if least else stated.value <= limit
            found.append(Asked(what, asked, f"{stated.value:.3g} {unit}", "met" if met else "not met"))

    ask("air inside warmer than outside, during the survey", difference, LEAST_DIFFERENCE_K, "K")
    ask("air inside warmer than outside, all the last 24 hours", survey.least_difference_24h, LEAST_DIFFERENCE_K, "K")
    ask("wind", wind, MOST_WIND_M_S, "m/s", least=False)
    if conditions is None or conditions.side == "outside":
        ask("time since the sun shone on the surface", survey.hours_since_sun, LEAST_HOURS_WITHOUT_SUN, "h")
        ask("time since the surface was wet", survey.hours_dry, LEAST_HOURS_DRY, "h")
    certificate = survey.certificate
    asked = "a certificate of qualification"
    return (*found, Asked("operator", asked, certificate, "met" if certificate else "not stated"))


def check_survey(conditions: Conditions) -> SurveyCheck:
    """Return `asked_of_survey`, sentences on what makes results doubtful, and names of facts that are not stated."""
    return SurveyCheck(asked_of_survey(conditions.survey, conditions), _doubts(conditions), _missing(conditions))


def _doubts(conditions: Conditions) -> tuple[str, ...]:
    found, difference = [], conditions.difference_k
    not_meant = _MEANT_AS_EXACT if conditions.outside_known else (*_MEANT_AS_EXACT, "outside air")
    not_meant += ("film factor",) if conditions.film.model == BALANCE else ()
    exact = [name for name, what in uncertain(conditions).items() if not what.off_by and name not in not_meant]
    if exact:
        found.append(f"Taken as exact, because nothing says how far they may be off: {', '.join(exact)}.")
    if not conditions.outside_known:
        found.append(
            "The air outside is not known. U-values, psi, chi and temperature factors are shares of the difference of "
            "the airs: none can be told. Heat flow through the surface can: it follows from the room alone."
        )
    for name, air in (("inside", conditions.inside), ("outside", conditions.outside)):
        if air.lowest_24h is not None and air.highest_24h is not None:
            change = air.highest_24h.value - air.lowest_24h.value
            if change > 0.2 * difference:
                found.append(
                    f"The air {name} changed by {change:.1f} K within 24 hours, {100 * change / difference:.0f} % of "
                    "the difference of the airs. Heat flow is taken as steady; heavy walls lag behind by hours."
                )
        else:
            found.append(f"How the air {name} changed before is not known. Heat flow is taken as steady.")
    if conditions.surroundings.reflected is None and conditions.surroundings.ground is None:
        found.append("The ground is taken to be as warm as the air.")
    metal = [", ".join(surface.patches) for surface in conditions.surfaces if surface.emissivity.value < 0.7]
    if metal:
        found.append(
            f"Emissivities below 0.7 ({'; '.join(metal)}): such surfaces mirror more than they show; leave_out does "
            "without them."
        )
    if conditions.side == "inside" and conditions.outside_known:
        found.append("U-values hold where the open air is behind the surface; the mesh does not say where that is.")
    return tuple(found)


def _remembered(conditions: Conditions) -> tuple[Interval | None, tuple[str, ...]]:
    """Return `Audit.remembered` and sentences on it; raises `AuditError` if the weather or the air outside is unfit."""
    weather = conditions.weather
    if weather is None or weather.time_constant is None:
        return None, ()
    series, constant, taken = conditions.history(), weather.time_constant, weather.absorptance
    if "outside_c" not in series or not conditions.outside_known:
        remedy = "Add the column outside_c to the weather file, and outside: {air: weather +- 0.5 C}."
        raise AuditError("weather: time_constant", expected="the air outside", got="none", remedy=remedy)

    def share(hours: float, absorptance: float, *earlier_c: float) -> float:
        before = {name: np.append([values[0]] * len(earlier_c), values) for name, values in series.items()}
        for air_c in earlier_c:  # the air before the file begins
            before["hours"][0], before["outside_c"][0] = series["hours"][0] - 0.1, air_c
        return remembered_share(before, conditions.difference_k, hours, absorptance, conditions.side == "inside")

    value, air = share(constant.value, taken.value), series["outside_c"]
    ends = [share(hours, part) for hours in (constant.low, constant.high) for part in (taken.low, taken.high)]
    open_share = max(abs(share(constant.value, taken.value, float(one)) - value) for one in (air.min(), air.max()))
    low, high = min(value, *ends), max(value, *ends)
    sentences = [
        f"A uniform wall that forgets within {constant.value:g} h stores heat: at the survey the heat flow through its "
        f"surface is {100.0 * low:+.0f} to {100.0 * high:+.0f} % off the steady one. U-values of such walls are off by "
        "as much, which their intervals do not hold."
    ]
    if open_share >= 0.01:
        sentences.append(
            f"The weather file begins {-series['hours'][0]:g} h before the survey, too late for such a wall: what was "
            f"before may change that by {100.0 * open_share:.0f} %."
        )
    return Interval(value, low, high), tuple(sentences)


def _missing(conditions: Conditions) -> tuple[str, ...]:
    survey, camera, outside = conditions.survey, conditions.camera, conditions.outside
    of_it = [one.name for one in fields(survey) if one.name not in _NOT_OF_EN_13187]
    said = {_NAMES.get(name, name.replace("_", " ")): getattr(survey, name) for name in of_it}
    said["air temperature outside"] = outside.air if conditions.outside_known else None
    for name, air in (("inside", conditions.inside), ("outside", outside)):
        both = air.lowest_24h if air.highest_24h is not None else None
        said[f"lowest and highest air temperature {name} during the last 24 hours"] = both
    said |= {"wind": outside.wind, "wind direction": outside.wind_direction}
    said |= {"make and model of the camera": camera.model, "serial number of the camera": camera.serial_number}
    return tuple(name for name, value in said.items() if value in (None, ""))
