"""What it saves to leave effects out, measured on one step in time."""

from __future__ import annotations

import time as clock

from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.schemes import BACKWARD_EULER, SDIRK2
from thermoxels_ns.fem.stepper import Stepper
from thermoxels_ns.fem.system import HeatSystem

_TOLERANCE = 1e-12


def seconds_saved(problem: HeatProblem, without: HeatProblem, time: TimeSteps | AdaptiveSteps, steps: int) -> float:
    """Estimate the time that a computation would have taken more with all effects of a problem.

    One step of either is taken, of a length such as the computation had; how many steps an adaptive computation would
    have needed is not known and taken to be the same.

    Args:
        problem: With all effects.
        without: With those that are kept.
        time: How it is followed.
        steps: Number of steps that were taken.

    Returns:
        The difference, [s]; at least 0.

    Raises:
        HeatError: A step of the problem with all effects cannot be solved.
    """
    step_s = time.duration_s / max(steps, 1)
    more = [ours - theirs for ours, theirs in zip(_seconds(problem, time, step_s), _seconds(without, time, step_s))]
    return max(more[0] + steps * more[1], 0.0)


def _seconds(problem: HeatProblem, time: TimeSteps | AdaptiveSteps, step_s: float) -> tuple[float, float]:
    """Time to set up a problem and to take a step, the second one, which finds its matrices made, [s]."""
    begin = clock.perf_counter()
    system = HeatSystem(problem)
    adaptive = isinstance(time, AdaptiveSteps)
    stepper = Stepper(system, SDIRK2 if adaptive else BACKWARD_EULER, relative_tolerance=_TOLERANCE)
    first = stepper.step(problem.start_c - system.reference_c, 0.0, step_s, estimate=adaptive)
    ready = clock.perf_counter()
    stepper.step(first.relative_k, step_s, step_s, estimate=adaptive)
    end = clock.perf_counter()
    return ready - begin - (end - ready), end - ready
