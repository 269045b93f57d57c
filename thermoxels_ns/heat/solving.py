"""How ``thermoxels heat`` solves a scene: with the scene's own steps on the mesh as it is, or to a tolerance."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoxels_ns.commands.heat import Heat
from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.error_budget import Tolerance
from thermoxels_ns.fem.memory import check_memory, describe_bytes, peak_bytes
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution
from thermoxels_ns.fem.solution_nodes import Solution
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.fem.tolerance import ToleratedSolution, solve_to_tolerance
from thermoxels_ns.heat.results import plain_values
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.heat.screening import Screening, screen

Say = Callable[[str], None]
Lap = Callable[[str], None]

LEFT_OUT_SHARE = 0.2
"""Share of the tolerance that effects which are left out may use together; the solver gets what they do not use."""
LEAVE_OUT_BELOW_K = 0.01
"""The same without a tolerance, [K]: a fifth of the default tolerance of the time steps."""
SAY_EVERY_S = 10.0
"""Time between two lines of progress, [s]."""
SAY_FIRST_S = 1.0
"""Time of a first step from which on it is said, [s]: then the next ones will take some, too."""


@dataclass(frozen=True)
class Accuracy:
    """What is known of the error, and how the tolerance was met."""

    tolerance_k: float | None
    """Error of any temperature that was allowed, [K]; None: any."""
    flow_tolerance: float | None
    """Error of the mean heat flow of any effect that was allowed, as a share of all heat; None: any."""
    met: bool
    """Whether the estimates are within it."""
    estimated_k: float
    """Estimated largest error of a temperature, what is left out included, [K]."""
    estimated_flow: float
    """Estimated largest error of a heat flow as a share of all heat."""
    left_out_k: float
    """What of `estimated_k` is the bound of the effects that are left out, [K]."""
    order: int
    """1 for linear tetrahedra, 2 for quadratic ones."""
    refinements: int
    """How often the size of the given mesh was halved."""
    step_tolerance_k: float | None
    """Tolerance of the time steps, [K]; None without steps."""
    seconds: float
    """Time for all solutions and estimates, [s]."""
    status: str
    """The outcome as a sentence."""
    levels: tuple[dict[str, Any], ...]
    """All solutions on the way with their estimates and seconds, the one that counts last."""


@dataclass(frozen=True)
class SolvedScene:
    """A solution and what it is one of."""

    problem: HeatProblem
    """What was solved last: without what is left out, and perhaps on a finer mesh than the given one."""
    solution: Solution
    """Temperatures and heat flows."""
    screening: Screening
    """What was built."""
    accuracy: Accuracy | None
    """What is known of the error; None if no tolerance was given."""


def leave_out_below_k(options: Heat) -> float:
    """Tell what effects that are left out may change together, [K].

    Raises:
        HeatError: It is negative, or all of the tolerance.
    """
    given, tolerance_k = options.leave_out_below_k, options.tolerance
    if given is None:
        if options.flow_tolerance is not None:
            return 0.0
        return LEAVE_OUT_BELOW_K if tolerance_k is None else LEFT_OUT_SHARE * tolerance_k
    if not 0.0 <= given < np.inf:
        expected, remedy = "a finite number of at least 0", "Pass 0 to build everything."
        raise HeatError("leave-out-below-k", expected=expected, got=given, remedy=remedy)
    if tolerance_k is not None and given >= tolerance_k:
        expected, remedy = f"less than the tolerance of {tolerance_k:g} K", "Leave it out for a fifth of the tolerance."
        raise HeatError("leave-out-below-k", expected=expected, got=f"{given:g} K", remedy=remedy)
    return given


def check_accuracy_options(options: Heat, scene: HeatScene) -> None:
    """Refuse options that make no sense together, before anything is read or computed.

    Raises:
        HeatError: One is out of range or needs another.
    """
    check_positive("memory-gb", options.memory_gb, "Give it in GiB, such as 4.", HeatError)
    if options.tolerance is not None:
        check_positive("tolerance", options.tolerance, "Give it in kelvin, such as 0.05.", HeatError)
    if options.flow_tolerance is not None:
        remedy = "Give a share, such as 0.01 for 1 %."
        check_positive("flow-tolerance", options.flow_tolerance, remedy, HeatError)
        if options.flow_tolerance >= 1.0:
            got = f"{options.flow_tolerance:g}, which is {100.0 * options.flow_tolerance:g} %"
            raise HeatError("flow-tolerance", expected="less than 1", got=got, remedy=remedy)
    if scene.time is not None and options.flow_tolerance is not None and options.tolerance is None:
        remedy = "Pass --tolerance too: steps in time are chosen by it."
        raise HeatError(
            "flow-tolerance", expected="--tolerance beside it if the scene has a duration", got="none", remedy=remedy
        )
    leave_out_below_k(options)


def solve_scene(options: Heat, scene: HeatScene, problem: HeatProblem, say: Say, lap: Lap) -> SolvedScene:
    """Leave out what does not matter, and solve the rest.

    Args:
        options: What was asked.
        scene: The scene.
        problem: The scene around the mesh.
        say: Called with one line of progress at a time.
        lap: Called with the name of each part when it is done.

    Raises:
        HeatError: The problem needs more memory than allowed, its solver fails, or the tolerance cannot be met.
    """
    screening = screen(problem, scene.time, leave_out_below_k(options))
    lap("screen")
    _say_what_is_built(screening, say)
    if options.tolerance is not None or options.flow_tolerance is not None:
        return _to_tolerance(options, scene, screening, say)
    times = 1 if scene.time is None else scene.time.num_times
    needed = peak_bytes(screening.problem, times=times, adaptive=isinstance(scene.time, AdaptiveSteps))
    say(f"Memory: about {describe_bytes(needed)} at most.")
    check_memory(needed, options.memory_gb * 2**30, "Pass a larger --memory-gb, or export a coarser mesh.")
    if scene.time is None:
        return SolvedScene(screening.problem, solve_steady(screening.problem), screening, None)
    solution = solve_heat(screening.problem, scene.time, progress=_Progress(say, scene.time))
    return SolvedScene(screening.problem, solution, screening, None)


def _to_tolerance(options: Heat, scene: HeatScene, screening: Screening, say: Say) -> SolvedScene:
    """Give the solver what is left of the tolerance."""
    left_k = None if options.tolerance is None else options.tolerance - screening.bound_k
    found = solve_to_tolerance(
        screening.problem,
        Tolerance(left_k, options.flow_tolerance),
        duration_s=None if scene.time is None else scene.time.duration_s,
        outputs=1 if scene.time is None else scene.time.num_times - 1,
        memory_bytes=options.memory_gb * 2**30,
        allow_unmet=options.allow_unmet,
        log=say,
        progress=_Progress(say, None),
    )
    return SolvedScene(found.problem, found.solution, screening, _of_levels(options, screening, found))


def _of_levels(options: Heat, screening: Screening, found: ToleratedSolution) -> Accuracy:
    last = found.settings
    return Accuracy(
        tolerance_k=options.tolerance,
        flow_tolerance=options.flow_tolerance,
        met=found.met,
        estimated_k=last.error.temperature_k + screening.bound_k,
        estimated_flow=last.error.heat_flow,
        left_out_k=screening.bound_k,
        order=last.order,
        refinements=last.refinements,
        step_tolerance_k=last.step_tolerance_k,
        seconds=found.seconds,
        status=found.status,
        levels=tuple(plain_values(level) for level in found.levels),
    )


def time_error_k(solution: Solution) -> float | None:
    """Give the estimated error of the steps as their controller adds it up, [K]; None if there is none."""
    if isinstance(solution, SteadySolution) or not np.isfinite(solution.time_error_k):
        return None
    return solution.time_error_k


def steps_taken(solution: Solution) -> int:
    """Count the time steps; 0 in a steady state."""
    return solution.steps if isinstance(solution, HeatSolution) else 0


def _say_what_is_built(screening: Screening, say: Say) -> None:
    for entry in screening.left_out:
        say(f"Left out: {entry.effect}, at most {entry.bound_k:.2g} K and {entry.bound_w:.3g} W: {entry.reason}.")
    for entry in screening.kept:
        bound = "" if entry.bound_k is None else f" (up to {_bound(entry.bound_k)})"
        say(f"Built: {entry.effect}{bound}")
    if not screening.kept and not screening.left_out:
        say("Nothing acts on the body: its surface is insulated.")


class _Progress:
    """Says after the first step how long it took, and every now and then how far a solution has come.

    The pace of the first step, which makes the matrices too, is about the slowest of equal steps. Those that are chosen
    by their error begin short, and how many will follow is not known yet; later the pace since the last line counts,
    because that from the start on would tell hours where minutes are left.
    """

    def __init__(self, say: Say, time: TimeSteps | AdaptiveSteps | None) -> None:
        self._say, self._share = say, 0.0
        self._equal = isinstance(time, TimeSteps)
        self._begin_s = self._said_s = self._called_s = clock.perf_counter()
        self._said_share = 0.0

    def __call__(self, share: float, steps: int) -> None:
        """Take the share of the duration that is done, and the number of steps."""
        now_s = clock.perf_counter()
        if share < self._share:  # the next solution has begun
            self._begin_s = self._said_s = self._called_s
            self._said_share = 0.0
        took_s = now_s - self._begin_s
        self._share, self._called_s = share, now_s
        if steps == 1 and share < 1.0:
            self._say_first(share, took_s)
        elif now_s - self._said_s >= SAY_EVERY_S and self._said_share < share < 1.0:
            pace_s = took_s / share if self._equal else (now_s - self._said_s) / (share - self._said_share)
            left_s = pace_s * (1.0 - share)
            self._said_s, self._said_share = now_s, share
            self._say(f"{_percent(share)} of the time after {steps} steps; about {_duration(left_s)} left.")

    def _say_first(self, share: float, took_s: float) -> None:
        left_s = took_s * (1.0 - share) / share
        if self._equal and left_s >= SAY_EVERY_S:
            self._say(f"The first step took {took_s:.1f} s; at that pace about {_duration(left_s)} left.")
        elif not self._equal and took_s >= SAY_FIRST_S:
            self._said_s, self._said_share = self._called_s, share
            self._say(f"The first step took {took_s:.1f} s, for {_percent(share)} of the time.")


def _percent(share: float) -> str:
    """Say a share, also a small one.

    >>> [_percent(share) for share in (0.5, 0.034, 2e-5)]
    ['50%', '3%', '0.002%']
    """
    return f"{share:.0%}" if share >= 0.01 else f"{100.0 * share:.1g}%"


def _duration(seconds: float) -> str:
    """Say a time in the unit that suits it.

    >>> [_duration(seconds) for seconds in (90.0, 1000.0, 20000.0)]
    ['90 s', '17 min', '5.6 h']
    """
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def _bound(bound_k: float) -> str:
    """Say a bound; far above what matters its size says nothing.

    >>> [_bound(bound_k) for bound_k in (0.0341, 99.6, 4000.0)]
    ['0.034 K', '100 K or more', '100 K or more']
    """
    return f"{bound_k:.2g} K" if bound_k < 99.5 else "100 K or more"
