"""Build the page of a heat run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np

from thermoxels_ns.fem.problem import Varying, effect_labels
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.heat.effects import Effect
from thermoxels_ns.heat.run import HeatRun, mesh_error_in_words
from thermoxels_ns.heat.scene import unit_of
from thermoxels_ns.reports.charts import plot_over_time
from thermoxels_ns.reports.numbers import point_text, unit_signs
from thermoxels_ns.reports.page import Report, build_page

_CAPTIONS = {
    "surface-end.png": "The surface at the end. Colours span the surface that photographs show.",
    "cut.png": "Cut through the middle at the end. Colours span the whole body.",
}


def heat_page(
    run: HeatRun, pictures: Mapping[str, bytes], mesh_name: str, command: str, files: Sequence[str], report: Report
) -> str:
    """Return a heat run's page as html; `pictures` are PNG contents by file name, `files` names of files beside it."""
    solution = run.solution
    names = [f"{point_text(point)} m" for point in run.probes_m]
    over_time = isinstance(solution, HeatSolution)
    return build_page(
        "heat.html.j2",
        run=run,
        probes=list(zip(names, run.probes_c.T)),
        plot=plot_over_time(solution, run.mean_c, run.probes_c, names) if over_time else "",
        pictures=[
            (png, _CAPTIONS[name].replace(" at the end", "") if run.scene.steady else _CAPTIONS[name])
            for name, png in pictures.items()
        ],
        mesh_name=mesh_name,
        mesh_error=mesh_error_in_words(solution),
        effects=[(label, _values(effect)) for label, effect in zip(effect_labels(run.problem), run.problem.effects)],
        linear_steps=int(np.sum(solution.iterations)),
        newton_steps=int(np.sum(solution.newton_iterations)),
        report=report,
        command=command,
        files=files,
    )


def _values(effect: Effect) -> str:
    """Return the quantities of an effect as text with units, without quantities at their default."""
    shown = []
    for field in fields(effect)[1:]:  # type: ignore[arg-type]
        value, unit = getattr(effect, field.name), unit_of(field.name) or "1"
        if value == field.default:
            continue
        name = field.name.rsplit("_w_m", 1)[0].removesuffix("_c").removesuffix("_m2k").replace("_", " ")
        unit = {"1": "", "C": " °C"}.get(unit, f" {unit_signs(unit)}")
        shown.append(f"{name} varies" if isinstance(value, Varying) else f"{name} {value:g}{unit}")
    return "; ".join(shown)
