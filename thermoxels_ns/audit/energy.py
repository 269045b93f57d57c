"""Heat, money and carbon dioxide of a year, and what measures save, from the draws of U-values and a climate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.audit.conditions import Conditions, Energy
from thermoxels_ns.audit.draws import Draws, Interval, interval_of
from thermoxels_ns.audit.surface import chosen_names
from thermoxels_ns.audit.weather import check_airs
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.core.yaml_records import raising, wrong
from thermoxels_ns.heat.weather_file import read_weather

LEAVES_OUT = (
    "Left out: air change and leaks, what sun, people and devices give, moisture, how users heat and open windows, the "
    "efficiency of the heating, and all surface that was not observed. U-values are those of the survey, with its wind "
    "and sky. So this is heat through the observed surface, not the demand of the building."
)
_YEAR_H, _MOST_OFF_H = 8766.0, 48.0  # Hours of a mean year; most hours by which a climate may differ from whole years
_MOST_GAP_H = 24.0  # Longest time between two lines of a climate
_OF_ENERGY = 10**6 + 1  # First argument `number` of `Draws.local`, larger than any part's number


@dataclass(frozen=True)
class EnergyUse:
    """Heat through a part of the envelope in a year, or heat that a measure saves, with its cost and carbon dioxide."""

    name: str
    heat_kwh: Interval
    cost: Interval | None  # In the user's currency; None if no price is stated
    co2_kg: Interval | None  # None if no carbon dioxide per heat is stated


@dataclass(frozen=True)
class EnergyResult:
    """A year of the observed envelope."""

    degree_hours_kh: Interval  # Inside minus outside air, summed over the hours with heating, [K h]
    elements: tuple[EnergyUse, ...]  # By patch
    whole: EnergyUse
    savings: tuple[EnergyUse, ...]  # By measure
    leaves_out: str = LEAVES_OUT


def year_of(
    conditions: Conditions, draws: Draws, elements: Sequence[tuple[str, FloatArray, FloatArray]]
) -> EnergyResult | None:
    """Return heat, cost and carbon dioxide of a year, heat = U area degree hours; None if there is no `energy`.

    `elements` are name, area, [m2], and U-value, [W/(m2 K)], of each patch, (k,) each. In a draw, all patches have one
    climate and one price, before and after measures. Raises `AuditError` if climate or patches of a measure are unfit.
    """
    asked = conditions.energy
    if asked is None:
        return None
    number = iter(range(_OF_ENERGY, _OF_ENERGY + 10**5))

    def drawn(what: Measured) -> FloatArray:
        return what.value + draws.local(what.off_by, next(number))

    hours = _degree_hours(asked, drawn)
    price, co2 = (None if one is None else drawn(one) for one in (asked.price, asked.co2))

    def use(name: str, heat_kwh: FloatArray) -> EnergyUse:
        cost, carbon = (None if per is None else interval_of(heat_kwh * per) for per in (price, co2))
        return EnergyUse(name, interval_of(heat_kwh), cost, carbon)

    per_u = {name: area * hours / 1000.0 for name, area, _ in elements}
    heat = {name: u * per_u[name] for name, _, u in elements}
    savings = []
    for name, measure in asked.measures.items():
        chosen = chosen_names(f"energy: measures: {name}", tuple(heat), measure.patches)
        new_u = drawn(measure.u)
        then = sum((new_u * per_u[one] for one in heat if one in chosen), np.zeros(draws.count))
        before = sum((heat[one] for one in heat if one in chosen), np.zeros(draws.count))
        savings.append(use(name, before - then))
    return EnergyResult(
        degree_hours_kh=interval_of(hours),
        elements=tuple(use(name, one) for name, one in heat.items()),
        whole=use("all that was observed", sum(heat.values(), np.zeros(draws.count))),
        savings=tuple(savings),
    )


def _degree_hours(asked: Energy, drawn: Callable[[Measured], FloatArray]) -> FloatArray:
    """Return draws of the degree hours of a year, (k,), [K h]: stated, or summed over hours below the heating limit.

    `drawn` returns draws of a stated value, (k,). Raises `AuditError` if the climate file is unfit.
    """
    if asked.degree_hours is not None:
        return 24.0 * drawn(asked.degree_hours)
    assert asked.climate is not None and asked.inside is not None and asked.heating_limit is not None
    with raising(AuditError, "energy: climate: "):
        found = read_weather(asked.climate)
        hours, air_c = found["hours"], found.get("outside_c")
        years = (hours[-1] - hours[0] + 1.0) / _YEAR_H
        whole = max(round(years), 1)
        check_airs(asked.climate, found)
        if air_c is None or abs(years - whole) * _YEAR_H > _MOST_OFF_H or np.diff(hours).max() > _MOST_GAP_H:
            got = f"{', '.join(found)}, {hours[-1] - hours[0]:g} hours with gaps of up to {np.diff(hours).max():g}"
            expected = f"outside_c of one or more whole years, without gaps above {_MOST_GAP_H:g} hours"
            raise wrong(asked.climate, expected, got, "Get an .epw file of the place, or give degree_hours.")
    every_c = np.sort(np.interp(np.arange(hours[0], hours[-1] + 1e-6), hours, air_c))
    total = np.concatenate([[0.0], np.cumsum(every_c)])
    heated = np.searchsorted(every_c, drawn(asked.heating_limit))
    return (drawn(asked.inside) * heated - total[heated]) / whole
