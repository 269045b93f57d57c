"""What the page of an audit says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from thermoxels_ns.audit.conditions import Conditions, unknown_name
from thermoxels_ns.audit.defect_figures import F_RSI_M2K_W, MODERATE_SHARE, SEVERE_SHARE
from thermoxels_ns.audit.draws import CONFIDENCE
from thermoxels_ns.audit.results import Audit, Defect, Element, Limit
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.reports.audit_pictures import MOST_DEFECTS, AuditPictures
from thermoxels_ns.reports.heat_numbers import coordinate, unit_signs
from thermoxels_ns.reports.interval_text import area_text, interval_lines, interval_text, number_text
from thermoxels_ns.reports.page import Gallery, Page, Picture, Section, Table

_KINDS = {"line": "Linear thermal bridge", "point": "Point thermal bridge", "area": "Area of higher heat loss"}
_COEFFICIENTS = {"line": ("psi", "W/(m K)"), "point": ("chi", "W/K"), "area": ("extra loss per kelvin", "W/K")}
_MODELS = {
    "iso-6946": "ISO 6946, convection and radiation apart",
    "iso-6946-combined": "ISO 6946, combined",
    "albatici-tonelli": "Albatici and Tonelli 2010",
    "dallo": "Dall'O and others 2013",
    "madding": "Madding 2008",
    "given": "your own coefficient",
}


@dataclass(frozen=True)
class DefectCard:
    """One defect as a card."""

    number: int
    heading: str
    severity: str
    picture: Picture | None  # Drawn from the model
    photographs: tuple[Picture, ...]  # A photograph and a thermal image
    rows: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class AuditPage(Page):
    """A page with cards of defects and a table of what is asked for."""

    limit_rows: tuple[tuple[str, str, str, str], ...] = ()  # Name, found, limit, verdict
    defects: tuple[DefectCard, ...] = ()
    defects_note: str = ""
    after_defects: tuple[Section, ...] = ()


def audit_page(
    audit: Audit,
    pictures: AuditPictures | None,
    photographs: Mapping[int, tuple[Picture, ...]],
    mesh_name: str,
    command: str,
    files: Sequence[str],
) -> AuditPage:
    """Put an audit into words: the client's questions first, then elements and defects, method and limits last.

    `photographs` are those of defects, by their place.
    """
    conditions = audit.conditions
    return AuditPage(
        title=conditions.title or "Thermographic audit",
        summary=_summary(audit),
        warnings=audit.check.forbidden,
        in_short=_in_short(audit),
        figures=_figures(audit),
        limit_rows=tuple(_limit(one) for one in audit.limits),
        sections=(*_overview(audit, pictures), _envelope(audit), *_calibration(audit, pictures)),
        defects=tuple(
            _card(audit, number, defect, pictures, photographs.get(number - 1, ()))
            for number, defect in enumerate(audit.defects[:MOST_DEFECTS], start=1)
            if not defect.not_counted
        ),
        defects_note=_defects_note(audit),
        after_defects=(
            *_further(audit),
            *_not_believed(audit),
            _conditions(conditions),
            _survey(audit),
            _certainty(audit),
            _method(audit),
            _made(audit, mesh_name, command, files),
        ),
    )


def _summary(audit: Audit) -> str:
    conditions, survey = audit.conditions, audit.conditions.survey
    who = [
        part
        for part in (
            survey.place,
            None if survey.date is None else f"{survey.date:%d %B %Y, %H:%M}",
            f"for {survey.client}" if survey.client else "",
            f"by {survey.operator}" if survey.operator else "",
        )
        if part
    ]
    seen = f"Seen from {conditions.side}, {area_text(audit.whole.area_m2)} m² observed"
    airs = f"{conditions.inside.air.value:g} °C inside, "
    airs += f"{conditions.outside.air.value:g} °C outside" if conditions.outside_known else "outside not known"
    return f"{', '.join(who)}{'. ' if who else ''}{seen}, {airs}."


def _figures(audit: Audit) -> tuple[tuple[str, str], ...]:
    sure = f"{100 * CONFIDENCE:.0f} %"
    cards = [
        (interval_text(audit.whole.loss_w, "W"), f"heat loss of what was observed ({sure} interval in brackets)"),
        (interval_text(audit.whole.u_w_m2k, "W/(m2 K)"), "mean U-value of it"),
    ]
    counted = [one for one in audit.defects if not one.not_counted]
    many = "thermal bridge or defect found" if len(counted) == 1 else "thermal bridges or defects found"
    worse = sum(one.severity in ("severe", "moderate") for one in counted)
    cards.append((str(len(counted)), f"{many}{f', {worse} moderate or severe' if worse else ''}"))
    if audit.f_rsi:
        text = interval_text(audit.f_rsi[-1], "", bounds=False)
        cards.append((text, "lowest temperature factor, Rsi 0.25 (mould)"))
    if audit.year is not None:
        cards.append((interval_text(audit.year.heat_kwh, "kWh"), "a heating season through what was observed"))
        if audit.year.cost is not None and audit.conditions.year is not None:
            cards.append((interval_text(audit.year.cost, audit.conditions.year.currency), "its cost"))
        if audit.year.co2_kg is not None:
            cards.append((interval_text(audit.year.co2_kg, "kg"), "its carbon dioxide"))
    return tuple(cards)


def _in_short(audit: Audit) -> tuple[str, ...]:
    """What was found, what is worst, what is open, and what would make it surer."""
    words, whole = [], audit.whole
    conditions = audit.conditions
    difference = f"{conditions.difference_k:.0f} K between inside and outside"
    if not conditions.outside_known:
        difference = f"{conditions.inside.air.value:g} °C inside"
    if whole.loss_w.unknown:
        words.append(
            f"No heat loss can be told from these readings at {difference}: the surface looks too cold for it."
        )
    else:
        loss, u = interval_text(whole.loss_w, "W"), interval_text(whole.u_w_m2k, "W/(m2 K)")
        u_value = f"; U-value {u}" if conditions.outside_known else ""
        words.append(f"At {difference} the {area_text(whole.area_m2)} m² that were observed lose {loss}{u_value}.")
    if not conditions.outside_known:
        words.append("No U-value, psi or temperature factor can be told, because the air outside is not known.")
    counted = [(n, one) for n, one in enumerate(audit.defects, start=1) if not one.not_counted]
    if counted:
        number, worst = max(counted, key=lambda item: item[1].extra_w.value)
        extra = interval_text(worst.extra_w, "W")
        words.append(f"Worst is number {number}, {_KINDS[worst.kind].lower()} in {worst.patch}: {extra} extra.")
    missed, open_ = (sum(one.verdict == kind for one in audit.limits) for kind in ("not met", "cannot tell"))
    if audit.limits:
        surely = "No limit is surely missed" if open_ else "All limits are met"
        told = [f"{missed} of {len(audit.limits)} limits not met" if missed else surely]
        told += [f"{open_} cannot be judged, because the interval holds the limit"] if open_ else []
        words.append(f"{'; '.join(told)}.")
    named = [name for name, width in audit.budget.items() if width > 0.2 * abs(whole.loss_w.value)][:3]
    if named:
        words.append(f"The answer gets surer most by measuring better: {', '.join(named)}.")
    return tuple(words)


def _limit(one: Limit) -> tuple[str, str, str, str]:
    limit = f"{'at most' if one.at_most else 'at least'} {one.limit:g} {unit_signs(one.unit)}".rstrip()
    return one.name, interval_text(one.found, one.unit, bounds=one.at_most), limit, one.verdict


def _overview(audit: Audit, pictures: AuditPictures | None) -> list[Section]:
    if pictures is None:
        return []
    shown = [
        Picture(png, "Surface temperature; numbers are those of the defects below.") for png in pictures.temperature
    ]
    what = "U-value" if audit.conditions.outside_known else "Heat flow"
    shown += [Picture(png, f"{what} by the stated values, triangle by triangle.") for png in pictures.u_value]
    words = "Drawn from the model. Grey surface does not count: no thermal image shows it, or it was left out."
    return [Section("What was seen", words=(words,), galleries=(Gallery(tuple(shown)),))]


def _envelope(audit: Audit) -> Section:
    columns = ("Element", "area m²", "U-value\nW/(m² K)", "heat loss\nW", "surface\n°C")
    rows = [*map(_element, audit.patches), *map(_element, audit.storeys), _element(audit.whole)]
    note = (
        f"Intervals hold {100 * CONFIDENCE:.0f} % of what the stated uncertainties allow. At most: all that the "
        "measurement says is that it is no more. Areas are those of the model."
    )
    words = []
    left = "; ".join(f"{area_text(area)} m² {why}" for why, area in audit.not_counted_m2.items())
    if left:
        words.append(f"Not in these figures: {left}.")
    if audit.whole.unsupported_share > 0.0:
        words.append(
            f"{100 * audit.whole.unsupported_share:.0f} % of the area was placed by smoothness alone: photographs see "
            "it, but nothing on it says where it is."
        )
    table = Table(columns, tuple(rows), note=note)
    return Section("The envelope, element by element", words=tuple(words), tables=(table,))


def _calibration(audit: Audit, pictures: AuditPictures | None) -> list[Section]:
    found, asked = audit.calibration, audit.conditions.calibrate
    if found is None or asked is None:
        return []
    stated = asked.stated()
    rows = tuple(
        (f"{name}\n{unit_signs(found.units[name])}", interval_lines(value), f"{stated[name].value:g}", most)
        for (name, value), most in zip(found.found.items(), found.moved_most_by.values())
    )
    unknown = {unknown_name(one) for one in asked.unknown}
    known = [
        f"{name} {_measured(one, unit_signs(found.units[name]))}" for name, one in stated.items() if name not in unknown
    ]
    words = [
        "Which properties make the surface temperature that finite elements compute, in steady heat flow through the "
        "mesh as thick as it is, meet the measured one."
    ]
    if found.refused:
        words.append(f"Refused. {found.refused}")
    if known:
        words.append(f"Taken as known: {'; '.join(known)}.")
    words.append(f"Measured and computed then differ by {found.misfit_k:.2f} K (root mean square).")
    table = Table(("Property", "found", "start", "moved most by"), rows)
    shown = () if pictures is None else pictures.misfit
    drawn = tuple(Picture(png, "Where measured and computed differ, the model lacks something.") for png in shown)
    galleries = (Gallery(drawn),) if drawn else ()
    return [Section("Calibration", words=tuple(words), tables=(table,) if rows else (), galleries=galleries)]


def _element(one: Element) -> tuple[str, ...]:
    unseen = f"\n{area_text(one.unobserved_m2)} not observed" if one.unobserved_m2 > 0.005 * one.area_m2 else ""
    return (
        one.name,
        f"{area_text(one.area_m2)}{unseen}",
        interval_lines(one.u_w_m2k),
        interval_lines(one.loss_w),
        interval_lines(one.surface_c, bounds=False),
    )


def _card(
    audit: Audit, number: int, one: Defect, pictures: AuditPictures | None, photographs: tuple[Picture, ...]
) -> DefectCard:
    symbol, unit = _COEFFICIENTS[one.kind]
    where = ", ".join(map(coordinate, one.centre_m))
    storey = f", {one.storey}" if one.storey else ""
    size = f"{one.length_m:.2f} m long" if one.kind == "line" else f"{area_text(one.area_m2)} m²"
    side = "warmer" if audit.conditions.side == "outside" else "colder"
    rows = [
        ("where", f"{one.patch}{storey}, {one.height_m:.1f} m above the lowest point; at ({where}) m"),
        ("size", size),
        (
            "surface",
            f"up to {one.departure_k:.1f} K {side} than the {round(one.undisturbed_c, 1) + 0.0:.1f} °C around it",
        ),
        ("extra heat loss", interval_text(one.extra_w, "W")),
        (symbol, interval_text(one.coefficient, unit)),
    ]
    if one.incidence is not None:
        rows.append(("incidence factor I_tb", interval_text(one.incidence, "", bounds=False)))
    for resistance, factor in zip(F_RSI_M2K_W, one.f_rsi):
        rows.append((f"temperature factor, Rsi {resistance:g}", interval_text(factor, "", bounds=False)))
    shown = pictures.defects[number - 1] if pictures is not None and number <= len(pictures.defects) else None
    drawn = None if shown is None else Picture(shown, f"Defect {number}, drawn from the model.")
    return DefectCard(number, _KINDS[one.kind], one.severity, drawn, photographs, tuple(rows))


def _defects_note(audit: Audit) -> str:
    if not any(not one.not_counted for one in audit.defects):
        return (
            "Nothing departs from its surroundings by more than readings scatter and repeat. That does not rule out "
            "bridges weaker than that."
        )
    return (
        f"Severe: {100 * SEVERE_SHARE:.0f} % of the observed heat loss or more, or surely below the temperature factor "
        f"asked for; moderate: {100 * MODERATE_SHARE:.0f} % or more; uncertain: the interval holds no extra loss at "
        "all. These classes are ours, of no standard. Extra heat loss is what is lost beyond the undisturbed surface "
        "near by, on outer dimensions; bridges nearer than 0.3 m to each other count as one."
    )


def _further(audit: Audit) -> list[Section]:
    """Defects beyond those that have a card."""
    rows = []
    for number, one in enumerate(audit.defects, start=1):
        if number > MOST_DEFECTS and not one.not_counted:
            place = f"{one.patch}\nat ({', '.join(map(coordinate, one.centre_m))}) m"
            size = f"{one.length_m:.2f} m" if one.kind == "line" else f"{area_text(one.area_m2)} m²"
            rows.append((str(number), _KINDS[one.kind], place, size, interval_lines(one.extra_w)))
    table = Table(("No.", "what", "where", "size", "extra heat loss W"), tuple(rows), figures_from=3)
    return [Section("Smaller ones", tables=(table,))] if rows else []


def _not_believed(audit: Audit) -> list[Section]:
    rows = tuple(
        (str(n), _KINDS[one.kind], one.patch, f"({', '.join(map(coordinate, one.centre_m))})", one.not_counted)
        for n, one in enumerate(audit.defects, start=1)
        if one.not_counted
    )
    if not rows:
        return []
    table = Table(("No.", "what", "patch", "at m", "why it does not count"), rows, figures_from=5)
    return [Section("Seen, but not counted", tables=(table,))]


def _conditions(conditions: Conditions) -> Section:
    rows = [
        ("seen from", conditions.side),
        ("air inside", _measured(conditions.inside.air, "°C")),
        ("air outside", _measured(conditions.outside.air, "°C") if conditions.outside_known else "not known"),
    ]
    for name, air in (("inside", conditions.inside), ("outside", conditions.outside)):
        if air.lowest_24h is not None and air.highest_24h is not None:
            ends = f"{air.lowest_24h.value:g} to {air.highest_24h.value:g} °C"
            rows.append((f"air {name} during 24 hours", ends))
    if conditions.outside.wind is not None:
        rows.append(
            ("wind", f"{_measured(conditions.outside.wind, 'm/s')} {conditions.outside.wind_direction}".strip())
        )
    around = conditions.surroundings
    if around.reflected is not None:
        rows.append(("reflected temperature", _measured(around.reflected, "°C")))
    if around.sky is not None:
        rows.append(("clouds", f"{_measured(around.sky.cloud, '')} of the sky"))
        rows.append(("dew point", _measured(around.sky.dew_point, "°C")))
        ground = "as the air" if around.ground is None else _measured(around.ground, "°C")
        rows.append(("ground", ground))
    for surface in conditions.surfaces:
        rows.append((f"emissivity of {', '.join(surface.patches)}", _measured(surface.emissivity, "")))
    for one in conditions.references:
        place = f"({', '.join(map(coordinate, one.at))}) m"
        rows.append((f"measured by contact at {place}", _measured(one.temperature, "°C")))
    camera = conditions.camera
    rows += [
        ("camera", ", ".join(part for part in (camera.model, camera.serial_number) if part) or "not named"),
        ("its readings are off together by", _measured(camera.offset, "K")),
        ("and differ between places by", _measured(camera.repeatability, "K")),
        ("surface coefficient", f"{_MODELS[conditions.film.model]}, times {_measured(conditions.film.factor, '')}"),
    ]
    if conditions.film.coefficient is not None:
        rows.append(("convection", _measured(conditions.film.coefficient, "W/(m² K)")))
    return Section("Conditions", tables=(Table(("", ""), tuple(rows), figures_from=2, look="rows"),))


def _survey(audit: Audit) -> Section:
    survey, rows = audit.conditions.survey, []
    for field in fields(survey):
        value: Any = getattr(survey, field.name)
        if value in (None, ""):
            continue
        if isinstance(value, Measured):
            unit = {"pressure_difference": "Pa", "least_difference_24h": "K"}.get(field.name, "h")
            text = _measured(value, unit)
        else:
            text = value if isinstance(value, str) else f"{value:%Y-%m-%d %H:%M %Z}".strip()
        rows.append((field.name.replace("_", " "), text))
    words = []
    if audit.check.missing:
        words.append(
            f"A report after EN 13187 also says, and this one does not know: {', '.join(audit.check.missing)}."
        )
    table = Table(("", ""), tuple(rows), figures_from=2, look="rows")
    return Section("The survey", words=tuple(words), tables=(table,))


def _certainty(audit: Audit) -> Section:
    loss, bound = abs(audit.whole.loss_w.value) or 1.0, audit.whole.loss_w.at_most or audit.whole.loss_w.unknown
    rows = tuple(
        (name, number_text(width, width), "" if bound else f"{100.0 * width / loss:.0f} %")
        for name, width in audit.budget.items()
        if width > 5e-4 * loss
    )
    budget = Table(
        ("Uncertain", "moves the heat loss by W", "of it"),
        rows,
        note="From the lowest to the highest value that is stated, everything else as stated. What stands first is "
        "worth measuring better.",
    )
    models = Table(
        ("Film model", *(one.name for one in audit.patches), "all"),
        tuple(
            (_MODELS[model], *(f"{one.u_by_model[model]:.2f}" for one in audit.patches), f"{mean:.2f}")
            for model, mean in audit.whole.u_by_model.items()
            if audit.conditions.outside_known
        ),
        note="U-values in W/(m² K) from the stated values. The first is the one that was chosen; how far models "
        "disagree is in the intervals only as far as the stated factor says so.",
    )
    return Section("How sure this is", words=audit.check.doubts, tables=(budget, models))


def _method(audit: Audit) -> Section:
    conditions = audit.conditions
    reflection = (
        "each triangle's view of sky, horizon and ground by its tilt"
        if conditions.surroundings.sky is not None
        else "one reflected temperature for all"
    )
    words = (
        "Readings on the surface of a three-dimensional model are corrected for emissivity and for reflection "
        f"({reflection}). Heat flow follows from the corrected temperature by the film model; the U-value is that heat "
        "flow per area and difference of the airs. A thermal bridge is a place that departs from the temperature that "
        "most of its patch has, or most of it within 1.25 m, by more than three standard deviations, by more than "
        "readings repeat and by more than 0.1 K.",
        "Intervals: every uncertain quantity is drawn a thousand times from its stated range, the same for all of the "
        "surface; the error of each part's own readings is drawn apart.",
        "What this cannot say: heat flow is taken as steady, while heavy walls store heat for hours; air leakage is "
        "not in it, nor what photographs did not show. Reflection is that of matt surfaces; glass and metal mirror. "
        "The total radiation stands for the camera's band, in which a clear sky is colder. Seen from outside, an "
        "insulated wall is hardly warmer than the air: then the result is an upper bound. Published comparisons of "
        "single U-values from thermography with calculated ones differ by 0 to 30 %.",
    )
    return Section("Method and its limits", words=words)


def _made(audit: Audit, mesh_name: str, command: str, files: Sequence[str]) -> Section:
    mesh = audit.surface.mesh
    words = (
        f"From {mesh_name}: {len(mesh.tets):,} tetrahedra, {len(mesh.facets):,} boundary triangles, of which "
        f"{int(audit.surface.counted.sum()):,} count. Positions are in the coordinates of that mesh.",
    )
    return Section("How it was made", words=words, lines=(command, *files))


def _measured(value: Measured, unit: str) -> str:
    off = f" ± {value.off_by:g}" if value.off_by else ""
    return f"{value.value:g}{off} {unit}".strip()
