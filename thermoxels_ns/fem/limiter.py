"""Maximum-principle limiter: keeps temperatures in the range they come from, on any mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.implicit_equation import ImplicitSolution
from thermoxels_ns.fem.runge_kutta import RungeKutta, Step
from thermoxels_ns.fem.schemes import BACKWARD_EULER
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]
Solved = TypeVar("Solved", Step, ImplicitSolution)

RANGE_ROUND_OFF = 1e-9
"""How far out of its range a temperature may be, as a share of the range of the whole computation so far."""
MOST_SLACK = 1e-6
"""The most that a temperature may be out of range besides round-off, as such a share, however loose a tolerance is."""
LEVEL_ROUND_OFF = 1e-12
"""The same as a share of the absolute temperature: what the linear solver and floating point leave."""
_POSITIVE = 1e-9  # Share of the diagonal above which an entry off it counts as above 0
_ROUND_OFF = 16.0 * float(np.finfo(np.float64).eps)
"""An entry above 0 by less than this share of the diagonal is what floating point left of 0."""
_ATTEMPTS = 8  # Attempts after which all positive off-diagonals are left out


def holds_maximum_principle(stiffness: sparse.csr_matrix) -> bool:
    """Whether a stiffness matrix has no entry above 0 off its diagonal, so that it is an M-matrix.

    So it is on meshes without obtuse angles between faces; then no temperature leaves the range of its neighbours.

    >>> holds_maximum_principle(sparse.csr_matrix([[1.0, -1.0], [-1.0, 1.0]]))
    True
    """
    entries = stiffness.tocoo()
    off = entries.row != entries.col
    return not np.any(entries.data[off] > _POSITIVE * stiffness.diagonal()[entries.row[off]])


class PositiveOffDiagonals:
    """Positive entries off the diagonal of a stiffness matrix, and which of them are left out.

    To leave one out keeps the matrix symmetric, its rows sum to 0 and heat is conserved. What is taken from an entry
    off the diagonal is added on it, so that the matrix stays positive semidefinite and no component comes apart.
    """

    def __init__(self, system: HeatSystem) -> None:
        self._system = system
        upper, diagonal = sparse.triu(system.stiffness, k=1, format="coo"), system.stiffness.diagonal()
        positive = upper.data > _ROUND_OFF * np.minimum(diagonal[upper.row], diagonal[upper.col])
        self._first, self._second, self._size = upper.row[positive], upper.col[positive], upper.data[positive]
        self.reset()

    def reset(self) -> None:
        """Leave none out."""
        self._left_out, self._attempts = np.zeros(len(self._size), dtype=bool), 0

    @property
    def count(self) -> int:
        """How many are left out."""
        return int(np.count_nonzero(self._left_out))

    def leave_out(self, outside: npt.NDArray[np.bool_]) -> HeatSystem | None:
        """Leave out those of more nodes, marked by `outside`, shape (n,), and all after some attempts.

        Returns the equations without them, or None if there are no more to leave out.
        """
        last = self._attempts == _ATTEMPTS
        more = ~self._left_out if last else (outside[self._first] | outside[self._second]) & ~self._left_out
        if self._attempts > _ATTEMPTS or not more.any():
            return None
        self._attempts += 1
        self._left_out |= more
        first, second, size = (part[self._left_out] for part in (self._first, self._second, self._size))
        rows, columns = np.concatenate([first, second, first, second]), np.concatenate([second, first, first, second])
        entries = np.concatenate([-size, -size, size, size])
        change = sparse.csr_matrix((entries, (rows, columns)), shape=self._system.stiffness.shape)
        return self._system.with_stiffness(sparse.csr_matrix(self._system.stiffness + change))


def solve_in_range(
    entries: PositiveOffDiagonals,
    first: Solved,
    low: float,
    high: float,
    solve: Callable[[HeatSystem, Solved], Solved],
) -> tuple[Solved, HeatSystem | None]:
    """Solve again without positive off-diagonals of nodes out of range until none is, or nothing is left to leave out.

    `solve` gets the limited equations and the last solution. Returns the last solution with the iterations of all, and
    the equations that it fulfils; None: the unchanged ones.
    """
    solution, limited = first, None
    while solution.converged:
        outside = (solution.relative_k < low) | (solution.relative_k > high)
        more = entries.leave_out(outside) if outside.any() else None
        if more is None:
            break
        limited, again = more, solve(more, solution)
        iterations = solution.iterations + again.iterations
        newton_iterations = solution.newton_iterations + again.newton_iterations
        solution = replace(again, iterations=iterations, newton_iterations=newton_iterations)
    return solution, limited


class AllowedRange:
    """The range that temperatures may have after a step, with slack for round-off.

    Near equilibrium the range of a single step shrinks to nothing, round-off does not; so its slack is a share of the
    widest range so far.
    """

    def __init__(self, system: HeatSystem) -> None:
        self._system, self._widest_k = system, 0.0

    def at(self, start_k: Vector, times_s: tuple[float, ...], slack_k: float = 0.0) -> tuple[float, float]:
        """Give lowest and highest temperature after a step from `start_k`, shape (n,), [K].

        Surroundings count at `times_s`. Temperatures may be out by `slack_k`, but no more than `MOST_SLACK` of the
        widest range, and by round-off.
        """
        coldest_k, warmest_k = float(start_k.min()), float(start_k.max())
        low, high = self._system.allowed_range_k((coldest_k, warmest_k), times_s)
        if np.isfinite(high - low):
            self._widest_k = max(self._widest_k, high - low)
        level_k = max(abs(coldest_k), abs(warmest_k)) + abs(self._system.reference_c + ZERO_CELSIUS_K)
        slack_k = min(slack_k, MOST_SLACK * self._widest_k)
        slack_k = max(slack_k, RANGE_ROUND_OFF * self._widest_k, LEVEL_ROUND_OFF * level_k)
        return low - slack_k, high + slack_k


def is_in_range(step: Step, low: float, high: float) -> bool:
    """Whether all temperatures after a step are from `low` to `high`."""
    return low <= float(step.relative_k.min()) and float(step.relative_k.max()) <= high


class Limiter:
    """Steps of backward Euler that keep temperatures in range.

    Where faces meet at an obtuse angle, the stiffness matrix has an entry above 0 off its diagonal: beside a jump that
    the mesh cannot resolve, a temperature may leave the range that it came from and that surrounds it.

    A step in which one has left is solved again without the positive off-diagonals of the nodes that left, and again if
    others leave then. Without all of them the matrix is an M-matrix, of which no temperature leaves its range (Ciarlet
    and Raviart, Computer Methods in Applied Mechanics and Engineering 2, 1973), so it ends. Where the mesh resolves the
    temperatures nothing is left out. Steps with entries left out were measured to be of first order too.
    """

    def __init__(self, system: HeatSystem, *, relative_tolerance: float) -> None:
        self._system, self._relative_tolerance = system, relative_tolerance
        self._plain = RungeKutta(system, BACKWARD_EULER, relative_tolerance=relative_tolerance)
        self._range = AllowedRange(system)
        self._entries: PositiveOffDiagonals | None = None

    def step(self, start_k: Vector, time_s: float, step_s: float, slack_k: float = 0.0) -> tuple[Step, Vector]:
        """Take one step from `start_k`, shape (n,), [K]; `slack_k` as in `AllowedRange.at`.

        Returns the step, and the temperatures after it before any entry was left out, shape (n,), [K]. They may be out
        of range if the step failed, or with consistent masses or convection.
        """
        plain = self._plain.step(start_k, time_s, step_s)
        if not plain.converged:
            return replace(plain, in_range=False), plain.relative_k
        low, high = self._range.at(start_k, (time_s, time_s + step_s), slack_k)
        if is_in_range(plain, low, high) or not self._system.lumped:
            return replace(plain, in_range=is_in_range(plain, low, high)), plain.relative_k
        if self._entries is None:
            self._entries = PositiveOffDiagonals(self._system)
        self._entries.reset()

        def solve(limited: HeatSystem, _: Step) -> Step:
            runge_kutta = RungeKutta(limited, BACKWARD_EULER, relative_tolerance=self._relative_tolerance)
            return runge_kutta.step(start_k, time_s, step_s)

        step, limited = solve_in_range(self._entries, plain, low, high, solve)
        in_range = step.converged and is_in_range(step, low, high)
        return replace(step, limited=limited is not None, in_range=in_range), plain.relative_k
