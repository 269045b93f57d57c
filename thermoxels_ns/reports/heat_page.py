"""Build the page of a heat run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np

from thermoxels_ns.fem.problem import AdaptiveSteps, TimeSteps, effect_labels
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.tolerance import ToleratedSolution
from thermoxels_ns.heat.effects import Effect, FixedTemperature, InternalHeat
from thermoxels_ns.heat.materials import materials_by_region
from thermoxels_ns.heat.run import HeatRun, mesh_error_in_words
from thermoxels_ns.reports.charts import plot_over_time
from thermoxels_ns.reports.numbers import duration_text, flow_text, least_flow, unit_signs
from thermoxels_ns.reports.page import Report, build_page

_CAPTIONS = {
    "surface-start.png": "The surface at the start.",
    "surface-end.png": "The surface at the end. Colours span the surface that photographs show.",
    "surface-change.png": "What changed.",
    "cut.png": "Cut through the middle at the end. Colours span the whole body.",
}


def heat_page(
    run: HeatRun, pictures: Mapping[str, bytes], mesh_name: str, command: str, files: Sequence[str], report: Report
) -> str:
    """Return a heat run's page as html; `pictures` are PNG contents by file name, `files` names of files beside it."""
    results, solution, accuracy = run.results, run.solution, run.accuracy
    flows = [flow for effect in results.effects for flow in (effect.heat_w, effect.last_heat_w)]
    least_w = least_flow(flows, sum(patch.area_m2 for patch in results.patches))
    duration_s = 1.0 if results.balance.unit == "W" else float(run.nodes.times_s[-1] - run.nodes.times_s[0])
    residual = results.balance.residual
    names = [f"({', '.join(f'{part:.4g}' for part in point)}) m" for point in run.probes.points_m]
    over_time = isinstance(solution, HeatSolution)
    selection, labels = Selection(run.problem.mesh, run.problem.up), effect_labels(run.problem)
    return build_page(
        "heat.html.j2",
        run=run,
        flow=lambda heat_w, per_area=None: flow_text(heat_w, least_w, per_area),
        probes=list(zip(names, run.probes_c.T)),
        plot=plot_over_time(solution, run.mean_c, run.probes_c, names) if over_time else "",
        pictures=[
            (png, _CAPTIONS[name].replace(" at the end", "") if run.scene.steady else _CAPTIONS[name])
            for name, png in pictures.items()
        ],
        mesh_name=mesh_name,
        mesh_error=mesh_error_in_words(solution),
        followed=_how_time_was_followed(run.scene.time, accuracy),
        materials=materials_by_region(run.problem),
        effects=[(label, _values(effect, selection)) for label, effect in zip(labels, run.problem.effects)],
        residual=0.0 if abs(residual) < least_w * duration_s else residual,
        effort=_effort(run),
        report=report,
        command=command,
        files=files,
    )


def _values(effect: Effect, selection: Selection) -> str:
    """Return the quantities of an effect as text with units, without quantities at their default."""
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
            if isinstance(effect, InternalHeat):
                places = selection.tet_places(selection.tets(effect.where))
            else:
                places = selection.facet_places(selection.facets(effect.where))
            values = effect.bounded(field.name).at(places, 0.0)
            changes = ", changes with time" if value.in_time else ""
            ends = dict.fromkeys(f"{end:.3g}" for end in (values.min(), values.max())) if len(values) else ("nowhere",)
            shown.append(f"{name} {' to '.join(ends)}{unit}{changes}")
    return "; ".join(shown)


def _how_time_was_followed(time: TimeSteps | AdaptiveSteps | None, accuracy: ToleratedSolution | None) -> str:
    """Return words on the time steps of a run: steady, chosen by a tolerance, or as in the scene."""
    if time is None:
        return "the steady state"
    if accuracy is not None:
        may_err = f"they may err by {accuracy.settings.step_tolerance_k:.2g} K"
        return f"{duration_text(float(time.times_s[-1]))} in steps chosen by the tolerance ({may_err})"
    if isinstance(time, TimeSteps):
        return f"{time.steps} steps of {time.step_seconds:g} s"
    return f"{duration_text(time.duration_s)} in steps that keep within {time.tolerance_k:g} K"


def _effort(run: HeatRun) -> str:
    """Return a sentence on the time steps and the iterations that the solver took."""
    solution, newton = run.solution, int(np.sum(run.solution.newton_iterations))
    words = [f"{int(np.sum(solution.iterations)):,} iterations of the linear solver"]
    if isinstance(solution, HeatSolution):
        words.insert(0, f"{solution.steps} steps in time")
        if np.isfinite(solution.time_error_k):
            words.append(f"error of the steps estimated at {solution.time_error_k:.2g} K")
    words.append(f"{newton} Newton steps" if newton else "no Newton steps")
    return f"{', '.join(words)}."
