"""The weather before a survey, read from a csv file, and what a wall still remembers of it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import AuditError

COLUMNS = ("outside_c", "inside_c", "wind_m_s", "cloud", "dew_point_c", "sun_w_m2")
_TAKEN = {
    ("inside", "air"): ("inside_c", "C"),
    ("outside", "air"): ("outside_c", "C"),
    ("outside", "wind"): ("wind_m_s", "m/s"),
    ("surroundings", "sky", "cloud"): ("cloud", ""),
    ("surroundings", "sky", "dew_point"): ("dew_point_c", "C"),
}
"""Entries of conditions that may say "weather", with the column and the unit that then stand for them."""
_OUTER, _WALL, _INNER, _CELLS = 0.04, 1.0, 0.13, 60  # Resistances of films and wall, [m2 K / W]; layers of the wall


def read_weather(path: Path | str) -> dict[str, FloatArray]:
    """Return hours, 0 at the survey and negative before, and each column of `COLUMNS` that a csv file has, (k,) each.

    The first line names the columns. Raises `AuditError` if the file cannot be read or does not reach the survey.
    """
    try:
        lines = [line for line in Path(path).read_text(encoding="utf-8-sig").splitlines() if line.strip(" ,")]
        head = [part.strip() for part in lines[0].split(",")] if lines else []
        fits = head[:1] == ["hours"] and set(head[1:]) <= set(COLUMNS) and len(set(head)) == len(head)
        table = np.loadtxt(lines[1:], delimiter=",", ndmin=2) if fits and len(lines) > 2 else np.zeros((1, 0))
        fits = table.shape[1] == len(head) > 1 and bool(np.isfinite(table).all() and (np.diff(table[:, 0]) > 0.0).all())
        got = f"{', '.join(head)} and {len(lines) - 1} lines of numbers"
    except (OSError, ValueError) as problem:
        fits, got, table = False, str(problem), np.zeros((1, 1))
    hours = table.T[0] if fits else np.zeros(1)
    if not hours[0] < 0.0 <= hours[-1]:
        expected = f"a first line of hours and some of {', '.join(COLUMNS)}, and hours that grow from below 0 to 0"
        remedy = "Count hours from the survey, and write hours,outside_c, for example."
        raise AuditError(f"weather: file: {path}", expected=expected, got=got, remedy=remedy)
    times = np.append(hours[hours < 0.0], 0.0)
    return {one: np.interp(times, hours, column) for one, column in zip(head, table.T)}


def with_weather(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return conditions in which each "weather" of `_TAKEN` is the value of the weather file at the survey.

    A file of 24 hours and more also tells extremes of the airs, and how long ago the sun shone, if nothing else does.
    """
    weather = content.get("weather")
    if not isinstance(weather, dict) or not isinstance(weather.get("file"), str):
        return content
    weather["file"] = str(folder / weather["file"])
    series = read_weather(weather["file"])
    for (*path, key), (column, unit) in _TAKEN.items():
        at: Any = content
        for part in path:
            at = at.get(part) if isinstance(at, dict) else None
        text = str(at.get(key, "")) if isinstance(at, dict) else ""
        if not text.startswith("weather"):
            continue
        if column not in series or not re.fullmatch(rf"weather(\s*(\+/?-|±)\s*[\d.,]+\s*°?\s*{unit})?\s*", text):
            got, remedy = f"{text!r}, of the columns {', '.join(series)}", "Correct it, or write the value."
            expected = f"weather +- 0.5 {unit}".strip() + f", and a column {column}"
            raise AuditError(": ".join((*path, key)), expected=expected, got=got, remedy=remedy)
        ending = text.removeprefix("weather").strip() or unit
        at[key] = f"{series[column][-1]:.9g} {ending}"
    day = series["hours"] >= -24.0
    for name in ("inside", "outside") if series["hours"][0] <= -24.0 else ():
        air = series.get(f"{name}_c")
        if air is not None and isinstance(content.get(name), dict):
            content[name].setdefault("lowest_24h", f"{air[day].min():.9g} C")
            content[name].setdefault("highest_24h", f"{air[day].max():.9g} C")
    shone = np.flatnonzero(series.get("sun_w_m2", np.zeros(1)) > 0.0)
    if len(shone) and isinstance(content.setdefault("survey", {}), dict):
        content["survey"].setdefault("hours_since_sun", f"{abs(series['hours'][shone[-1]]):.9g} h")
    return content


def remembered_share(
    series: dict[str, FloatArray], difference_k: float, time_constant_h: float, absorptance: float, inside: bool
) -> float:
    """Return by what share heat flow through a surface differs from the steady one, because a wall stores heat.

    The wall is uniform, with films of ISO 6946; its slowest mode decays within `time_constant_h`. Its temperature is
    that of the steady state of each moment minus, for each mode, what has not yet decayed of the changes of the airs
    (Carslaw and Jaeger 1959, Duhamel's theorem). Before the first line of `series` all was as in that line; sun on the
    wall, [W/m2], warms its air by absorptance / 25. `difference_k` is that of the airs at the survey, above 0.
    """
    between = np.full(_CELLS - 1, _CELLS / _WALL)
    ends = [1.0 / (film + 0.5 * _WALL / _CELLS) for film in (_OUTER, _INNER)]
    drop = np.append(between, 0.0) + np.append(0.0, between)
    drop[[0, -1]] += ends
    rates, modes = np.linalg.eigh(np.diag(drop) - np.diag(between, 1) - np.diag(between, -1))
    decay = rates / rates[0] / time_constant_h  # [1/h]
    hours = series["hours"]
    outer = series["outside_c"] + absorptance * _OUTER * series.get("sun_w_m2", 0.0 * hours)
    airs = outer, series.get("inside_c", 0.0 * hours)
    begun = np.exp(np.outer(decay, hours))  # What is left at 0 of a change at each time, shape (modes, k)
    held = np.diff(begun, axis=1) / decay[:, None] / np.diff(hours)
    lag = sum(end * modes[at][:, None] * (held @ np.diff(air))[:, None] for end, at, air in zip(ends, (0, -1), airs))
    here = -1 if inside else 0
    stored = -ends[here] * float((modes[here] / rates) @ np.ravel(lag))
    return (-stored if inside else stored) * (_OUTER + _WALL + _INNER) / difference_k
