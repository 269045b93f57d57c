"""Read the weather before a survey, and compute how heat that a wall has stored from it changes the heat flow."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.yaml_records import raising, wrong
from thermoxels_ns.heat.weather_file import ALL_AROUND_DEG, read_weather

_TAKEN = {
    ("inside", "air"): ("inside_c", "C"),
    ("outside", "air"): ("outside_c", "C"),
    ("outside", "wind"): ("wind_m_s", "m/s"),
    ("surroundings", "sky", "cloud"): ("cloud", ""),
    ("surroundings", "sky", "dew_point"): ("dew_point_c", "C"),
}
"""Entries of conditions that may say "weather", with the column and the unit of the value that replaces the word."""
_OUTER, _WALL, _INNER, _CELLS = 0.04, 1.0, 0.13, 60  # Resistances of films and wall, [m2 K / W]; layers of the wall


def survey_weather(
    file: str, date: datetime | None = None, facing_deg: Sequence[float] = ALL_AROUND_DEG
) -> dict[str, FloatArray]:
    """Return `hours`, 0 at the survey and negative before, and each column of `COLUMNS` that the file has, (k,) each.

    `date` is date and time of the survey and must be given for .epw files; `facing_deg`: see `read_weather`. Raises
    `AuditError` if the file cannot be read, has impossible temperatures, or does not begin before and reach the survey.
    """
    with raising(AuditError, "weather: file: "):
        if date is None and file.lower().endswith(".epw"):
            remedy = "Add survey: {date: 2026-01-15T06:30:00+01:00}."
            raise wrong(file, "date and time of the survey beside an .epw file", "none", remedy)
        found = read_weather(file, date, facing_deg=facing_deg)
        hours = found["hours"]
        check_airs(file, found)
        if not hours[0] < 0.0 <= hours[-1]:
            expected, got = "hours that grow from below 0, the survey, to 0", f"{hours[0]:g} to {hours[-1]:g}"
            raise wrong(file, expected, got, "Count hours from the survey.")
    times = np.append(hours[hours < 0.0], 0.0)
    return {one: np.interp(times, hours, column) for one, column in found.items()}


def check_airs(file: str, columns: dict[str, FloatArray]) -> None:
    """Raise `RecordError` if a temperature in the columns of a weather file is not within -90 to 70 C."""
    for name, values in columns.items():
        if name.endswith("_c") and not ((values > -90.0) & (values < 70.0)).all():
            got = f"{values.min():g} to {values.max():g} C"
            raise wrong(file, f"{name} from -90 to 70 C", got, "Leave out lines without a value.")


def with_weather(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Replace each "weather" of `_TAKEN` in conditions by the weather file's value at the survey; return `content`.

    `content` is changed in place. Where it does not state them, the extremes of the airs during the last 24 hours (if
    the file is that long) and the hours since sun are added. Names of files in `folder` become paths. Raises
    `AuditError` if the file is unfit or has no such column.
    """
    weather, energy = content.get("weather"), content.get("energy")
    if isinstance(energy, dict) and isinstance(energy.get("climate"), str):
        energy["climate"] = str(folder / energy["climate"])
    if not isinstance(weather, dict) or not isinstance(weather.get("file"), str):
        return content
    weather["file"] = str(folder / weather["file"])
    survey = content.get("survey")
    date = survey.get("date") if isinstance(survey, dict) else None
    with suppress(ValueError):  # the check of the conditions says what is wrong with a date
        date = datetime.fromisoformat(date.replace("Z", "+00:00")) if isinstance(date, str) else date
    series = survey_weather(weather["file"], date if isinstance(date, datetime) else None)
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
    """Return (heat flow - steady heat flow) / steady heat flow at a surface of a wall that stores heat, at the survey.

    The wall is uniform, with films of ISO 6946; its slowest mode has the time constant `time_constant_h`. By Duhamel's
    theorem (Carslaw and Jaeger 1959), its temperature is the steady one minus, for each mode, the part of earlier air
    changes that has not decayed. `series` is from `survey_weather`; before its first line all was as in that line. Sun,
    [W/m2], warms the outer air by `absorptance` / 25. The caller must give a `difference_k`, inside minus outside air
    at the survey, above 0. `inside`: the heat flow is that at the inner surface (True) or at the outer one (False).
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
