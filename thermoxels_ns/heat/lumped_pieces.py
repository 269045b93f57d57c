"""Pieces of one temperature each through time: C T' = a - b T + radiation(T), one such equation per piece.

Without radiation its solution is an exponential, and so is the mean temperature of an interval, of which convection
takes its heat. With radiation it is integrated, and the means of T and of its fourth power with it: heat flows are
functions of these two, so that what flows is what is stored whatever the steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.integrate import solve_ivp

Vector = npt.NDArray[np.float64]

HOT_K = 300.0
"""Fourth powers are in units of that of this temperature, [K]."""
_TOLERANCE = 1e-9
"""Relative tolerance where there is radiation, and absolute one in kelvin."""
_SERIES_BELOW = 0.02
"""Exponent below which the mean of an exponential comes from its series, which loses no digits."""
_MOST_RATES = 200_000
"""Evaluations after which an equation is given up: a body from 1000 K to 3 K takes a few hundred."""


@dataclass(frozen=True)
class PieceEquations:
    """Constants of the equations; temperatures are relative to a reference."""

    capacity_j_k: Vector
    """C, shape (p,), [J / K]."""
    given_w: Vector
    """a, what flows in at the reference without radiation, shape (p,), [W]."""
    held_w_k: Vector
    """b, convection, shape (p,), [W / K]."""
    radiated_in_w: Vector
    """Radiation that is absorbed, shape (p,), [W]."""
    emitted_at_hot_w: Vector
    """Radiation that is emitted at `HOT_K`, shape (p,), [W]."""
    reference_k: float
    """The reference, [K]."""


@dataclass(frozen=True)
class PieceHistory:
    """Temperatures of pieces, and the means that heat flows follow from."""

    relative_k: Vector
    """At each time, shape (s + 1, p), [K]."""
    mean_k: Vector
    """Mean of each interval, shape (s, p), [K]."""
    radiating_k: Vector
    """Fourth root of the mean fourth power of the absolute temperature, relative too, shape (s, p), [K]."""


class TooHardError(Exception):
    """An equation could not be integrated."""


def follow_pieces(equations: PieceEquations, start_k: Vector, times_s: Vector) -> PieceHistory:
    """Solve the equations.

    Args:
        equations: Their constants.
        start_k: Temperatures at the first time, shape (p,), [K].
        times_s: Times, ascending from 0, shape (s + 1,), [s].

    Raises:
        TooHardError: Radiation could not be integrated.

    >>> one = np.ones(1)
    >>> cooling = PieceEquations(one, 0.0 * one, one, 0.0 * one, 0.0 * one, 300.0)
    >>> history = follow_pieces(cooling, 8.0 * one, np.array([0.0, np.log(2.0)]))
    >>> history.relative_k.round(12).tolist(), (history.mean_k * np.log(2.0)).round(12).tolist()
    ([[8.0], [4.0]], [[4.0]])
    """
    shape = (len(times_s) - 1, len(start_k))
    relative_k, mean_k, radiating_k = np.tile(start_k, (len(times_s), 1)), np.zeros(shape), np.zeros(shape)
    radiates = (equations.emitted_at_hot_w > 0.0) | (equations.radiated_in_w != 0.0)
    _follow_exponentials(equations, np.flatnonzero(~radiates), times_s, relative_k, mean_k)
    radiating_k[:, ~radiates] = mean_k[:, ~radiates]
    if radiates.any():
        _follow_radiation(equations, np.flatnonzero(radiates), times_s, relative_k, mean_k, radiating_k)
    return PieceHistory(relative_k, mean_k, radiating_k)


def _follow_exponentials(
    equations: PieceEquations, pieces: npt.NDArray[np.int64], times_s: Vector, relative_k: Vector, mean_k: Vector
) -> None:
    """Fill in the columns of pieces without radiation, interval by interval."""
    capacity, given, held = (part[pieces] for part in (equations.capacity_j_k, equations.given_w, equations.held_w_k))
    for row, length_s in enumerate(np.diff(times_s).tolist()):
        begin_k = relative_k[row, pieces]
        rise_k, decay = (given - held * begin_k) / capacity * length_s, held / capacity * length_s
        share = _mean_of_rise(decay)
        # 1 - decay * share, the share of the rise that is there at the end, without its round-off.
        small = decay < _SERIES_BELOW
        end = np.where(small, 1.0 - decay * share, -np.expm1(-decay) / np.where(small, 1.0, decay))
        mean_k[row, pieces] = begin_k + share * rise_k
        relative_k[row + 1, pieces] = begin_k + end * rise_k


def _mean_of_rise(decay: Vector) -> Vector:
    """Mean over s from 0 to 1 of (1 - exp(-x s)) / x.

    >>> _mean_of_rise(np.array([0.0, 0.019999, 0.020001, 1e30])).round(9).tolist()
    [0.5, 0.496683432, 0.496683102, 0.0]
    """
    x = np.minimum(decay, 1e150)
    series = 1.0 / 2.0 - x / 6.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0 * (1.0 - x / 6.0)))
    safe = np.where(x < _SERIES_BELOW, 1.0, x)
    return np.where(x < _SERIES_BELOW, series, (safe + np.expm1(-safe)) / safe / safe)


def _follow_radiation(
    equations: PieceEquations,
    pieces: npt.NDArray[np.int64],
    times_s: Vector,
    relative_k: Vector,
    mean_k: Vector,
    radiating_k: Vector,
) -> None:
    """Fill in the columns of pieces with radiation; unknowns are T and the integrals of T and of its fourth power."""
    count, zero_k = len(pieces), equations.reference_k
    capacity, given, held = (part[pieces] for part in (equations.capacity_j_k, equations.given_w, equations.held_w_k))
    given, emitted = given + equations.radiated_in_w[pieces], equations.emitted_at_hot_w[pieces]
    here = np.arange(count)
    rows, columns = np.concatenate([here, here + count, here + 2 * count]), np.tile(here, 3)
    spent = 0

    def rate(_: float, state: Vector) -> Vector:
        nonlocal spent
        spent += 1
        if spent > _MOST_RATES:
            raise TooHardError
        now_k = state[:count]
        power = ((now_k + zero_k) / HOT_K) ** 3 * np.abs(now_k + zero_k) / HOT_K
        return np.concatenate([(given - held * now_k - emitted * power) / capacity, now_k, power])

    def slopes(_: float, state: Vector) -> sparse.csc_matrix:
        per_kelvin = 4.0 * np.abs((state[:count] + zero_k) / HOT_K) ** 3 / HOT_K
        entries = np.concatenate([-(held + emitted * per_kelvin) / capacity, np.ones(count), per_kelvin])
        return sparse.csc_matrix((entries, (rows, columns)), shape=(3 * count, 3 * count))

    duration_s = float(times_s[-1])
    with np.errstate(over="ignore", invalid="ignore"):
        found = solve_ivp(
            rate,
            (0.0, duration_s),
            np.concatenate([relative_k[0, pieces], np.zeros(2 * count)]),
            method="Radau",
            t_eval=times_s,
            rtol=_TOLERANCE,
            atol=_TOLERANCE * np.repeat([1.0, duration_s], [count, 2 * count]),
            jac=slopes,
        )
    if not found.success or not np.isfinite(found.y).all():
        raise TooHardError
    relative_k[:, pieces] = found.y[:count].T
    means = np.diff(found.y[count:].T, axis=0) / np.diff(times_s)[:, None]
    mean_k[:, pieces] = means[:, :count]
    radiating_k[:, pieces] = HOT_K * np.maximum(means[:, count:], 0.0) ** 0.25 - zero_k
