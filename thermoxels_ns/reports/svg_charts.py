"""Small charts as SVG text, for a page that fetches nothing."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
import numpy.typing as npt

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 640, 180, 56, 34, 10


def histogram(values: npt.NDArray, label: str, bins: int = 60, limits: tuple[float, float] | None = None) -> str:
    """Bars of how often values occur.

    Args:
        values: Numbers of any shape; those that are not finite do not count.
        label: What the horizontal axis is, with its unit.
        bins: Number of bars.
        limits: From and to; None: all values.
    """
    values = values[np.isfinite(values)]
    if not values.size:
        return "<p>No values.</p>"
    low, high = limits or (float(values.min()), float(values.max()))
    if not high > low:
        high = low + 1.0
    counts, _ = np.histogram(values, bins=bins, range=(low, high))
    step = (_WIDTH - _LEFT) / bins
    top = max(int(counts.max()), 1)
    bars = "".join(
        f'<rect x="{_LEFT + n * step:.1f}" y="{_y(count / top):.1f}" width="{max(step - 1, 0.5):.1f}" '
        f'height="{_HEIGHT - _BOTTOM - _y(count / top):.1f}"/>'
        for n, count in enumerate(counts.tolist())
        if count
    )
    return _svg(bars, label, (low, high), (0.0, float(top)), whole=True)


def bars(values: Sequence[float], label: str) -> str:
    """One bar per item, from zero up or down.

    Args:
        values: Finite numbers in order.
        label: What the axis along the items is; the numbers' unit belongs in it.
    """
    if not len(values):
        return "<p>No values.</p>"
    low, high = min(0.0, *values), max(0.0, *values)
    if not high > low:
        high = low + 1.0
    step = (_WIDTH - _LEFT) / len(values)

    def share(value: float) -> float:
        return (value - low) / (high - low)

    drawn = "".join(
        f'<rect x="{_LEFT + n * step:.1f}" y="{_y(share(max(v, 0.0))):.1f}" width="{max(step - 1, 0.5):.1f}" '
        f'height="{abs(_y(share(v)) - _y(share(0.0))):.1f}"/>'
        for n, v in enumerate(values)
    )
    return _svg(drawn, label, (1.0, float(len(values))), (low, high), whole=False)


def _y(share: float) -> float:
    return _TOP + (1.0 - share) * (_HEIGHT - _BOTTOM - _TOP)


def _svg(content: str, label: str, x: tuple[float, float], y: tuple[float, float], whole: bool) -> str:
    base = _HEIGHT - _BOTTOM
    ticks = "".join(
        f'<text x="{_LEFT + share * (_WIDTH - _LEFT):.0f}" y="{base + 14}" text-anchor="{anchor}">'
        f"{_short(x[0] + share * (x[1] - x[0]))}</text>"
        for share, anchor in ((0.0, "start"), (0.5, "middle"), (1.0, "end"))
    )
    ticks += "".join(
        f'<text x="{_LEFT - 5}" y="{_y(share) + 4:.0f}" text-anchor="end">'
        f"{round(y[0] + share * (y[1] - y[0])) if whole else _short(y[0] + share * (y[1] - y[0]))}</text>"
        for share in (0.0, 1.0)
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(label, quote=True)}">{content}'
        f'<line x1="{_LEFT}" x2="{_WIDTH}" y1="{base}" y2="{base}"/>{ticks}'
        f'<text x="{(_LEFT + _WIDTH) / 2:.0f}" y="{_HEIGHT - 4}" text-anchor="middle">{escape(label)}</text></svg>'
    )


def _short(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
