"""Write numbers as texts for pages: figures, temperatures, coordinates, units, durations, and intervals."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import datetime

from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.core.measured import Measured


def figure(value: float) -> str:
    """Return a number with three significant digits; with a power of ten below 0.001 and from a million on.

    What is below 1e-9 is round-off in all that pages show, and becomes 0.

    >>> figure(1234.56), figure(0.0123456), figure(-6e-10)
    ('1,230', '0.0123', '0')
    """
    if abs(value) < 1e-9:
        return "0"
    if 1e-3 <= abs(value) < 1e6:
        digits = 2 - math.floor(math.log10(abs(value)))
        return f"{round(value, digits):,.{max(digits, 0)}f}"
    return f"{value:.2e}"


def degrees(value_c: float) -> str:
    """Return a temperature with one decimal; values that round to 0 have no sign.

    >>> degrees(-0.01), degrees(-0.06)
    ('0.0', '-0.1')
    """
    return f"{round(float(value_c), 1) + 0.0:.1f}"


_PLAIN = {
    r"emissivity of \*, entry \d+": "emissivity of the surfaces",
    r"(emissivity of .+?), entry \d+": r"\1",
    r"\bfilm (factor|coefficient)\b": r"heat transfer between surface and air (film: \1)",
    r"\bgeometry\b": "where borders of the model's surfaces lie",
    r"\bfilm formula\b": "formula of the heat transfer between surface and air",
    r"\bcamera repeatability\b": "difference of the camera's readings between places (repeatability)",
    r"\bcamera offset\b": "common error of the camera's readings (offset)",
}


def plain_names(text: str) -> str:
    """Return a text in which the names of uncertain quantities are words that a client of an audit knows.

    >>> plain_names("wind, emissivity of *, entry 1"), plain_names("emissivity of door, sill, entry 2")
    ('wind, emissivity of the surfaces', 'emissivity of door, sill')
    """
    for pattern, words in _PLAIN.items():
        text = re.sub(pattern, words, text)
    return text


def point_text(point_m: Sequence[float]) -> str:
    """Return coordinates, [m], to a millimetre.

    >>> point_text((0.00625, 3.14159, -12.04)), point_text((512345.6, -0.0002, 1.0))
    ('(0.006, 3.142, -12.04)', '(512345.6, 0, 1)')
    """
    return f"({', '.join(f'{round(float(value_m), 3) + 0.0:.10g}' for value_m in point_m)})"


def unit_signs(unit: str) -> str:
    """Return a unit with raised digits for powers and no-break spaces.

    >>> unit_signs("W/(m2 K4)") == "W/(m²\\N{NO-BREAK SPACE}K⁴)"
    True
    """
    for plain, sign in (("m2", "m²"), ("m3", "m³"), ("K4", "K⁴"), (" ", "\N{NO-BREAK SPACE}")):
        unit = unit.replace(plain, sign)
    return unit


def time_unit(duration_s: float) -> tuple[str, float]:
    """Return a unit that suits a duration, and the length of the unit in seconds.

    >>> time_unit(86400.0)
    ('h', 3600.0)
    """
    if duration_s > 10 * 86400.0:
        return "days", 86400.0
    if duration_s > 2 * 3600.0:
        return "h", 3600.0
    return ("min", 60.0) if duration_s > 300.0 else ("s", 1.0)


def duration_text(seconds: float) -> str:
    """Return a duration as text, in the unit that `time_unit` chooses.

    >>> duration_text(5400.0)
    '90 min'
    """
    unit, length = time_unit(seconds)
    return f"{seconds / length:.4g} {unit}"


def stated_text(value: Measured | datetime | str, unit: str = "") -> str:
    """Return a stated value as text: a number with its half range and `unit`, a date, or words.

    >>> stated_text(Measured(20.0, 0.5), "°C"), stated_text("dry")
    ('20 ± 0.5 °C', 'dry')
    """
    if isinstance(value, datetime):
        return f"{value:%Y-%m-%d %H:%M %Z}".strip()
    if isinstance(value, str):
        return value
    off = f" ± {value.off_by:g}" if value.off_by else ""
    return f"{value.value:g}{off} {unit}".strip()


def interval_text(interval: Interval, unit: str, bounds: bool = True) -> str:
    """Return an interval as text: the value and its range, to two significant digits of half the range's width.

    NaN gives "not known", an infinite upper end gives "at least". With `bounds` the quantity is above 0: a range that
    reaches down to 0 gives "at most", or "not measurable" if it has no finite upper end above 0.

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
    """Return an interval as text without a unit, for a cell of a table; the range is on a second line.

    >>> interval_lines(Interval(0.8851, 0.211, 1.552)), interval_lines(Interval(0.3, -0.2, 0.8))
    ('0.89\\n0.21 to 1.55', 'at most 0.80')
    """
    return interval_text(interval, "", bounds).replace(" (", "\n").rstrip(")")


def number_text(value: float, half_width: float) -> str:
    """Return a number rounded to two significant digits of `half_width`, with at most four decimals.

    >>> number_text(1234.56, 30.0), number_text(0.123456, 0.01), number_text(-0.001, 0.5), number_text(17732.0, 3800.0)
    ('1,235', '0.123', '0.00', '17,700')
    """
    size = abs(half_width) or abs(value) * 1e-3
    decimals = 2 if size == 0.0 else min(1 - math.floor(math.log10(size)), 4)
    if abs(value) >= 1000.0:
        decimals = min(decimals, 1)
    return f"{round(float(value), decimals) + 0.0:,.{max(decimals, 0)}f}"
