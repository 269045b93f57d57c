"""The course of an audit: from a mesh with readings and conditions to answers with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermoxels_ns.audit.calibration import calibrated
from thermoxels_ns.audit.conditions import Conditions, Side
from thermoxels_ns.audit.defects import SPOT_M2, FoundDefect, find_defects
from thermoxels_ns.audit.draws import CONFIDENCE, Draws, Interval, draw, interval_of, one_at_a_time
from thermoxels_ns.audit.exchange import (
    CHUNK,
    HALF_STEP_K,
    PartTotals,
    exchange,
    other_models,
    part_totals,
    reference_doubts,
    triangle_exchange,
    with_references,
)
from thermoxels_ns.audit.heat_flow import temperature_factor
from thermoxels_ns.audit.results import Audit, Defect, Element, Limit, Severity, Verdict, YearResult
from thermoxels_ns.audit.surface import WHY_NOT, AlikeTriangles, AuditedSurface, alike_triangles, audited_surface
from thermoxels_ns.audit.survey_rules import check_survey
from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.fem.selection import matching_names
from thermoxels_ns.mesh.tetrahedra import TetMesh

SEVERE_SHARE, MODERATE_SHARE = 0.05, 0.01
"""Shares of the observed heat loss from which on a defect is severe or moderate. They are ours, of no standard."""
F_RSI_M2K_W = (0.13, 0.25)
"""Resistances inside for which temperature factors are given, [m2 K / W]; the second is that for mould (ISO 13788)."""
_LEAST_FLOW_W_M2 = 1e-9
_OF_A_TRIANGLE, _OF_THE_YEAR = 10**6, 10**6 + 1  # Numbers of errors of their own, beyond those of parts


def audit(mesh: TetMesh, conditions: Conditions, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Audit:
    """Answer what a survey asks: heat flow, U-values, thermal bridges and their intervals.

    `up` is a unit vector. Raises `AuditError` if the conditions do not fit the mesh.
    """
    work = _Work(mesh, conditions, up)
    surface, side = work.surface, conditions.side
    surface_c, flow = triangle_exchange(conditions, surface, work.groups, work.stated, up)
    repeatability = conditions.camera.repeatability.off_by
    found = find_defects(surface, surface_c, side == "outside", repeatability)

    patch, names = surface.selection.facet_patch, surface.selection.patch_names
    counted = np.flatnonzero(surface.counted)
    patches = [int(n) for n in np.unique(patch[counted])]
    storey = work.storey_of()
    storeys = [int(n) for n in np.unique(storey[counted]) if n >= 0]
    parts = [counted[patch[counted] == n] for n in patches]
    parts += [counted[storey[counted] == n] for n in storeys]
    parts += [part for one in found for part in (one.zone, one.reference, one.spot)]
    parts.append(_worst(surface, surface_c, side))
    rows = work.groups.rows(parts, surface.area_m2)
    totals, slope = part_totals(conditions, work.groups, work.draws, up, rows), work.slopes(parts)

    # Readings of each patch have an error of their own, those of a storey the errors of the patches in it.
    own = np.stack([slope[n] * work.draws.local(repeatability, n) for n in range(len(patches))])
    models = work.u_by_model(parts[: len(patches)])
    elements = []
    for row, number in enumerate(patches):
        u = {model: float(values[row]) for model, (values, _) in models.items()}
        every = np.flatnonzero(patch == number)
        element = _Part(names[number], parts[row], every, totals.surface_c[row], totals.flow_w[row] + own[row], u)
        elements.append(work.element(element, totals.difference_k))
    of_storeys = []
    for row, number in enumerate(storeys, start=len(patches)):
        every, error = (
            np.flatnonzero((storey == number) & np.isin(patch, patches)),
            _shares(surface, parts[row], parts[: len(patches)]) @ own,
        )
        name = list(conditions.storeys)[number]
        element = _Part(name, parts[row], every, totals.surface_c[row], totals.flow_w[row] + error, {})
        of_storeys.append(work.element(element, totals.difference_k))
    area, whole_flow = totals.area_m2[: len(patches)], totals.flow_w[: len(patches)].sum(axis=0) + own.sum(axis=0)
    mean_c = area @ totals.surface_c[: len(patches)] / area.sum()
    u = {model: mean for model, (_, mean) in models.items()}
    name, every = "all that was observed", np.flatnonzero(np.isin(patch, patches))
    whole = work.element(_Part(name, counted, every, mean_c, whole_flow, u), totals.difference_k)

    defects = []
    first = len(patches) + len(storeys)
    for number, one in enumerate(found):
        figures = PartFigures(totals, slope, work.draws.local(repeatability, first + number))
        at = storey[one.spot[0]]
        where = list(conditions.storeys)[at] if at >= 0 else ""
        defects.append(
            describe_defect(surface, conditions, one, figures, first + 3 * number, where, whole.loss_w.value)
        )
    order = sorted(range(len(found)), key=lambda n: (bool(defects[n].not_counted), -defects[n].extra_w.value))
    found, defects = [found[n] for n in order], [defects[n] for n in order]
    last, check = len(parts) - 1, check_survey(conditions)
    f_rsi = PartFigures(totals, slope, work.draws.local(repeatability, last)).factors(last, side)
    left = {why: float(surface.area_m2[surface.why_not == n].sum()) for n, why in enumerate(WHY_NOT.values())}
    return Audit(
        conditions=conditions,
        surface=surface,
        check=replace(check, doubts=(*check.doubts, *reference_doubts(conditions, work.draws))),
        patches=tuple(elements),
        storeys=tuple(of_storeys),
        whole=whole,
        defects=tuple(defects),
        found=tuple(found),
        limits=_limits(conditions, elements, defects, whole, f_rsi),
        year=_year(conditions, work.draws, whole_flow / totals.difference_k),
        calibration=calibrated(conditions, surface, work.groups, work.draws),
        f_rsi=f_rsi,
        budget=work.budget(own),
        not_counted_m2={why: area for why, area in left.items() if area > 0.0},
        triangle_surface_c=surface_c,
        triangle_flow_w_m2=flow,
        triangle_u=work.triangle_u(),
    )


@dataclass(frozen=True)
class _Part:
    """A part of the surface in every draw."""

    name: str
    counted: IntArray  # Its triangles that count
    every: IntArray  # All of its triangles
    surface_c: FloatArray  # (k,)
    flow_w: FloatArray  # (k,)
    u_by_model: Mapping[str, float]


class _Work:
    """A surface, its groups of triangles, and the draws."""

    def __init__(self, mesh: TetMesh, conditions: Conditions, up: tuple[float, float, float]) -> None:
        self.conditions, self.up = conditions, up
        self.surface: AuditedSurface = audited_surface(mesh, conditions, up)
        self.groups: AlikeTriangles = alike_triangles(self.surface)
        self.draws = with_references(self.surface, conditions, draw(conditions))
        self.stated = Draws({name: values[:1] for name, values in self.draws.values.items()})

    def element(self, part: _Part, difference_k: FloatArray) -> Element:
        """Put figures to a part of the envelope."""
        surface = self.surface
        area = float(surface.area_m2[part.counted].sum())
        uncut = part.every[surface.why_not[part.every] != list(WHY_NOT).index("cut")]
        return Element(
            name=part.name,
            area_m2=area,
            unobserved_m2=max(float(surface.area_m2[uncut].sum()) - area, 0.0),
            surface_c=interval_of(part.surface_c),
            loss_w=interval_of(part.flow_w),
            u_w_m2k=interval_of(part.flow_w / area / difference_k),
            u_by_model=part.u_by_model,
            unsupported_share=float(surface.area_m2[part.counted] @ surface.unsupported[part.counted]) / area,
        )

    def triangle_u(self) -> FloatArray:
        """U-value of each triangle and the ends of its interval, shape (f, 3); NaN where it does not count."""
        off = self.draws.local(self.conditions.camera.repeatability.off_by, _OF_A_TRIANGLE)
        ends, found = (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE), []
        for start in range(0, len(self.groups.reading_c), CHUNK):
            some = self.groups.some(slice(start, start + CHUNK))
            here = exchange(self.conditions, some, self.draws, self.up)
            warmer = exchange(self.conditions, some, self.stated, self.up, HALF_STEP_K)
            slope = (warmer.flow_w_m2 - here.flow_w_m2[:, :1]) / HALF_STEP_K
            u = (here.flow_w_m2 + slope * off) / here.difference_k
            found.append(np.concatenate([u[:, :1], np.quantile(u[:, 1:], ends, axis=1).T], axis=1))
        of_group = np.concatenate(found)
        return np.where(self.surface.counted[:, None], of_group[self.groups.of_triangle], np.nan)

    def slopes(self, parts: Sequence[IntArray]) -> FloatArray:
        """How the heat flow of each part changes with its readings, shape (parts,), [W/K]."""
        rows = self.groups.rows(list(parts), self.surface.area_m2)
        low, high = (
            part_totals(self.conditions, self.groups, self.stated, self.up, rows, step)
            for step in (-HALF_STEP_K, HALF_STEP_K)
        )
        return (high.flow_w - low.flow_w)[:, 0] / (2.0 * HALF_STEP_K)

    def u_by_model(self, parts: Sequence[IntArray]) -> dict[str, tuple[FloatArray, float]]:
        """U-values of parts, shape (parts,), and of all together, by each film model from the stated values."""
        rows, found = self.groups.rows(list(parts), self.surface.area_m2), {}
        for model, conditions in other_models(self.conditions):
            one = part_totals(conditions, self.groups, self.stated, self.up, rows)
            per_kelvin = one.flow_w[:, 0] / one.difference_k[0]
            found[model] = per_kelvin / one.area_m2, float(per_kelvin.sum() / one.area_m2.sum())
        return found

    def storey_of(self) -> IntArray:
        """Number of the storey of each triangle, in the order of the conditions; -1 below all and without storeys."""
        begins = np.array([what.value for what in self.conditions.storeys.values()])
        order = np.argsort(begins, kind="stable")
        place = np.searchsorted(begins[order], self.surface.height_m + 1e-9, side="right")
        return np.concatenate([[-1], order])[place].astype(np.int64)

    def budget(self, own: FloatArray) -> dict[str, float]:
        """How far each uncertain quantity alone moves the loss from one end of its range to the other, [W]."""
        rows, found = self.groups.rows([np.flatnonzero(self.surface.counted)], self.surface.area_m2), {}
        for name, stated in one_at_a_time(self.conditions):
            draws = with_references(self.surface, self.conditions, stated)
            found[name] = float(np.ptp(part_totals(self.conditions, self.groups, draws, self.up, rows).flow_w[0][1:]))
        if self.conditions.camera.repeatability.off_by > 0.0:
            found["camera repeatability"] = float(np.ptp(own.sum(axis=0)))
        return dict(sorted(found.items(), key=lambda item: -item[1]))


def verdict(found: Interval, limit: float, at_most: bool = True) -> Verdict:
    """Say whether an interval lies within a limit, beyond it, or on both sides.

    >>> verdict(Interval(0.3, 0.2, 0.4), 0.5), verdict(Interval(0.3, 0.2, 0.4), 0.25)
    ('met', 'cannot tell')
    """
    low, high, edge = (found.low, found.high, limit) if at_most else (-found.high, -found.low, -limit)
    return "met" if high <= edge else "not met" if low > edge else "cannot tell"


def _worst(surface: AuditedSurface, surface_c: FloatArray, side: str) -> IntArray:
    """Triangles of the square decimetre, no rim, that is warmest from outside or coldest from inside."""
    sure = np.flatnonzero(surface.counted & ~surface.rim)
    sure = sure if len(sure) else np.flatnonzero(surface.counted)
    ranked = sure[np.argsort(surface_c[sure] * (1.0 if side == "inside" else -1.0), kind="stable")]
    enough = int(np.searchsorted(np.cumsum(surface.area_m2[ranked]), SPOT_M2 * (1.0 - 1e-9))) + 1
    return ranked[:enough]


def _shares(surface: AuditedSurface, part: IntArray, patches: Sequence[IntArray]) -> FloatArray:
    """Share of each patch's area that lies in a part, shape (patches,)."""
    within = np.zeros(len(surface.area_m2))
    within[part] = surface.area_m2[part]
    return np.array([within[patch].sum() / surface.area_m2[patch].sum() for patch in patches])


