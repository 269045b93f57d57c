"""Physical quantities: each is one number, or a function of place and time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray


@dataclass(frozen=True)
class Places:
    """The k places where a quantity is evaluated: centroids of boundary triangles, points in tetrahedra, or nodes."""

    points_m: FloatArray  # Positions, shape (k, 3), [m]
    normals: FloatArray  # Outward unit normals of the surface, shape (k, 3); 0 in tetrahedra and at nodes
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
    """Longest time between two evaluations that misses no change, above 0, [s]; no adaptive step is longer."""


def tabulated(times_s: FloatArray, values: FloatArray) -> Varying:
    """Return a quantity that is interpolated linearly between the entries of a table of times and values.

    Before the first entry it has the first value, after the last entry the last value. Adaptive steps are no longer
    than the shortest time between two entries, so that no entry is stepped over.

    Args:
        times_s: Times, ascending, at least two, shape (k,), [s].
        values: Values of the quantity at these times, shape (k,).

    >>> tabulated(np.array([0.0, 3600.0, 7200.0]), np.array([10.0, 20.0, 10.0])).resolution_s
    3600.0
    """
    return Varying(partial(_interpolated, times_s, values), resolution_s=float(np.min(np.diff(times_s))))


def _interpolated(times_s: FloatArray, values: FloatArray, _: Places, time_s: float) -> float:
    return float(np.interp(time_s, times_s, values))


Quantity: TypeAlias = float | Varying  # One number for all places and times, or a function


def in_time(quantity: Quantity) -> bool:
    """Return whether a quantity changes with time."""
    return isinstance(quantity, Varying) and quantity.in_time


def values_at(quantity: Quantity, places: Places, time_s: float) -> FloatArray:
    """Return the values of a quantity at k places and a time, shape (k,)."""
    if isinstance(quantity, Varying):
        found = quantity.function(places, time_s if quantity.in_time else 0.0)
    else:
        found = quantity
    return np.broadcast_to(np.asarray(found, dtype=np.float64), (len(places),)).copy()
