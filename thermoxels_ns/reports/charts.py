"""Draw charts as SVG text, which pages can contain, and show temperatures in colours."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.reports.numbers import time_unit

INK, SOFT, LINE = "#1d2430", "#9aa3ae", "#e1e5ea"
"""Colours of the pages' style sheet, ``templates/page.css``."""

PERCENTILES = (2.0, 98.0)  # Percentiles of a thermal image's temperatures at its darkest and brightest colour
_MOST_CURVES = 8  # Most probes or effects in one plot; more curves look alike


def plot_over_time(solution: HeatSolution, mean_c: FloatArray, probes_c: FloatArray, probe_names: Sequence[str]) -> str:
    """Return charts of temperatures and, below, of each effect's heat flow over time, as an svg element.

    `mean_c` is the mean of the volume, shape (s + 1,); `probes_c` has shape (s + 1, p); both are in [degrees Celsius].
    Heat flows are means over the intervals between the s + 1 times.
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
        above.plot(times, mean_c, label="mean of the volume", color=INK, linewidth=2)
        for name, values in list(zip(probe_names, probes_c.T))[:_MOST_CURVES]:
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


def gradient() -> str:
    """Return the colours of `colours`, from dark to bright, as a list for a style sheet."""
    shown = colours(np.linspace(0.0, 1.0, 17)[None], (0.0, 1.0))[0]
    return ", ".join(f"rgb({red} {green} {blue})" for red, green, blue in shown.tolist())


def colours(temperature_c: npt.NDArray, limits: tuple[float, float] | None = None) -> npt.NDArray[np.uint8]:
    """Return colours, (h, w, 3), of temperatures, (h, w), from `limits` (default: `PERCENTILES`); black where NaN."""
    import cv2

    known = np.isfinite(temperature_c)
    if limits is None:
        low, high = np.percentile(temperature_c[known], PERCENTILES) if known.any() else (0.0, 1.0)
    else:
        low, high = limits
    share = np.nan_to_num((temperature_c - low) / max(float(high - low), 1e-6))
    levels = np.clip(255 * share, 0, 255).astype(np.uint8)
    shown = np.array(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1], dtype=np.uint8)
    shown[~known] = 0
    return shown