def _limits(
    conditions: Conditions,
    patches: Sequence[Element],
    defects: Sequence[Defect],
    whole: Element,
    f_rsi: tuple[Interval, ...],
) -> tuple[Limit, ...]:
    limits, found = conditions.limits, list[Limit]()

    def judge(name: str, limit: Measured, unit: str, value: Interval, at_most: bool = True) -> None:
        found.append(Limit(name, limit.value, unit, at_most, value, verdict(value, limit.value, at_most)))

    for patch in patches:
        chosen = [limit for pattern, limit in limits.u.items() if matching_names([patch.name], pattern)]
        if chosen:
            judge(f"U-value of {patch.name}", chosen[-1], "W/(m2 K)", patch.u_w_m2k)
    lines = [one for one in defects if one.kind == "line" and not one.not_counted]
    if limits.psi is not None and lines:
        worst = max(lines, key=lambda one: one.coefficient.value)
        judge(f"psi of the worst linear thermal bridge, in {worst.patch}", limits.psi, "W/(m K)", worst.coefficient)
    if limits.f_rsi is not None and f_rsi:
        judge("lowest temperature factor for Rsi = 0.25", limits.f_rsi, "", f_rsi[-1], at_most=False)
    if limits.loss is not None:
        judge("heat loss of what was observed", limits.loss, "W", whole.loss_w)
    return tuple(found)


