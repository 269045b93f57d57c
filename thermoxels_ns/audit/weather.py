"""The weather before a survey, from a file beside the conditions."""

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
"""Entries of conditions that may say "weather", with the column and the unit that then stand for them."""


def survey_weather(
    file: str, date: datetime | None = None, facing_deg: Sequence[float] = ALL_AROUND_DEG
) -> dict[str, FloatArray]:
    """Return hours, 0 at the survey and negative before, and each column of `COLUMNS` that the file has, (k,) each.

    `date` is that of the survey, which an .epw file needs; `facing_deg`: see `read_weather`. Raises `AuditError` if the
    file cannot be read or does not reach the survey.
    """
    with raising(AuditError, "weather: file: "):
        if date is None and file.lower().endswith(".epw"):
            remedy = "Add survey: {date: 2026-01-15T06:30:00+01:00}."
            raise wrong(file, "date and time of the survey beside an .epw file", "none", remedy)
        found = read_weather(file, date, facing_deg=facing_deg)
        hours = found["hours"]
        for name, values in found.items():
            if name.endswith("_c") and not ((values > -90.0) & (values < 70.0)).all():
                got = f"{values.min():g} to {values.max():g} C"
                raise wrong(file, f"{name} from -90 to 70 C", got, "Leave out lines without a value.")
        if not hours[0] < 0.0 <= hours[-1]:
            expected, got = "hours that grow from below 0, the survey, to 0", f"{hours[0]:g} to {hours[-1]:g}"
            raise wrong(file, expected, got, "Count hours from the survey.")
    times = np.append(hours[hours < 0.0], 0.0)
    return {one: np.interp(times, hours, column) for one, column in found.items()}


def with_weather(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return conditions in which each "weather" of `_TAKEN` is the value of the weather file at the survey.

    A file of 24 hours and more also tells extremes of the airs, and how long ago the sun shone, if nothing else does.
    Names of files are taken from `folder` on.
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
