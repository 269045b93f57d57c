"""Charts as SVG text, for pages that fetch nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, SOFT, LINE, ACCENT = "#1d2430", "#9aa3ae", "#e1e5ea", "#b3431e"
"""Colours of the pages' style sheet."""


@contextmanager
def chart(width: float, height: float, rows: int = 1) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure whose axes stand one above the other, in the look of the pages; sizes in font heights / 10."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    look: Any = {"svg.hashsalt": "thermoxels", "svg.fonttype": "none", "font.size": 10}
    look |= {"axes.spines.top": False, "axes.spines.right": False}
    with rc_context(look):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(figure)
        axes = np.atleast_1d(figure.subplots(rows, 1, sharex=True)).tolist()
        for axis in axes:
            axis.grid(color=LINE, linewidth=0.6)
            axis.set_axisbelow(True)
        yield figure, axes


def svg_text(figure: Figure) -> str:
    """Write a figure as an svg element, the same for the same figure."""
    text = StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :].rstrip()


def histogram(values: npt.NDArray, label: str, limits: tuple[float, float] | None = None) -> str:
    """Draw how often finite values occur between limits, None: all, as an svg element; empty without values."""
    values = values[np.isfinite(values)]
    if not values.size:
        return ""
    with chart(7.0, 2.2) as (figure, (axis,)):
        axis.hist(values, bins=60, range=limits, color=ACCENT, alpha=0.8)
        axis.set_xlabel(label)
        return svg_text(figure)


def bars(values: Sequence[float], label: str) -> str:
    """Draw one bar per item, from zero up or down, as an svg element; empty without values."""
    if not len(values):
        return ""
    with chart(7.0, 2.2) as (figure, (axis,)):
        axis.bar(np.arange(1, len(values) + 1), values, color=ACCENT, alpha=0.8)
        axis.axhline(0.0, color=SOFT, linewidth=0.8)
        axis.set_xlabel(label)
        return svg_text(figure)


def curves_over_time(
    times: npt.NDArray,
    unit: str,
    curves: Sequence[tuple[str, npt.NDArray]],
    band: tuple[str, npt.NDArray, npt.NDArray],
    steps: Sequence[tuple[str, npt.NDArray]],
    labels: tuple[str, str],
) -> str:
    """Draw curves, and below them means over the intervals between the times, as an svg element.

    Times and `curves`, the most important one first, have shape (s + 1,), as lowest and highest values of `band`;
    means, the most important one last, have shape (s,). `labels` are those of the upper and the lower vertical axis.
    """
    with chart(10.5, 7.0, rows=2) as (figure, (above, below)):
        name, low, high = band
        above.fill_between(times, low, high, color="#e9dcd6", label=name)
        for number, (name, values) in enumerate(curves):
            above.plot(times, values, label=name, **({"color": INK, "linewidth": 2} if number == 0 else {}))
        below.axhline(0.0, color=SOFT, linewidth=0.8)
        for number, (name, values) in enumerate(steps):
            last = number == len(steps) - 1
            colour, width = (INK, 2.0) if last else (None, 1.4)
            below.stairs(values, times, baseline=None, label=name, color=colour, linewidth=width)
        below.set_xlabel(f"time [{unit}]")
        below.set_xlim(times[0], times[-1])
        for axis, label in zip((above, below), labels):
            axis.set_ylabel(label)
            axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8.5)
        return svg_text(figure)