def _year(conditions: Conditions, draws: Draws, coupling_w_k: FloatArray) -> YearResult | None:
    """Heat, cost and carbon dioxide of a heating season: coupling times degree days times 0.024 kWh / (W d)."""
    year = conditions.year
    if year is None:
        return None

    def drawn(what: Measured, number: int) -> FloatArray:
        return what.value + draws.local(what.off_by, _OF_THE_YEAR + number)

    heat = 0.024 * coupling_w_k * drawn(year.degree_days, 0)
    cost = None if year.price is None else interval_of(heat * drawn(year.price, 1))
    co2 = None if year.co2 is None else interval_of(heat * drawn(year.co2, 2))
    return YearResult(interval_of(heat), cost, co2)


@dataclass(frozen=True)
class PartFigures:
    """Parts of the surface in every draw, and the error of one of them that the others do not share."""

    totals: PartTotals
    slope_w_k: FloatArray  # How the heat flow of each part changes with its readings, shape (parts,)
    off_k: FloatArray  # Draws of the error of the part's own readings, shape (k,), [K]

    def flow_w(self, part: int) -> FloatArray:
        """Heat flow of a part with that error, shape (k,)."""
        return self.totals.flow_w[part] + self.slope_w_k[part] * self.off_k

    def factors(self, part: int, side: Side) -> tuple[Interval, ...]:
        """Temperature factors of a part for `F_RSI_M2K_W`; none if seen from outside."""
        if side == "outside":
            return ()
        flow = np.maximum(self.flow_w(part) / max(self.totals.area_m2[part], 1e-12), _LEAST_FLOW_W_M2)
        above = self.totals.surface_c[part] + self.off_k - self.totals.outside_c
        return tuple(interval_of(np.asarray(temperature_factor(above / flow, one))) for one in F_RSI_M2K_W)

    def incidence(self, bridge: int, calm: int, side: Side) -> Interval | None:
        """I_tb = sum A_p (Ta - T_p) / (A (Ta - T_1D)), Ta the air on the side seen (Asdrubali and others).

        None where the undisturbed surface is not on the same side of the air in all draws.
        """
        air = self.totals.inside_c if side == "inside" else self.totals.outside_c
        undisturbed = self.totals.surface_c[calm] - air
        if undisturbed.min() <= 0.0 <= undisturbed.max():
            return None
        return interval_of((self.totals.surface_c[bridge] + self.off_k - air) / undisturbed)


