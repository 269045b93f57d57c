"""Newton's method for the heat balance with radiation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.conjugate_gradients import LinearSolution
from thermoxels_ns.fem.pieces import is_within

Vector = npt.NDArray[np.float64]

MAX_ITERATIONS = 60
"""Newton steps before giving up."""

_SAFE = 0.1
"""A change of an absolute temperature by this share changes the slope of radiation by no more than a third, so that a
full step leads down."""
_SETTLED = 1e-5
"""After a step as short as this the error is about its square: a body that cools from 1000 K to 3 K has a residual of
1e-10 of the first one long before."""
_ENOUGH = 0.5
"""A step is long enough if the slope along it has changed sign or fallen, and is no more than this share of what it
was."""
_MOST_SEARCHES = 200


@dataclass(frozen=True)
class Residual:
    """Heat that is not balanced yet."""

    heat_w: Vector
    """At each free node, [W]."""
    piece_heat_w: Vector
    """Summed over each connected piece, without the round-off of what flows inside, [W]."""
    round_off_w: Vector
    """What round-off may leave at each free node, [W]."""
    piece_round_off_w: Vector
    """The same for each piece, [W]."""

    @property
    def is_round_off(self) -> bool:
        """Whether it is nothing but round-off, at every node and piece."""
        return is_within(self.piece_heat_w, self.piece_round_off_w) and is_within(self.heat_w, self.round_off_w)

    def is_small(self, heat_w: float, before: Residual) -> bool:
        """Whether it is within a tolerance or round-off at the nodes, and each piece is balanced.

        A piece is balanced to round-off, or if it is not much better than it was a step `before`.
        """
        nodes = _norm(self.heat_w) <= max(heat_w, _norm(self.round_off_w))
        piece_w = np.abs(self.piece_heat_w)
        balanced = (piece_w <= self.piece_round_off_w) | (piece_w > 0.5 * np.abs(before.piece_heat_w))
        return nodes and bool(np.all(balanced))


class Equations(Protocol):
    """Residual(u) = 0, minus the derivative of an energy."""

    def residual(self, u: Vector) -> Residual:
        """Give the residual at u."""
        ...

    def correction(self, u: Vector, residual: Residual) -> tuple[Vector, LinearSolution]:
        """Solve the linearised equations: a direction, and how well it was found."""
        ...

    def is_short(self, u: Vector, direction: Vector, share: float) -> bool:
        """Whether no absolute temperature changes by more than a share of it from u to u + direction."""
        ...

    def is_lost(self, u: Vector, direction: Vector) -> bool:
        """Whether no unknown is changed by more than round-off from u to u + direction."""
        ...

    def rise(self, u: Vector, direction: Vector) -> Callable[[float], float]:
        """Give the slope of the energy along a direction, an increasing function of the length."""
        ...


@dataclass(frozen=True)
class NewtonSolution:
    """A solution and how it was found."""

    u: Vector
    """The solution, shape (m,)."""
    iterations: int
    """Newton steps."""
    linear_iterations: int
    """Iterations of the linear solver in all of them."""
    converged: bool
    """Whether the residual is within the tolerance or as small as round-off, or the next step would be."""
    status: str
    """The outcome as a sentence."""


def newton(equations: Equations, num_unknowns: int, *, relative_tolerance: float) -> NewtonSolution:
    """Find where the residual vanishes, from u = 0.

    Radiation grows with the temperature and its slope is symmetric, so the solution is the one minimum of a convex
    energy. Newton's direction always leads down, and how far to go is a search for the zero of one increasing function
    along it: no damping factor is guessed, and the method converges from any start.

    Args:
        equations: The equations.
        num_unknowns: Length of u.
        relative_tolerance: Stop when the residual is at most this share of the first one.
    """
    u = np.zeros(num_unknowns)
    residual = equations.residual(u)
    first = _norm(residual.heat_w)
    spent, reason, count = 0, f"stopped after {MAX_ITERATIONS} steps", 0
    settled, before = False, residual
    while not (settled and residual.is_small(relative_tolerance * first, before)):
        if count == MAX_ITERATIONS or not np.isfinite(_norm(residual.heat_w)):
            share = _norm(residual.heat_w) / first if first > 0.0 else np.inf
            status = f"Newton's method {reason}, at a relative residual of {share:.1e}."
            return NewtonSolution(u, count, spent, False, status)
        direction, linear = equations.correction(u, residual)
        spent += linear.iterations
        if not linear.converged:
            return NewtonSolution(
                u, count, spent, False, f"Newton's method stopped in step {count + 1}: {linear.status}"
            )
        settled, lost = equations.is_short(u, direction, _SETTLED), equations.is_lost(u, direction)
        u = u + _length(equations, u, direction) * direction
        before, residual = residual, equations.residual(u)
        count += 1
        if settled and lost:
            # What is left of the residual is round-off that its bound does not know of, such as that of what was given.
            break
    return NewtonSolution(u, count, spent, True, f"Newton's method converged in {count} steps.")


def _length(equations: Equations, u: Vector, direction: Vector) -> float:
    """Find how much of a direction to go: all of it, or about to where the energy along it is least."""
    if equations.is_short(u, direction, _SAFE):
        return 1.0
    rise = equations.rise(u, direction)
    start = rise(0.0)
    if start >= 0.0 or rise(1.0) <= _ENOUGH * -start:
        return 1.0
    left, right = 0.0, 1.0
    for _ in range(_MOST_SEARCHES):
        # The zero may lie many powers of ten below 1: a cold body that sees a hot one has next to no slope.
        middle = 0.25 * right if left == 0.0 else 0.5 * (left + right)
        value = rise(middle)
        if abs(value) <= _ENOUGH * -start:
            return middle
        left, right = (middle, right) if value < 0.0 else (left, middle)
    return right


def _norm(vector: Vector) -> float:
    return float(np.sqrt(np.sum(np.square(vector))))
