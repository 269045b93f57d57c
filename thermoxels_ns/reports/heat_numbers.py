"""Numbers as the report of a heat computation writes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


def figure(value: float) -> str:
    """Write four digits, without powers of ten where figures are of everyday size.

    >>> figure(1234.56), figure(0.0123456), figure(0.0)
    ('1,235', '0.01235', '0')
    """
    if value == 0.0:
        return "0"
    if 1e-3 <= abs(value) < 1e6:
        digits = max(0, 3 - int(np.floor(np.log10(abs(value)))))
        return f"{value:,.{digits}f}"
    return f"{value:.3e}"


def degrees(value_c: float) -> str:
    """Write a temperature to a hundredth of a degree; what rounds to 0 has no sign.

    >>> degrees(-0.001), degrees(-0.006)
    ('0.00', '-0.01')
    """
    return f"{round(float(value_c), 2) + 0.0:.2f}"


def coordinate(value_m: float) -> str:
    """Write a coordinate to three digits, but not below the millimetre.

    >>> coordinate(0.00625), coordinate(3.14159), coordinate(-12.04), coordinate(51234.5), coordinate(-0.0002)
    ('0.006', '3.14', '-12', '51234', '0')
    """
    decimals = 3 if abs(value_m) < 1.0 else max(0, 2 - int(np.floor(np.log10(abs(value_m)))))
    text = f"{round(float(value_m), decimals) + 0.0:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


def unit_signs(unit: str) -> str:
    """Write the powers of a unit as signs, and keep it on one line.

    >>> unit_signs("W/(m2 K4)") == "W/(m²\\N{NO-BREAK SPACE}K⁴)"
    True
    """
    for plain, sign in (("m2", "m²"), ("m3", "m³"), ("K4", "K⁴"), (" ", "\N{NO-BREAK SPACE}")):
        unit = unit.replace(plain, sign)
    return unit


@dataclass(frozen=True)
class RoundOff:
    """Heat flows so small that they are rounding: of a steady body, what flows in and out of it again."""

    below_w: float  # Flows smaller than this are round-off, [W]

    def flow(self, heat_w: float) -> str:
        """Write a heat flow; round-off is 0.

        >>> RoundOff(1e-6).flow(6e-10), RoundOff(1e-6).flow(-12.5)
        ('0', '-12.50')
        """
        return "0" if abs(heat_w) < self.below_w else figure(heat_w)

    def per_area(self, heat_w_m2: float, heat_w: float) -> str:
        """Write a heat flow per area; that of round-off is 0."""
        return "0" if abs(heat_w) < self.below_w else figure(heat_w_m2)


def round_off_of(flows_w: Sequence[float], area_m2: float) -> RoundOff:
    """Say which of the heat flows of everything that acts, [W], are round-off in a body of so much surface, [m^2].

    It is less than a billionth of the largest flow, which a balance need not close to, or less than a billionth of a
    watt per square metre, which is what rounding makes of a surface as warm as the air beside it.

    >>> f"{round_off_of((1e3, -1e3), 200.0).below_w:g} {round_off_of((), 200.0).below_w:g}"
    '1e-06 2e-07'
    """
    largest = max((abs(flow) for flow in flows_w), default=0.0)
    return RoundOff(1e-9 * max(largest, area_m2))