def describe_defect(
    surface: AuditedSurface,
    conditions: Conditions,
    one: FoundDefect,
    figures: PartFigures,
    first_part: int,
    storey: str,
    whole_w: float,
) -> Defect:
    """Put figures to a defect: its zone is the part `first_part`, followed by its reference and its spot.

    Extra heat flow is that of the zone minus what the undisturbed surface near by would lose on the area that the zone
    stands on (psi = q_tb - q_uniform per metre, O'Grady and others 2017; areas are those of the outer surface).
    `whole_w` is the heat flow of all that was observed.
    """
    totals, side = figures.totals, conditions.side
    zone, reference, spot = first_part, first_part + 1, first_part + 2
    calm_w_m2 = totals.flow_w[reference] / max(totals.area_m2[reference], 1e-12)
    extra = figures.flow_w(zone) - calm_w_m2 * one.base_area_m2
    per_kelvin = extra / totals.difference_k / (one.length_m if one.kind == "line" else 1.0)
    extra_w, f_rsi = interval_of(extra), figures.factors(spot, side)
    around_c = float(totals.surface_c[reference, 0])
    area, spot_c = surface.area_m2[one.core], interval_of(totals.surface_c[spot] + figures.off_k)
    x, y, z = np.average(surface.centroid_m[one.core], axis=0, weights=area).tolist()
    return Defect(
        kind=one.kind,
        patch=surface.selection.patch_names[one.patch],
        storey=storey,
        centre_m=(x, y, z),
        height_m=float(np.average(surface.height_m[one.core], weights=area)),
        length_m=one.length_m,
        area_m2=float(area.sum()),
        departure_k=abs(spot_c.value - around_c),
        spot_c=spot_c,
        undisturbed_c=around_c,
        incidence=figures.incidence(zone, reference, side),
        extra_w=extra_w,
        coefficient=interval_of(per_kelvin),
        f_rsi=f_rsi,
        severity=_severity(conditions, extra_w, f_rsi, whole_w),
        not_counted=one.not_counted,
    )


def _severity(conditions: Conditions, extra: Interval, f_rsi: tuple[Interval, ...], whole_w: float) -> Severity:
    limit = conditions.limits.f_rsi
    if f_rsi and limit is not None and f_rsi[-1].high < limit.value:
        return "severe"
    if extra.low <= 0.0 or whole_w <= 0.0:
        return "uncertain"
    share = extra.value / whole_w
    return "severe" if share >= SEVERE_SHARE else "moderate" if share >= MODERATE_SHARE else "slight"
