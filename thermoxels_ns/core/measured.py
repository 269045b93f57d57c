"""Measured values as people write them: a number, its uncertainty and its unit."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from thermoxels_ns.core.checks import is_number
from thermoxels_ns.core.yaml_records import wrong

_NUMBER = r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?"
_WRITTEN = re.compile(rf"\s*({_NUMBER})\s*(?:(?:\+-|\+/-|±)\s*({_NUMBER})\s*)?(\S.*)?", re.DOTALL)

_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "1": {"": (1.0, 0.0), "%": (0.01, 0.0)},
    "C": {"C": (1.0, 0.0), "K": (1.0, -273.15)},
    "K": {"K": (1.0, 0.0), "C": (1.0, 0.0)},
    "m": {"m": (1.0, 0.0), "cm": (0.01, 0.0), "mm": (1e-3, 0.0)},
    "m/s": {"m/s": (1.0, 0.0), "km/h": (1.0 / 3.6, 0.0)},
    "h": {"h": (1.0, 0.0), "d": (24.0, 0.0)},
    "s": {"s": (1.0, 0.0), "min": (60.0, 0.0), "h": (3600.0, 0.0), "d": (86400.0, 0.0)},
    "Pa": {"Pa": (1.0, 0.0)},
    "W": {"W": (1.0, 0.0), "kW": (1e3, 0.0)},
    "W/K": {"W/K": (1.0, 0.0)},
    "W/(m K)": {"W/mK": (1.0, 0.0)},
    "W/(m2 K)": {"W/m2K": (1.0, 0.0)},
    "m2 K/W": {"m2K/W": (1.0, 0.0)},
    "W/m2": {"W/m2": (1.0, 0.0)},
    "W/m3": {"W/m3": (1.0, 0.0)},
    "kg/m3": {"kg/m3": (1.0, 0.0)},
    "J/(kg K)": {"J/kgK": (1.0, 0.0), "kJ/kgK": (1e3, 0.0)},
    "kJ/(m3 K)": {"kJ/m3K": (1.0, 0.0), "MJ/m3K": (1e3, 0.0), "J/m3K": (1e-3, 0.0)},
    "degrees": {"degrees": (1.0, 0.0), "deg": (1.0, 0.0), "°": (1.0, 0.0)},
    "K d": {"Kd": (1.0, 0.0), "Kh": (1.0 / 24.0, 0.0)},
    "/kWh": {"/kWh": (1.0, 0.0), "/MWh": (1e-3, 0.0)},
    "kg/kWh": {"kg/kWh": (1.0, 0.0), "g/kWh": (1e-3, 0.0)},
}
"""For each unit in which values are kept: the units that people may write, with factor and summand to convert a value.
Spaces, brackets and ^ in a written unit are ignored."""
_SIGNS = str.maketrans({"\N{MINUS SIGN}": "-", "²": "2", "³": "3", "\N{MASCULINE ORDINAL INDICATOR}": "°", "℃": "°C"})
_THOUSANDS = re.compile(r"(?<![\d.,])([1-9]\d{0,2}),(\d{3})(?!\d)")  # A comma of thousands or of decimals
_EXAMPLES = {"1": "0.93 +- 0.02", "C": "20.0 +- 0.5 C", "K": "0 +- 1 K"}


@dataclass(frozen=True)
class Measured:
    """A measured number, and the half width of the range around it; all values in the range are equally likely."""

    value: float
    off_by: float = 0.0  # Half width of the range, at least 0; 0: the value is taken as exact

    @property
    def low(self) -> float:
        """Lower end of the range of true values."""
        return self.value - self.off_by

    @property
    def high(self) -> float:
        """Upper end of the range of true values."""
        return self.value + self.off_by


@dataclass(frozen=True)
class Unit:
    """Unit of a field of a record, and limits of its value: annotate ``Annotated[Measured, Unit("1", 0.0, 1.0)]``."""

    name: str  # Key of the table of units, such as "m/s"; "1": no unit
    low: float = -math.inf  # Least value allowed
    high: float = math.inf  # Largest value allowed
    surely: bool = True  # True: the whole range must be within the limits; False: only the value itself
    above: bool = False  # True: the value must be above `low`, not equal to it

    def read(self, content: object) -> Measured:
        """Return `content` as a `Measured` in this unit; raise `RecordError` if it is unreadable or out of the limits.
        `content` is a `Measured` in this unit, a dictionary of its two fields, or what `read_measured` reads."""
        if isinstance(content, dict) and content.keys() == {"value", "off_by"}:  # as answers.json has it
            value, off_by = content["value"], content["off_by"]
            if not (is_number(value) and is_number(off_by) and math.isfinite(value) and 0.0 <= off_by < math.inf):
                expected, remedy = "finite numbers, off_by of at least 0", "Write 20.0 +- 0.5 C, for example."
                raise wrong("", expected, f"{content!r}", remedy)
            content = Measured(value, off_by)
        found = content if isinstance(content, Measured) else read_measured("", content, self.name)
        low, high = (found.low, found.high) if self.surely else (found.value, found.value)
        if low < self.low or high > self.high + 1e-12 or (self.above and low <= self.low):
            above = f"{'above' if self.above else 'of at least'} {self.low:g}" if self.low > -math.inf else ""
            most = f"at most {self.high:g}" if self.high < math.inf else ""
            expected = f"a value {'surely ' * self.surely}{' and '.join(filter(None, (above, most)))} [{self.name}]"
            written = f"{content!r}, which is " if isinstance(content, str) else ""
            raise wrong("", expected, f"{written}{found.value:g} +- {found.off_by:g}", "Correct it.")
        return found

    def __get_pydantic_core_schema__(self, *_: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_plain_validator_function(self.read)


def read_measured(name: str, content: object, unit: str, bare: bool = False) -> Measured:
    """Read a value as people write it, such as ``20.0 +- 0.5 C`` or ``0.93``; return it in `unit`, "1" for no unit.

    A comma counts as a decimal point. If `bare` is True, a number without a unit is taken to be in `unit`. Raises
    `RecordError`, which starts with `name`, if the text is no number, if its unit is wrong or missing, or if a
    comma may be one of thousands, as in "1,500".

    >>> read_measured("wind", "3,6 +- 1.8 km/h", "m/s")
    Measured(value=1.0, off_by=0.5)
    """
    example = _EXAMPLES.get(unit, f"1.5 +- 0.5 {unit}")
    example = re.sub(r" \+- \S+", "", example) if bare else example
    plain = isinstance(content, (int, float)) and not isinstance(content, bool)
    text = content.translate(_SIGNS) if isinstance(content, str) else str(content) if plain else ""
    written, got = _WRITTEN.fullmatch(text), "nothing" if content is None else repr(content)
    if either := _THOUSANDS.search(text):
        remedy = f"Write {either[1]}{either[2]} or {either[1]}.{either[2]}, whichever is meant."
        raise wrong(name, "a comma that cannot be one of thousands", got, remedy)
    if written is None:
        raise wrong(name, "a number" if unit == "1" else f"a number in {unit}", got, f"Write {example}, for example.")
    number, off_by, ending = written.groups()
    number, off_by = number.replace(",", "."), off_by and off_by.replace(",", ".")
    known = _UNITS[unit] | ({"": (1.0, 0.0)} if bare else {})
    short = re.sub(r"[\s()^]", "", ending or "")
    if unit in ("C", "K"):
        short = re.sub(r"^(°|deg|degrees)(C|Celsius)?$", "C", short)
    if short not in known:
        says = "without a unit, or in %" if unit == "1" else f"with its unit, {unit}"
        if short:
            raise wrong(name, f"a number {says}", got, f"Write {example}, for example.")
        off = "" if off_by is None else f" +- {off_by}"
        raise wrong(name, f"a number {says}", f"{got} without one", f"Write {number}{off} {unit}.")
    factor, summand = known[short]
    value, half = float(number) * factor + summand, float(off_by or 0.0) * factor
    if not (math.isfinite(value) and math.isfinite(half) and half >= 0.0):
        raise wrong(name, "a finite number, and behind +- one of at least 0", got, f"Write {example}, for example.")
    return Measured(value, half)
