"""What the report of a heat computation says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from thermoxels_ns.fem.problem import AdaptiveSteps, TimeSteps, effect_labels
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.heat.effects import Effect, FixedTemperature, InternalHeat
from thermoxels_ns.heat.materials import materials_by_region
from thermoxels_ns.heat.results import Spot
from thermoxels_ns.heat.run import HeatRun, mesh_error_in_words
from thermoxels_ns.heat.solving import Accuracy
from thermoxels_ns.reports.heat_numbers import RoundOff, coordinate, degrees, figure, round_off_of, unit_signs
from thermoxels_ns.reports.heat_pictures import in_words, plot_over_time
from thermoxels_ns.reports.page import Gallery, Page, Picture, Section, Table

_CAPTIONS = {
    "surface-start.png": "The surface at the start.",
    "surface-end.png": "The surface at the end. Colours span the surface that photographs show.",
    "surface-change.png": "What changed.",
    "cut.png": "Cut through the middle at the end. Colours span the whole body.",
}
_LARGE_K = 100.0


def heat_page(run: HeatRun, pictures: Mapping[str, bytes], mesh_name: str, command: str, files: Sequence[str]) -> Page:
    """Put a run into words; `pictures` are PNG files by name, `command` made it, `files` lie beside the page."""
    sections = [*_wall(run), _results(run), *_probes(run)]
    if isinstance(run.solution, HeatSolution):
        plot = plot_over_time(run.solution, run.mean_c, run.probes_c, _probe_names(run))
        words = ("Heat flows are means over each interval between two kept times.",)
        sections.append(Section("Over time", words=words, svg=plot))
    if pictures:
        captioned = tuple(
            Picture(png, _CAPTIONS[name].replace(" at the end", "") if run.scene.steady else _CAPTIONS[name])
            for name, png in pictures.items()
        )
        sections.append(Section("Pictures", galleries=(Gallery(captioned),)))
    sections += [_asked(run, mesh_name), _balance(run), *_accuracy(run.accuracy), _built(run)]
    sections.append(_made(run, command, files))
    return Page(
        title=run.scene.description or "Heat flow",
        summary=_summary(run),
        in_short=_in_short(run),
        figures=_figures(run),
        sections=tuple(sections),
        warnings=run.warnings,
    )


def _in_short(run: HeatRun) -> tuple[str, ...]:
    """Where heat is lost and gained most, and what the inner surface is like."""
    round_off, words = _round_off(run), []
    lost = sorted((one for one in run.results.effects if one.heat_w < 0.0), key=lambda one: one.heat_w)
    whole = sum(one.heat_w for one in lost)
    often = "" if run.scene.steady else " on average"
    if round_off.flow(whole) not in ("0", "-0"):
        most, share = lost[0], 100.0 * lost[0].heat_w / whole
        by = f"most by {most.effect}: {share:.0f} %" if len(lost) > 1 else f"all by {most.effect}"
        words.append(f"The body loses {round_off.flow(-whole)} W{often}, {by}.")
    through = min(run.results.patches, key=lambda one: one.heat_w, default=None)
    if through is not None and through.heat_w < 0.0 and len(run.results.patches) > 1:
        per_area = round_off.per_area(-through.heat_w_m2, through.heat_w)
        words.append(
            f"Of all patches {through.patch} loses most: {round_off.flow(-through.heat_w)} W, {per_area} W/m² on "
            f"{figure(through.area_m2)} m²."
        )
    if run.wall is not None:
        words.append(
            f"The inner surface is coldest at {degrees(run.wall.coldest.temperature_c)} °C "
            f"{_place(run.wall.coldest)}, at {run.wall.inside_c:g} °C inside and {run.wall.outside_c:g} °C outside."
        )
    return tuple(words)


def _summary(run: HeatRun) -> str:
    mesh = run.solved.mesh
    kind = "quadratic tetrahedra" if run.nodes.quadratic else "tetrahedra"
    what = f"A body of {len(mesh.tets):,} {kind}"
    if run.scene.time is None:
        what += " in its steady state."
    else:
        what += f", followed for {in_words(float(run.scene.time.times_s[-1]))}."
    return what if run.accuracy else f"{what} Error of the mesh: {mesh_error_in_words(run.solution)}."


def _figures(run: HeatRun) -> tuple[tuple[str, str], ...]:
    """The figures that matter most."""
    results, cards, round_off = run.results, [], _round_off(run)
    steady = run.scene.steady
    lost = -sum(effect.heat_w for effect in results.effects if effect.heat_w < 0.0)
    won = sum(effect.heat_w for effect in results.effects if effect.heat_w > 0.0)
    cards.append((f"{round_off.flow(lost)} W", "heat loss" if steady else "mean heat loss"))
    if not steady:
        cards.append((f"{round_off.flow(won)} W", "mean heat gain"))
    if run.wall is not None:
        cards.append((f"{run.wall.u_value_w_m2k:.3f} {unit_signs('W/(m2 K)')}", "mean U-value of the inner surface"))
        cards.append((f"{run.wall.temperature_factor:.3f}", "surface temperature factor f_Rsi"))
    cards.append((f"{degrees(results.coldest.temperature_c)} °C", f"coldest spot {_place(results.coldest)}"))
    cards.append((f"{degrees(results.hottest.temperature_c)} °C", f"hottest spot {_place(results.hottest)}"))
    accuracy = run.accuracy
    if accuracy is not None:
        met = "within the tolerance" if accuracy.met else "NOT within the tolerance"
        if accuracy.tolerance_k is None:
            cards.append((f"{100.0 * accuracy.estimated_flow:.2g} %", f"estimated error of the heat flow, {met}"))
        else:
            cards.append((f"{accuracy.estimated_k:.2g} K", f"estimated error of temperatures, {met}"))
    return tuple(cards)


def _results(run: HeatRun) -> Section:
    results, steady, round_off = run.results, run.scene.steady, _round_off(run)
    flow = "W" if steady else "mean W"
    last = () if steady else ("last interval W",)
    effects = Table(
        ("What acts", "area m²", flow, "W/m²", *last),
        tuple(
            (
                effect.effect,
                "" if effect.area_m2 is None else figure(effect.area_m2),
                round_off.flow(effect.heat_w),
                "" if effect.heat_w_m2 is None else round_off.per_area(effect.heat_w_m2, effect.heat_w),
                *(() if steady else (round_off.flow(effect.last_heat_w),)),
            )
            for effect in results.effects
        ),
        note="Heat flows are positive into the body; what is lost is negative.",
    )
    patches = Table(
        (
            *("Patch", "area m²", flow, "W/m²", *last),
            *("mean °C", "coldest °C", "hottest °C"),
        ),
        tuple(
            (
                *(patch.patch, figure(patch.area_m2)),
                *(round_off.flow(patch.heat_w), round_off.per_area(patch.heat_w_m2, patch.heat_w)),
                *(() if steady else (round_off.flow(patch.last_heat_w),)),
                *(degrees(patch.mean_c), _warm_and_where(patch.coldest), _warm_and_where(patch.hottest)),
            )
            for patch in results.patches
        ),
        note="Areas are those of the true surface." + ("" if steady else " Temperatures are those at the end."),
    )
    regions = Table(
        (
            *("Region", "material", "volume m³", "surface m²", "W"),
            *("W/m²", "mean °C", "from °C", "to °C"),
        ),
        tuple(
            (
                *(region.region, region.material, figure(region.volume_m3), figure(region.area_m2)),
                *(round_off.flow(region.heat_w), round_off.per_area(region.heat_w_m2, region.heat_w)),
                *(degrees(region.mean_c), degrees(region.min_c), degrees(region.max_c)),
            )
            for region in results.regions
        ),
        figures_from=2,
        note="Heat flow through the region's own part of the surface" + ("." if steady else ", at the end."),
    )
    return Section("Answers", tables=(effects, patches, regions))


def _wall(run: HeatRun) -> list[Section]:
    if run.wall is None:
        return [Section("As a wall", words=(run.no_wall,))] if run.no_wall else []
    wall = run.wall
    words = (
        f"Between {wall.inside_c:g} °C inside and {wall.outside_c:g} °C outside, "
        f"{figure(wall.heat_w)} W flow into the inner surface of {figure(wall.area_m2)} m²: a "
        f"thermal coupling of {figure(wall.coupling_w_k)} W/K. The inner surface is worst at "
        f"{degrees(wall.coldest.temperature_c)} °C {_place(wall.coldest)}, which is a temperature factor "
        f"of {wall.temperature_factor:.3f} (1: as warm as the air inside). For the risk of mould ISO 13788 asks for "
        "it with a resistance of the inner surface of 0.25 m² K/W, coefficient_w_m2k: 4.",
    )
    columns = ("Inner surface", "area m²", "W", "U-value W/(m² K)")
    rows = [(p.name, figure(p.area_m2), figure(p.heat_w), f"{p.u_value_w_m2k:.4f}") for p in wall.patches]
    if len(wall.regions) > 1:
        rows += [
            (f"region {p.name}", figure(p.area_m2), figure(p.heat_w), f"{p.u_value_w_m2k:.4f}") for p in wall.regions
        ]
    note = "Heat flow per area of the inner surface and difference of the airs."
    return [Section("As a wall", words=words, tables=(Table(columns, tuple(rows), note=note),))]


def _probes(run: HeatRun) -> list[Section]:
    if not len(run.probes.points_m):
        return []
    names, values = _probe_names(run), run.probes_c
    if len(values) == 1:
        rows = tuple((name, f"{value:.3f}") for name, value in zip(names, values[0]))
        return [Section("Probes", tables=(Table(("Point", "°C"), rows),))]
    rows = tuple(
        (name, *(f"{value:.3f}" for value in (column[0], column[-1], column.min(), column.max())))
        for name, column in zip(names, values.T)
    )
    columns = ("Point", "start °C", "end °C", "lowest", "highest")
    return [Section("Probes", tables=(Table(columns, rows, note="All times stand in series.csv."),))]


def _balance(run: HeatRun) -> Section:
    balance = run.results.balance
    scale, unit = (1.0, "W") if balance.unit == "W" else (3.6e6, "kWh")
    duration_s = float(run.nodes.times_s[-1] - run.nodes.times_s[0])
    round_off = _round_off(run).below_w * (1.0 if balance.unit == "W" else duration_s)
    left = 0.0 if abs(balance.residual) < round_off else balance.residual
    rows = (
        ("into the body", f"{figure(balance.into_body / scale)} {unit}"),
        ("out of the body", f"{figure(balance.out_of_body / scale)} {unit}"),
        ("stored in it", f"{figure(balance.stored / scale)} {unit}"),
        ("stored - in + out: accounted for by nothing", f"{figure(left / scale)} {unit}"),
        ("the same as a share", f"{balance.relative_residual:.1e}"),
        ("left unbalanced at nodes by the solver", f"up to {balance.unbalanced_w:.1e} W"),
    )
    return Section("Energy balance", tables=(Table(("", ""), rows),))


def _asked(run: HeatRun, mesh_name: str) -> Section:
    mesh, scene, time = run.problem.mesh, run.scene, run.scene.time
    start = "the photographs" if scene.initial_c is None else f"{scene.initial_c:g} °C everywhere"
    how = _how_time_was_followed(time, run.accuracy)
    general = Table(
        ("", ""),
        (
            ("mesh", f"{mesh_name}: {len(mesh.tets):,} tetrahedra, {len(mesh.points_m):,} nodes"),
            ("time", how),
            *((("start", start),) if time is not None else ()),
            ("up", ", ".join(f"{part:g}" for part in run.problem.up)),
            ("no heat crosses", ", ".join(scene.adiabatic) or "no patch"),
        ),
        figures_from=2,
    )
    rows = []
    for name, what in materials_by_region(run.problem).items():
        figures = (what.conductivity_w_mk, what.density_kg_m3, what.specific_heat_j_kgk)
        rows.append((name, what.name, *(f"{value:g}" for value in figures)))
    columns = ("Region", "material", "W/(m K)", "kg/m³", "J/(kg K)")
    materials = Table(columns, tuple(rows), figures_from=2)
    selection, labelled = Selection(mesh, run.problem.up), zip(effect_labels(run.problem), run.problem.effects)
    shown = tuple((label, "; ".join(_values(effect, selection))) for label, effect in labelled)
    note = "A range is that over the surface at the start."
    effects = Table(("What the scene names", "with"), shown, figures_from=2, note=note)
    return Section("What was asked", tables=(general, materials, effects))


def _built(run: HeatRun) -> Section:
    screening, words = run.screening, []
    if not run.problem.effects:
        words.append("The scene names nothing that acts on the body: its surface is insulated.")
    elif screening.left_out:
        words.append(
            f"Left out, together they could change temperatures by {screening.bound_k:.2g} K and mean heat flows by "
            f"{screening.bound_w:.2g} W at most; the tolerance is {screening.tolerance_k:g} K. {screening.note}"
        )
        words.append(f"To find out took {screening.seconds:.2f} s.")
    else:
        words.append(f"Nothing could be left out at a tolerance of {screening.tolerance_k:g} K. {screening.note}")
    left = Table(
        ("Left out", "because", "at most K", "at most W"),
        tuple((e.effect, e.reason, f"{e.bound_k:.2g}", f"{e.bound_w:.3g}") for e in screening.left_out),
        figures_from=2,
        note="No temperature and no mean heat flow of what is built would differ by more.",
    )
    kept = Table(
        ("Built", "because", "up to K"),
        tuple((e.effect, e.reason, _up_to(e.bound_k)) for e in screening.kept),
        figures_from=2,
    )
    bill = run.solution.assembled
    kinds = ("radiation", "convection", "flux", "source", "fixed", "mass")
    absent = [kind for kind in kinds if kind not in bill.counts]
    assembled = Table(
        ("Assembled", "times", "s"),
        tuple((kind, str(count), f"{bill.seconds.get(kind, 0.0):.3f}") for kind, count in bill.counts.items()),
        note=f"Not there, and at no cost: {', '.join(absent)}." if absent else "",
    )
    return Section("What was built and left out", words=tuple(words), tables=(left, kept, assembled))


def _made(run: HeatRun, command: str, files: Sequence[str]) -> Section:
    solution = run.solution
    words = [f"{int(np.sum(solution.iterations)):,} iterations of the linear solver"]
    if isinstance(solution, HeatSolution):
        words.insert(0, f"{solution.steps} steps in time")
        if np.isfinite(solution.time_error_k):
            words.append(f"error of the steps estimated at {solution.time_error_k:.2g} K")
    newton = int(np.sum(solution.newton_iterations))
    words.append(f"{newton} Newton steps" if newton else "no Newton steps")
    seconds = Table(("Part", "s"), tuple((name, f"{value:.2f}") for name, value in run.seconds.items()))
    said = ", ".join(words)
    said = f"{said[0].upper()}{said[1:]}."
    return Section("How it was made", words=(solution.status, said), tables=(seconds,), lines=(command, *files))


def _values(effect: Effect, selection: Selection) -> list[str]:
    """The quantities of an effect with their units."""
    shown = []
    for field in fields(effect):  # type: ignore[arg-type]
        if field.name not in effect.bounds or getattr(effect, field.name) == field.default:
            continue
        value, unit = getattr(effect, field.name), effect.bounds[field.name].unit
        name = field.name.rsplit("_w_m", 1)[0].removesuffix("_c").removesuffix("_m2k").replace("_", " ")
        unit = {"1": "", "degrees Celsius": " °C"}.get(unit, f" {unit_signs(unit)}")
        if not isinstance(value, Varying):
            shown.append(f"{name} {value:g}{unit}")
        elif isinstance(effect, FixedTemperature):
            shown.append(f"{name} varies")
        else:
            source = isinstance(effect, InternalHeat)
            where = selection.tets(effect.where) if source else selection.facets(effect.where)
            places = selection.tet_places(where) if source else selection.facet_places(where)
            values = effect.bounded(field.name).at(places, 0.0)
            changes = ", changes with time" if value.in_time else ""
            ends = dict.fromkeys(f"{end:.3g}" for end in (values.min(), values.max())) if len(values) else ("nowhere",)
            shown.append(f"{name} {' to '.join(ends)}{unit}{changes}")
    return shown


def _round_off(run: HeatRun) -> RoundOff:
    results = run.results
    flows = [flow for effect in results.effects for flow in (effect.heat_w, effect.last_heat_w)]
    return round_off_of(flows, sum(patch.area_m2 for patch in results.patches))


def _probe_names(run: HeatRun) -> list[str]:
    return [f"({', '.join(f'{part:.4g}' for part in point)}) m" for point in run.probes.points_m]


def _place(spot: Spot) -> str:
    where = f"at ({', '.join(map(coordinate, spot.point_m))}) m"
    return where if spot.patches else f"{where}, inside"


def _warm_and_where(spot: Spot) -> str:
    return f"{degrees(spot.temperature_c)}\n{_place(spot)}"


def _up_to(bound_k: float | None) -> str:
    """A bound of what is kept; how far a large one is above the tolerance says nothing."""
    if bound_k is None or bound_k > _LARGE_K:
        return f"> {_LARGE_K:g}" if bound_k is not None else ""
    return f"{bound_k:.2g}"


def _accuracy(accuracy: Accuracy | None) -> list[Section]:
    """Say what the error is, what was chosen, and all solutions on the way; nothing without a tolerance."""
    if accuracy is None:
        return []
    asked = [] if accuracy.tolerance_k is None else [f"{accuracy.tolerance_k:g} K"]
    asked += [] if accuracy.flow_tolerance is None else [f"{100.0 * accuracy.flow_tolerance:g} % of the heat flow"]
    met = "Met" if accuracy.met else "Not met"
    words = [f"{met}: a tolerance of {' and '.join(asked)}. {accuracy.status}"]
    if accuracy.left_out_k > 0.0:
        words.append(
            f"Of the error, {accuracy.left_out_k:.2g} K at most are what is left out; the solver had the rest of the "
            "tolerance."
        )
    if accuracy.order == 2:
        words.append(
            "Tetrahedra are quadratic, with a temperature in the middle of every edge. Files, pictures and extremes "
            "show those too, on the mesh with all edges halved; heat flows are those of the quadratic tetrahedra."
        )
    words.append(
        "The estimate is of the error in solving the heat equation in the body as the mesh describes it, usually right "
        "to a factor of three. How far the mesh, its materials and the scene are from the real thing is not in it."
    )
    columns = ("Solution", "unknowns", "error K", "error of heat flow %", "s")
    note = "Estimated errors. The last one is the result."
    return [
        Section(
            "Accuracy", words=tuple(words), tables=(Table(columns, tuple(map(_level, accuracy.levels)), note=note),)
        )
    ]


def _how_time_was_followed(time: TimeSteps | AdaptiveSteps | None, accuracy: Accuracy | None) -> str:
    """Say in words how a body was followed, by the scene's own steps or to a tolerance."""
    if time is None:
        return "the steady state"
    if accuracy is not None:
        duration = in_words(float(time.times_s[-1]))
        return f"{duration} in steps chosen by the tolerance (they may err by {accuracy.step_tolerance_k:.2g} K)"
    if isinstance(time, TimeSteps):
        return f"{time.steps} steps of {time.step_seconds:g} s"
    return f"{in_words(time.duration_s)} in steps that keep within {time.tolerance_k:g} K"


def _level(level: dict[str, Any]) -> tuple[str, ...]:
    kind = "linear tetrahedra" if level["order"] == 1 else "quadratic tetrahedra"
    mesh = "given mesh" if level["refinements"] == 0 else f"mesh size halved {level['refinements']}x"
    steps = "" if level["step_tolerance_k"] is None else f", steps to {level['step_tolerance_k']:.2g} K"
    error = level["error"]
    return (
        f"{kind}, {mesh}{steps}",
        f"{level['num_nodes']:,}",
        f"{error['temperature_k']:.2g}",
        f"{100.0 * error['heat_flow']:.2g}",
        f"{level['seconds']:.2f}",
    )
