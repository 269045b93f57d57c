"""Physical quantities: each is one number, or a function of place and time, with a range of allowed values."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError


@dataclass(frozen=True)
class Places:
    """The k places where a quantity is evaluated: centroids of boundary triangles, points in tetrahedra, or nodes."""

    points_m: FloatArray  # Positions, shape (k, 3), [m]
    normals: FloatArray  # Outward unit normals of the surface, shape (k, 3); 0 inside the body
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # Unit vector that points up

    def __len__(self) -> int:
        return len(self.points_m)


@dataclass(frozen=True)
class Varying:
    """A quantity that differs from place to place or changes with time.

    >>> sunrise = Varying(lambda places, time_s: 100.0 * min(time_s / 3600.0, 1.0))
    >>> sunrise.function(Places(np.zeros((2, 3)), np.zeros((2, 3))), 1800.0)
    50.0
    """

    function: Callable[[Places, float], npt.ArrayLike]
    """Function of the places and of the time in seconds since the start; it returns one number per place, shape (k,),
    or one number for all places."""
    in_time: bool = True  # True if the numbers change with time; False: they are always those at the time 0
    resolution_s: float = math.inf
    """Longest time between two evaluations that misses no change, above 0, [s]; no adaptive step is longer. Infinite:
    this time is not known, and changes within a step are missed."""


def tabulated(times_s: npt.ArrayLike, values: npt.ArrayLike) -> Varying:
    """Return a quantity that is interpolated linearly between the entries of a table of times and values.

    Before the first entry it has the first value, after the last entry the last value. Adaptive steps are no longer
    than the shortest time between two entries, so that no entry is stepped over.

    Args:
        times_s: Times, ascending, at least two, shape (k,), [s].
        values: Values of the quantity at these times, shape (k,).

    Raises:
        HeatError: The times do not ascend, shapes differ, or an entry is no finite number.

    >>> tabulated([0.0, 3600.0, 7200.0], [10.0, 20.0, 10.0]).resolution_s
    3600.0
    """
    try:
        times, entries = np.array(times_s, dtype=np.float64), np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        times = entries = np.zeros(0)
    fits = times.ndim == 1 and len(times) >= 2 and entries.shape == times.shape
    if not (fits and np.isfinite(times).all() and np.isfinite(entries).all() and np.all(np.diff(times) > 0.0)):
        expected = "at least two times, ascending, and as many values, all finite"
        got = f"times of shape {times.shape} and values of shape {entries.shape}"
        raise HeatError("table", expected=expected, got=got, remedy="Sort it by time and remove repetitions.")
    return Varying(partial(_interpolated, times, entries), resolution_s=float(np.min(np.diff(times))))


def _interpolated(times_s: FloatArray, values: FloatArray, _: Places, time_s: float) -> float:
    return float(np.interp(time_s, times_s, values))


Quantity: TypeAlias = float | Varying  # One number for all places and times, or a function


@dataclass(frozen=True)
class Bounds:
    """The range of values that a quantity may have, with the quantity's name and unit for messages."""

    name: str  # Name of the quantity, for messages
    unit: str  # Unit of the quantity, for messages
    low: float = -math.inf  # Smallest allowed value
    high: float = math.inf  # Largest allowed value
    above_low: bool = False  # True if `low` itself is refused
    varies: bool = True  # True if the quantity may be a `Varying`
    remedy: str = ""  # Advice to a user whose value is refused; empty: an example of a value in the unit

    def check(self, value: npt.ArrayLike) -> FloatArray:
        """Return values as an array of the same shape if all are finite and in range, else raise `HeatError`."""
        try:
            values = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.array([np.nan])
        fits = np.isfinite(values) & (values <= self.high)
        fits &= (values > self.low) if self.above_low else (values >= self.low)
        if np.asarray(value).dtype == np.bool_ or not np.all(fits):
            got = repr(value) if np.ndim(value) == 0 else f"{np.count_nonzero(~fits)} of {values.size} that are not"
            raise HeatError(self.name, expected=self._expected(), got=got, remedy=self._remedy())
        return values

    def check_quantity(self, quantity: Quantity) -> Quantity:
        """Return a number in range as a float, and a `Varying` unchanged; raise `HeatError` for anything else."""
        if isinstance(quantity, Varying) and self.varies:
            return quantity
        if callable(quantity) or isinstance(quantity, (Varying, str)) or np.ndim(quantity) != 0:
            expected, remedy = "a number", self._remedy()
            if self.varies:
                expected = "a number or a Varying"
                remedy = "Wrap a function: Varying(function, in_time=True), or in_time=False if time does not matter."
            raise HeatError(self.name, expected=expected, got=repr(quantity), remedy=remedy)
        return float(self.check(quantity))

    def _remedy(self) -> str:
        if self.remedy:
            return self.remedy
        example = 20.0 if self.low < 20.0 <= self.high else 0.5 * (self.low + self.high)
        return f"Give {self.name}{'' if self.unit == '1' else f' in {self.unit}'}, such as {example:g}."

    def _expected(self) -> str:
        parts = ["a finite number"]
        if self.low > -math.inf:
            parts.append(f"{'above' if self.above_low else 'of at least'} {self.low:g}")
        if self.high < math.inf:
            parts.append(f"{'and ' if len(parts) > 1 else ''}at most {self.high:g}")
        return " ".join(parts) + f" [{self.unit}]"


@dataclass(frozen=True)
class Bounded:
    """A quantity with its range, which `at` evaluates and checks."""

    quantity: Quantity  # A number or a `Varying`
    bounds: Bounds  # Range of its values

    @property
    def in_time(self) -> bool:
        """True if the quantity changes with time."""
        return isinstance(self.quantity, Varying) and self.quantity.in_time

    @property
    def unresolved(self) -> bool:
        """True if the quantity changes with time and its `resolution_s` is not known."""
        return self.in_time and math.isinf(self.resolution_s)

    @property
    def resolution_s(self) -> float:
        """`Varying.resolution_s` of a quantity that changes with time, [s]; else infinite."""
        return self.quantity.resolution_s if isinstance(self.quantity, Varying) and self.in_time else math.inf

    def at(self, places: Places, time_s: float) -> FloatArray:
        """Return the quantity at k places and a time, shape (k,).

        Raises:
            HeatError: A function returned the wrong shape, or values out of range.
        """
        if not isinstance(self.quantity, Varying):
            return np.full(len(places), self.quantity, dtype=np.float64)
        value = self.quantity.function(places, time_s if self.in_time else 0.0)
        if isinstance(value, float) and self.bounds.low < value < self.bounds.high:
            return np.full(len(places), value, dtype=np.float64)
        values = self.bounds.check(value)
        if values.shape not in ((), (len(places),)):
            expected = f"one number, or one per place, shape ({len(places)},)"
            remedy = "Correct the function given to Varying."
            raise HeatError(f"function of {self.bounds.name}", expected=expected, got=values.shape, remedy=remedy)
        return np.broadcast_to(values, (len(places),)).copy()
