"""Build the page of a heat run, with its charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from io import StringIO
from typing import Any

import numpy as np

from thermoxels_ns.fem.problem import Varying, effect_labels
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.heat.effects import Effect
from thermoxels_ns.heat.run import HeatRun, mesh_error_in_words
from thermoxels_ns.heat.scene import unit_of
from thermoxels_ns.reports.numbers import point_text, time_unit, unit_signs
from thermoxels_ns.reports.page import Report, build_page

INK, SOFT, LINE = "#1d2430", "#9aa3ae", "#e1e5ea"
"""Colours of the pages' style sheet, ``templates/page.css``."""
_MOST_CURVES = 8  # Most probes or effects in one plot; more curves look alike


def heat_page(
    run: HeatRun, pictures: Mapping[str, bytes], mesh_name: str, command: str, files: Sequence[str], report: Report
) -> str:
    """Return a heat run's page as html; `pictures` are PNG contents by file name, `files` names of files beside it."""
    solution = run.solution
    names = [f"{point_text(point)} m" for point in run.probes_m]
    return build_page(
        "heat.html.j2",
        run=run,
        probes=list(zip(names, run.probes_c.T)),
        plot=plot_over_time(run, solution, names) if isinstance(solution, HeatSolution) else "",
        pictures=pictures,
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
    """Return the quantities of an effect as text with units; quantities that have their default are left out."""
    shown = []
    for field in fields(effect)[1:]:  # type: ignore[arg-type]
        value, unit = getattr(effect, field.name), unit_of(field.name) or "1"
        if value == field.default:
            continue
        name = field.name.rsplit("_w_m", 1)[0].removesuffix("_c").removesuffix("_m2k").replace("_", " ")
        unit = {"1": "", "C": " °C"}.get(unit, f" {unit_signs(unit)}")
        shown.append(f"{name} varies" if isinstance(value, Varying) else f"{name} {value:g}{unit}")
    return "; ".join(shown)


def plot_over_time(run: HeatRun, solution: HeatSolution, probe_names: Sequence[str]) -> str:
    """Return charts of temperatures over time and, below, of each effect's heat flow, as one svg element.

    `solution` is that of the run. Heat flows are means over the intervals between its times.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    look: Any = {"svg.hashsalt": "thermoxels", "svg.fonttype": "none", "font.size": 10}
    look |= {"axes.spines.top": False, "axes.spines.right": False}
    unit, length_s = time_unit(float(solution.times_s[-1]))
    times, states = solution.times_s / length_s, solution.temperature_c
    strongest = sorted(solution.effects, key=lambda heat: -np.abs(heat.heat_w).max(initial=0.0))
    acting = [heat for heat in strongest if np.any(heat.heat_w)][:_MOST_CURVES]
    with rc_context(look):
        figure = Figure(figsize=(10.5, 7.0), layout="constrained")
        FigureCanvasSVG(figure)
        above, below = figure.subplots(2, 1, sharex=True)
        above.fill_between(times, states.min(axis=1), states.max(axis=1), color="#e9dcd6", label="coldest to hottest")
        above.plot(times, run.mean_c, label="mean of the volume", color=INK, linewidth=2)
        for name, values in list(zip(probe_names, run.probes_c.T))[:_MOST_CURVES]:
            above.plot(times, values, label=name.replace("$", r"\$"))  # matplotlib would read $ as a formula
        below.axhline(0.0, color=SOFT, linewidth=0.8)
        for heat in acting:
            below.stairs(heat.heat_w, times, baseline=None, label=heat.effect.replace("$", r"\$"), linewidth=1.4)
        below.stairs(solution.heat_w, times, baseline=None, label="all together: stored", color=INK, linewidth=2)
        below.set_xlabel(f"time [{unit}]")
        below.set_xlim(times[0], times[-1])
        for axis, label in ((above, "temperature [°C]"), (below, "heat flow into the body [W]")):
            axis.set_ylabel(label)
            axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8.5)
            axis.grid(color=LINE, linewidth=0.6)
            axis.set_axisbelow(True)
        text = StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()[text.getvalue().index("<svg") :].rstrip()
