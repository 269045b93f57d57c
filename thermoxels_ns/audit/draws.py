"""Random draws of the uncertain quantities of a survey, whose errors every triangle shares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from thermoxels_ns.audit.conditions import BALANCE, Conditions
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.measured import Measured

COUNT, SEED = 10_000, 20260115
"""Number of draws behind each interval (JCGM 101, 7.2), and the seed that makes them repeat for the same conditions."""
FORMULA, REPEATABILITY, GEOMETRY = "film formula", "camera repeatability", "geometry"
"""Causes of uncertainty that `uncertain` does not name; geometry: where borders of the reconstructed surface lie."""
_COMMON_GEOMETRY = 6 * 10**6  # Argument `number` of `Draws.local` for the border error that all parts share

CONFIDENCE = 0.90  # Share of the draws that lie in an interval; as many draws lie below the interval as above
ENDS = (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE)  # Quantiles of the draws at the ends of an interval


@dataclass(frozen=True)
class Interval:
    """A number computed from the stated values, and the range that holds the middle 90 % of the draws."""

    value: float
    low: float
    high: float

    @property
    def at_most(self) -> bool:
        """True if only an upper bound is known, because 0 lies in the range: `low` <= 0 < `high`."""
        return self.low <= 0.0 < self.high

    @property
    def unknown(self) -> bool:
        """True if not even a positive upper bound is known: `high` <= 0."""
        return self.high <= 0.0


def interval_of(values: FloatArray) -> Interval:
    """Return the interval of draws, shape (1 + k,), of which the first is computed from the stated values.

    >>> found = interval_of(np.array([20.0, *np.linspace(0.0, 40.0, 41)]))
    >>> round(found.low, 9), found.value, round(found.high, 9)
    (2.0, 20.0, 38.0)
    """
    low, high = np.quantile(values[1:], ENDS)
    return Interval(float(values[0]), float(low), float(high))


def width_of(values: FloatArray) -> FloatArray:
    """Return the widths of intervals, shape (n,), of draws of shape (n, 1 + k)."""
    return np.asarray(np.ptp(np.quantile(values[:, 1:], ENDS, axis=1), axis=0))


@dataclass(frozen=True)
class Draws:
    """Values of each uncertain quantity by name, shape (1 + k,) each: first the stated value, then k random draws."""

    values: Mapping[str, FloatArray]
    seed: int = SEED
    without: tuple[str, ...] = ()  # The causes among `REPEATABILITY` and `GEOMETRY` whose errors are 0 in all draws

    @property
    def count(self) -> int:
        """Number of values, 1 + k."""
        return len(next(iter(self.values.values())))

    @property
    def difference_k(self) -> FloatArray:
        """Inside minus outside air, shape (1 + k,), [K], above 0; NaN if no outside temperature is stated."""
        return self["inside air"] - self["outside air"]

    def __getitem__(self, name: str) -> FloatArray:
        return self.values[name]

    def first(self, count: int) -> Draws:
        """Return the stated values and the first `count` draws."""
        return replace(self, values={name: values[: 1 + count] for name, values in self.values.items()})

    def frozen(self, cause: str) -> Draws:
        """Return draws in which `cause` has its stated value; with `REPEATABILITY` or `GEOMETRY` its errors are 0."""
        if cause in (REPEATABILITY, GEOMETRY):
            return replace(self, without=(*self.without, cause))
        return replace(self, values={**self.values, cause: np.full(self.count, self[cause][0])})

    def local(self, off_by: float, number: int, cause: str = REPEATABILITY) -> FloatArray:
        """Return uniform random errors in +- `off_by`, (1 + k,), the first 0; all are 0 if `cause` is in `without`.

        `number` is part of the seed: other numbers give independent errors.
        """
        if cause in self.without:
            return np.zeros(self.count)
        drawn = np.random.default_rng((self.seed, number)).uniform(-off_by, off_by, self.count)
        drawn[0] = 0.0
        return drawn

    def geometry(self, number: int) -> FloatArray:
        """Return relative errors of the border position of part `number`, from -1 to 1, shape (1 + k,), the first 0.

        Half of each error is common to all parts, as reconstructions round all edges alike; half is the part's own.
        """
        numbers = _COMMON_GEOMETRY, _COMMON_GEOMETRY + 1 + number
        return np.mean([self.local(1.0, one, GEOMETRY) for one in numbers], axis=0)


def draw(conditions: Conditions, count: int = COUNT, seed: int = SEED) -> Draws:
    """Return the stated value and `count` random values of each uncertain quantity (Latin hypercube sampling).

    If the balance uses several formulas, `FORMULA` holds the place of the drawn formula in `FILMS`, drawn with the
    probabilities `film_shares`. Its stated value is -1, which stands for the mean of all formulas.
    """
    generator = np.random.default_rng(seed)

    def spread() -> FloatArray:
        return np.asarray((generator.permutation(count) + generator.uniform(size=count)) / count)

    values = {
        name: np.concatenate([[what.value], what.low + (what.high - what.low) * spread()])
        for name, what in uncertain(conditions).items()
    }
    for name, limits in (("wind", (0.0, np.inf)), ("cloud", (0.0, 1.0))):  # what is possible
        if name in values:
            values[name] = np.clip(values[name], *limits)
    if FORMULA in causes(conditions):
        reach = np.cumsum(conditions.film_shares)
        values[FORMULA] = np.concatenate([[-1.0], np.searchsorted(reach[:-1], spread(), side="right")])
    return Draws(values, seed)


def causes(conditions: Conditions) -> list[str]:
    """Return the names of the causes of uncertainty but `GEOMETRY`: inexact quantities, formula, repeatability."""
    named = [name for name, what in uncertain(conditions).items() if what.off_by > 0.0]
    named += [FORMULA] * (conditions.film.model == BALANCE and bool(conditions.film_shares.max() < 1.0))
    return named + [REPEATABILITY] * (conditions.camera.repeatability.off_by > 0.0)


def uncertain(conditions: Conditions) -> dict[str, Measured]:
    """Return all stated quantities that enter the results, exact ones too, by the names that reports use."""
    film, camera, around = conditions.film, conditions.camera, conditions.surroundings
    named: dict[str, Measured | None] = {
        "inside air": conditions.inside.air,
        "outside air": conditions.outside.air,
        "wind": conditions.outside.wind,
        "film factor": film.factor,
        "film coefficient": film.coefficient,
        "camera offset": camera.offset,
        "emissivity set in the camera": camera.emissivity,
        "reflected temperature set in the camera": camera.reflected,
        "reflected temperature": around.reflected,
        "cloud": None if around.sky is None else around.sky.cloud,
        "dew point": None if around.sky is None else around.sky.dew_point,
        "ground": around.ground,
    }
    named |= {emissivity_name(conditions, n): surface.emissivity for n, surface in enumerate(conditions.surfaces)}
    named |= {f"contact temperature {n}": one.temperature for n, one in enumerate(conditions.references, start=1)}
    return {name: what for name, what in named.items() if what is not None}


def emissivity_name(conditions: Conditions, number: int) -> str:
    """Return the name that reports use for the emissivity of entry `number`, from 0, of `Conditions.surfaces`."""
    return f"emissivity of {', '.join(conditions.surfaces[number].patches)}, entry {number + 1}"
