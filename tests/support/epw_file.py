"""Weather files of the format of EnergyPlus, written by formula."""

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

BEGIN = datetime(2026, 1, 1)


def write_epw(
    path: Path,
    outside_c: Callable[[float], float],
    *,
    hours: int = 8760,
    mixed_years: bool = False,
    first: datetime = BEGIN,
) -> Path:
    """An .epw file of Geneva (UTC+1), with air of `outside_c(hours after New Year)`, and direct light at noon."""
    lines = ["LOCATION,Geneva,-,CHE,made up,067000,46.25,6.13,1.0,416.0", *(f"HEADER {n}" for n in range(7))]
    for hour in range(hours):
        begin = first + timedelta(hours=hour)
        year = 2000 + begin.month * 7 % 12 if mixed_years else begin.year
        direct = 500 if 10 <= begin.hour < 14 else 0
        air = f"{outside_c(hour + 1.0):.3f},-2.0,80,97000"
        light = f"0,0,300,{direct + 100 if direct else 0},{direct},{100 if direct else 0},0,0,0,0"
        rest = "180,2.0,5,5,20.0,7777,9,999999999,0,0,0,88,0.2,0,0"
        lines.append(f"{year},{begin.month},{begin.day},{begin.hour + 1},60,?,{air},{light},{rest}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
