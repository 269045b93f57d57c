"""Intervals as pages write them."""

from __future__ import annotations

import math

from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.reports.heat_numbers import unit_signs

_LARGE = 1000.0


def interval_text(interval: Interval, unit: str, bounds: bool = True) -> str:
    """Write a number with the range that holds it, to two digits of half its width.

    What is only known from above is called "at most", from below "at least"; of what may be nothing at all, no number
    is given. `bounds`:
    the quantity is one that cannot be below 0; else any sign is a result.

    >>> interval_text(Interval(0.8851, 0.211, 1.552), "W/(m2 K)").replace("\\N{NO-BREAK SPACE}", " ")
    '0.89 (0.21 to 1.55) W/(m² K)'
    >>> interval_text(Interval(0.3, -0.2, 0.8), "W"), interval_text(Interval(-3.0, -9.0, -1.0), "W")
    ('at most 0.80\\xa0W', 'not measurable')
    >>> interval_text(Interval(0.3, 0.2, math.inf), "m"), interval_text(Interval(0.3, 0.0, math.inf), "m")
    ('at least 0.20\\xa0m', 'not measurable')
    """
    unit = f"\N{NO-BREAK SPACE}{unit_signs(unit)}" if unit else ""
    if math.isnan(interval.value):
        return "not known"
    if bounds and (interval.unknown or (interval.at_most and math.isinf(interval.high))):
        return "not measurable"
    if math.isinf(interval.high):
        return f"at least {number_text(interval.low, 0.5 * interval.low)}{unit}"
    if bounds and interval.at_most:
        return f"at most {number_text(interval.high, 0.5 * interval.high)}{unit}"
    half = 0.5 * (interval.high - interval.low)
    value, low, high = (number_text(one, half) for one in (interval.value, interval.low, interval.high))
    return f"{value} ({low} to {high}){unit}"


def interval_lines(interval: Interval, bounds: bool = True) -> str:
    """Write an interval without a unit for a cell of a table, its range on a second line.

    >>> interval_lines(Interval(0.8851, 0.211, 1.552)), interval_lines(Interval(0.3, -0.2, 0.8))
    ('0.89\\n0.21 to 1.55', 'at most 0.80')
    """
    return interval_text(interval, "", bounds).replace(" (", "\n").rstrip(")")


def area_text(area_m2: float) -> str:
    """Write an area to a tenth of a square metre, small ones to a square decimetre.

    >>> area_text(12.04), area_text(0.4812)
    ('12.0', '0.48')
    """
    return f"{area_m2:,.1f}" if area_m2 >= 10.0 else f"{area_m2:.2f}"


def number_text(value: float, half_width: float) -> str:
    """Write a number to two digits of the half width of its range, at most four behind the point.

    >>> number_text(1234.56, 30.0), number_text(0.123456, 0.01), number_text(-0.001, 0.5), number_text(17732.0, 3800.0)
    ('1,235', '0.123', '0.00', '17,700')
    """
    size = abs(half_width) or abs(value) * 1e-3
    decimals = 2 if size == 0.0 else min(1 - math.floor(math.log10(size)), 4)
    if abs(value) >= _LARGE:
        decimals = min(decimals, 1)
    return f"{round(float(value), decimals) + 0.0:,.{max(decimals, 0)}f}"
