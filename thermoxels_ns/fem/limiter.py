"""Steps of backward Euler whose temperatures stay in range on any mesh.

Where faces meet at an obtuse angle, the stiffness matrix couples two nodes with the wrong sign: heat flows from the
colder to the warmer one. With smooth temperatures that is right, because flows along other edges outweigh it; beside a
jump that the mesh cannot resolve, a temperature may leave the range that it came from and that surrounds it.

A step after which one has left is taken again without the wrong-signed couplings of the nodes that left, and again if
others leave then; without all of them (see `WrongCouplings`) none can, so it ends. Where temperatures stay in range,
that is wherever the mesh resolves them, nothing is left out and the order of the error is what it was. Steps with
couplings left out were measured to be of first order too, on three meshes from isosurface stuffing and on one whose
angles are at the bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.positive_off_diagonals import WrongCouplings
from thermoxels_ns.fem.schemes import BACKWARD_EULER
from thermoxels_ns.fem.stepper import Step, Stepper
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

RANGE_ROUND_OFF = 1e-9
"""How far out of its range a temperature may be, as a share of the range of the whole computation so far."""
MOST_SLACK = 1e-6
"""The most that a temperature may be out of range besides round-off, as such a share, however loose a tolerance is."""
LEVEL_ROUND_OFF = 1e-12
"""The same as a share of the absolute temperature: what the linear solver and floating point leave."""


@dataclass(frozen=True)
class KeptStep:
    """A step of backward Euler that was kept in range."""

    step: Step
    """Its outcome; iterations of all repetitions count."""
    plain_k: Vector
    """Temperatures after it as they were before any coupling was left out, shape (n,), [K]."""
    limited: bool
    """Whether couplings were left out."""
    in_range: bool
    """Whether all temperatures are in range. They are not if the step failed, and may not be with consistent masses or
    boundary exchange."""


class RangeKeeper:
    """Backward Euler with a watch on the range."""

    def __init__(self, system: HeatSystem, *, relative_tolerance: float) -> None:
        """Prepare; what only some meshes need is made when it is needed.

        Args:
            system: The equations.
            relative_tolerance: Of the linear solver.
        """
        self._system, self._relative_tolerance = system, relative_tolerance
        self._plain = Stepper(system, BACKWARD_EULER, relative_tolerance=relative_tolerance)
        self._range = RangeWatch(system)
        self._wrong: WrongCouplings | None = None

    def step(self, start_k: Vector, time_s: float, step_s: float, slack_k: float = 0.0) -> KeptStep:
        """Take one step.

        Args:
            start_k: Temperatures at the start, relative to the system's reference, shape (n,), [K].
            time_s: Time at the start.
            step_s: Length, [s].
            slack_k: As in `RangeWatch.at`.
        """
        step = self._plain.step(start_k, time_s, step_s)
        if not step.converged:
            return KeptStep(step, step.relative_k, limited=False, in_range=False)
        low, high = self._range.at(start_k, (time_s, time_s + step_s), slack_k)
        if is_in_range(step, low, high):
            return KeptStep(step, step.relative_k, limited=False, in_range=True)
        if not self._system.lumped:
            return KeptStep(step, step.relative_k, limited=False, in_range=False)
        if self._wrong is None:
            self._wrong = WrongCouplings(self._system)
        plain_k, couplings = step.relative_k, self._wrong.begin()
        iterations, newton_iterations = step.iterations, step.newton_iterations
        while step.converged and not is_in_range(step, low, high):
            limited = couplings.more((step.relative_k < low) | (step.relative_k > high))
            if limited is None:
                break
            stepper = Stepper(limited, BACKWARD_EULER, relative_tolerance=self._relative_tolerance)
            step = stepper.step(start_k, time_s, step_s)
            iterations, newton_iterations = iterations + step.iterations, newton_iterations + step.newton_iterations
        step = step.with_iterations(iterations, newton_iterations)
        in_range = step.converged and is_in_range(step, low, high)
        return KeptStep(step, plain_k, limited=couplings.count > 0, in_range=in_range)


class RangeWatch:
    """The range that temperatures may have, with slack for round-off.

    Near equilibrium the range of a single step shrinks to nothing, round-off does not; so its slack is a share of the
    widest range so far.
    """

    def __init__(self, system: HeatSystem) -> None:
        """Begin.

        Args:
            system: The equations.
        """
        self._system, self._widest_k = system, 0.0

    def at(self, start_k: Vector, times_s: tuple[float, ...], slack_k: float = 0.0) -> tuple[float, float]:
        """Give lowest and highest temperature after a step, [K].

        Args:
            start_k: Temperatures at the start, relative to the system's reference, shape (n,), [K].
            times_s: Times at which the surroundings count, [s].
            slack_k: How far out of it a temperature may be besides round-off, [K], but no more than `MOST_SLACK` of the
                widest range.
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
