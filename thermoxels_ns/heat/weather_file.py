"""Reader of weather files for heat scenes, audits and heating seasons: csv tables by hours, and .epw files by pvlib."""

from __future__ import annotations

import re
from calendar import isleap
from collections.abc import Sequence
from datetime import datetime
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.yaml_records import wrong

COLUMNS = ("outside_c", "inside_c", "wind_m_s", "cloud", "dew_point_c", "sun_w_m2")
ALL_AROUND_DEG = (0.0, 90.0, 180.0, 270.0)  # Azimuths of walls that face north, east, south and west
_EPW = {
    "outside_c": ("temp_air", 1.0, 70.0),
    "dew_point_c": ("temp_dew", 1.0, 70.0),
    "wind_m_s": ("wind_speed", 1.0, 90.0),
    "cloud": ("total_sky_cover", 0.1, 10.0),
}
"""Columns of an .epw file: name in pvlib, factor to our unit, and largest number that is not a missing value's mark."""
_YEAR_H = 8760
_LEAST_KNOWN, _MOST_SUN_W_M2 = 0.9, 2000.0  # Least share of known values in a column; largest sunlight that is known


def read_weather(
    path: Path | str, start: datetime | None = None, *, facing_deg: Sequence[float] = (), any_year: bool = False
) -> dict[str, FloatArray]:
    """Return the ascending `hours` and each column of `COLUMNS` that a weather file has, shape (k,) each.

    Args:
        path: A csv file or, if the name ends in .epw, an .epw file. The first line of a csv file names hours and
            columns; its user chooses hour 0. Values of an .epw file belong to the ends of its hours.
        start: Time of hour 0 in an .epw file, in the file's standard time if without a zone; None: its beginning.
        facing_deg: Directions of walls, clockwise from north, [degrees]. The column sun_w_m2 of an .epw file is the
            mean sunlight on these walls (ground of albedo 0.2); empty: no such column.
        any_year: If True, an .epw file is a typical year that repeats; if False, it must cover `start`.

    Raises:
        RecordError: The file cannot be read, is not in order or does not cover `start`, or pvlib is not installed.
    """
    if Path(path).suffix.lower() == ".epw":
        return _read_epw(Path(path), start, facing_deg, any_year)
    try:
        lines = [line for line in Path(path).read_text(encoding="utf-8-sig").splitlines() if line.strip(" ,")]
        head = [part.strip() for part in lines[0].split(",")] if lines else []
        fits = head[:1] == ["hours"] and set(head[1:]) <= set(COLUMNS) and len(set(head)) == len(head)
        table = np.loadtxt(lines[1:], delimiter=",", ndmin=2) if fits and len(lines) > 2 else np.zeros((1, 0))
        fits = table.shape[1] == len(head) > 1 and bool(np.isfinite(table).all() and (np.diff(table[:, 0]) > 0.0).all())
        got = f"{', '.join(head)} and {max(len(lines) - 1, 0)} lines of numbers"
    except (OSError, ValueError) as problem:
        fits, got, head, table = False, str(problem), [], np.zeros((1, 0))
    if not fits:
        expected = f"a first line of hours and some of {', '.join(COLUMNS)}, and two lines or more with hours that grow"
        raise wrong(str(path), expected, got, "Write hours,outside_c, for example, or give an .epw file.")
    return dict(zip(head, table.T))


def _read_epw(path: Path, start: datetime | None, facing_deg: Sequence[float], any_year: bool) -> dict[str, FloatArray]:
    try:
        pvlib: Any = import_module("pvlib")  # optional: it brings pandas
    except ImportError as problem:
        remedy = "Run pip install pvlib."
        raise wrong(str(path), "the package pvlib, which reads .epw files", "none", remedy) from problem
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
        year = start.year if start is not None and any_year else None
        if year is not None and not isleap(year):
            text = "\n".join(line for line in text.splitlines() if not re.match(r"\d+, *0?2, *29,", line))
        data, place = pvlib.iotools.read_epw(StringIO(text), coerce_year=year)  # a path it might take for an address
        begins, zone = data.index, data.index.tz
        if len(begins) < 2:
            raise ValueError("no hours")
        numbers = {name: data[name].to_numpy(dtype=np.float64) for name in (*(one[0] for one in _EPW.values()), "ghi")}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as problem:
        got = "nothing" if not path.is_file() else " ".join(str(problem).split())[:200]
        raise wrong(str(path), "an .epw file", got, "Correct the name, or get the file again.") from problem
    hours = np.arange(1.0, len(begins) + 1.0)
    if start is not None:
        here = start.replace(tzinfo=zone) if start.tzinfo is None else start
        hours = (begins - here).total_seconds().to_numpy(dtype=np.float64) / 3600.0 + 1.0
        if not (any_year or ((np.diff(hours) > 0.0).all() and hours[0] < 0.0 <= hours[-1])):
            got = f"hours from {begins[0]:%Y-%m-%d} to {begins[-1]:%Y-%m-%d}"
            remedy = "Get a file of that time; typical years, made of months of several years, do not know it."
            raise wrong(str(path), f"the weather before {here:%Y-%m-%d %H:%M}", got, remedy)
    if not (np.diff(hours) > 0.0).all():
        raise wrong(str(path), "an .epw file whose hours grow", "hours that do not", "Get the file again.")
    found = {"hours": hours}
    for column, (name, factor, most) in _EPW.items():
        known = numbers[name] <= most
        if known.mean() >= _LEAST_KNOWN:
            found[column] = factor * np.interp(hours, hours[known], numbers[name][known])
    if facing_deg and (numbers["ghi"] < _MOST_SUN_W_M2).mean() >= _LEAST_KNOWN:
        sun = pvlib.solarposition.get_solarposition(begins.shift(30, freq="min"), place["latitude"], place["longitude"])
        light = [data[name].where(data[name] < _MOST_SUN_W_M2, 0.0).to_numpy(float) for name in ("dni", "ghi", "dhi")]
        at = sun["apparent_zenith"].to_numpy(), sun["azimuth"].to_numpy()
        walls = [
            pvlib.irradiance.get_total_irradiance(90.0, one, *at, *light, albedo=0.2)["poa_global"]
            for one in facing_deg
        ]
        found["sun_w_m2"] = np.interp(hours, hours - 0.5, np.nan_to_num(np.mean(walls, axis=0)))
    if any_year and len(hours) >= _YEAR_H:
        year_h = _YEAR_H + 24.0 * (hours[-1] - hours[0] > _YEAR_H)
        found = {name: np.concatenate([values] * 3) for name, values in found.items()}
        found["hours"] = found["hours"] + np.repeat([-year_h, 0.0, year_h], len(hours))
    return found
