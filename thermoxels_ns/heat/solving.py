"""Solve a problem with its own steps on its mesh, or to a tolerance."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.memory import DEFAULT_MEMORY_BYTES, check_memory, describe_bytes, peak_bytes
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Bounds
from thermoxels_ns.fem.solution import Solution, mean_flows_w
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.fem.tolerance import Tolerance, ToleratedSolution, solve_to_tolerance
from thermoxels_ns.heat.screening import Screening, screen

Say = Callable[[str], None]
Time = TimeSteps | AdaptiveSteps | None  # How a body is followed; None: its steady state

LEFT_OUT_SHARE = 0.2
"""Share of the tolerance that effects which are left out may use together; the solver gets what they do not use."""
LEAVE_OUT_BELOW_K = 0.01  # The same without a tolerance, [K]: a fifth of the default tolerance of the time steps
LEFT_OUT_FLOW = 0.01
"""Share of all heat that flows by which what is left out may change the mean heat flow of any effect (ISO 10211)."""
SAY_EVERY_S = 10.0  # Time between two lines of progress, [s]
SAY_FIRST_S = 1.0  # Time of a first step from which on it is said, [s]: then the next ones will take some, too

_BOUNDS = {
    "tolerance_k": Bounds("tolerance", "K", 0.0, above_low=True, remedy="Pass --tolerance 0.05."),
    "flow_tolerance": Bounds(
        "flow-tolerance", "share of the heat flow", 0.0, 1.0, above_low=True, remedy="Pass --flow-tolerance 0.01."
    ),
    "leave_out_below_k": Bounds("leave-out-below-k", "K", 0.0, remedy="Pass --leave-out-below-k 0.01."),
    "memory_gb": Bounds("memory-gb", "GiB", 0.0, above_low=True, remedy="Pass --memory-gb 4."),
}


@dataclass(frozen=True)
class Goals:
    """How exact a solution must be, and what it may take; raises `HeatError` if a number is out of range."""

    tolerance_k: float | None = None  # Largest error of any temperature, [K]; None: any
    flow_tolerance: float | None = None
    """Largest error of the mean heat flow of any effect, as a share of all heat; None: any."""
    leave_out_below_k: float | None = None
    """Effects that together can change no temperature by more than this are left out, [K]; None: `left_out_k`, and no
    mean heat flow of an effect by more than a hundredth of all heat that flows."""
    memory_gb: float | None = 4.0  # Most memory that solving may take, [GiB]; None: any
    allow_unmet: bool = False  # Whether the best that fits into the memory will do if a tolerance cannot be met

    def __post_init__(self) -> None:
        for name, bounds in _BOUNDS.items():
            if getattr(self, name) is not None:
                bounds.check(getattr(self, name))
        if self.tolerance_k is not None and self.left_out_k >= self.tolerance_k:
            expected = f"less than the tolerance of {self.tolerance_k:g} K"
            remedy = "Leave it out for a fifth of the tolerance."
            raise HeatError("leave-out-below-k", expected=expected, got=f"{self.left_out_k:g} K", remedy=remedy)

    @property
    def estimated(self) -> bool:
        """Whether the error has to be known."""
        return self.tolerance_k is not None or self.flow_tolerance is not None

    @property
    def left_out_k(self) -> float:
        """What effects that are left out may change together, [K]."""
        if self.leave_out_below_k is not None:
            return self.leave_out_below_k
        if self.flow_tolerance is not None:
            return 0.0
        return LEAVE_OUT_BELOW_K if self.tolerance_k is None else LEFT_OUT_SHARE * self.tolerance_k

    @property
    def left_out_w(self) -> float:
        """Heat that they may bring, [W]: none beside a tolerance of heat flows, otherwise as it turns out."""
        return np.inf if self.flow_tolerance is None else 0.0

    def check_fits(self, time: Time) -> None:
        """Raise `HeatError` for a tolerance of heat flows alone beside a duration: it does not choose the steps."""
        if time is not None and self.flow_tolerance is not None and self.tolerance_k is None:
            expected = "--tolerance beside it if the scene has a duration"
            remedy = "Pass --tolerance too: steps in time are chosen by it."
            raise HeatError("flow-tolerance", expected=expected, got="none", remedy=remedy)


@dataclass(frozen=True)
class Accuracy:
    """What is known of the error, and how the tolerance was met."""

    tolerance_k: float | None  # Error of any temperature that was allowed, [K]; None: any
    flow_tolerance: float | None
    """Error of the mean heat flow of any effect that was allowed, as a share of all heat; None: any."""
    met: bool
    estimated_k: float  # Estimated largest error of a temperature, what is left out included, [K]
    estimated_flow: float  # Estimated largest error of a heat flow as a share of all heat
    left_out_k: float  # What of `estimated_k` is the bound of the effects that are left out, [K]
    order: int  # 1 for linear tetrahedra, 2 for quadratic ones
    refinements: int  # How often the size of the given mesh was halved
    step_tolerance_k: float | None  # Tolerance of the time steps, [K]; None without steps
    seconds: float
    status: str
    levels: tuple[dict[str, Any], ...]
    """All solutions on the way with their estimates and seconds, the one that counts last."""


@dataclass(frozen=True)
class SolvedProblem:
    """A solution, what it is one of, and what is known of its error (None without a tolerance)."""

    problem: HeatProblem
    """What was solved last: without what is left out, and perhaps on a finer mesh than the given one."""
    solution: Solution
    screening: Screening
    accuracy: Accuracy | None


def solve_problem(problem: HeatProblem, time: Time, goals: Goals, say: Say = lambda _: None) -> SolvedProblem:
    """Leave out what does not matter, and solve the rest; `say` gets one line of progress at a time.

    Raises `HeatError` if it needs more memory than allowed, the solver fails, or the tolerance cannot be met.
    """
    goals.check_fits(time)
    if time is not None:
        allowed = DEFAULT_MEMORY_BYTES if goals.memory_gb is None else goals.memory_gb * 2**30
        remedy = "Keep temperatures at fewer times: fewer steps or outputs; or pass a larger --memory-gb."
        check_memory(8.0 * time.num_times * len(problem.mesh.points_m), allowed, remedy)
    # To a tolerance steps are chosen by their error, whatever the scene says.
    asked = AdaptiveSteps(time.duration_s) if goals.estimated and time is not None else time
    found = _solve_screened(screen(problem, asked, goals.left_out_k, goals.left_out_w), time, goals, say)
    through_w = 0.5 * sum(map(abs, mean_flows_w(found.solution).values()))
    if goals.leave_out_below_k is None and found.screening.bound_w > LEFT_OUT_FLOW * through_w:
        say(
            f"What is left out may bring {found.screening.bound_w:.3g} W beside {through_w:.3g} W that flow, more "
            f"than {LEFT_OUT_FLOW:.0%}: solved again with it (not if you pass --leave-out-below-k 0.01)."
        )
        again = screen(problem, asked, goals.left_out_k, LEFT_OUT_FLOW * through_w)
        found = _solve_screened(again, time, goals, say)
    return found


def _solve_screened(screening: Screening, time: Time, goals: Goals, say: Say) -> SolvedProblem:
    _say_what_is_built(screening, say)
    kept, memory_bytes = screening.problem, np.inf if goals.memory_gb is None else goals.memory_gb * 2**30
    if goals.estimated:
        left_k = None if goals.tolerance_k is None else goals.tolerance_k - screening.bound_k
        found = solve_to_tolerance(
            kept,
            Tolerance(left_k, goals.flow_tolerance),
            duration_s=None if time is None else time.duration_s,
            outputs=1 if time is None else time.num_times - 1,
            memory_bytes=memory_bytes,
            allow_unmet=goals.allow_unmet,
            log=say,
            progress=_Progress(say),
        )
        return SolvedProblem(found.problem, found.solution, screening, _accuracy(goals, screening, found))
    times = 1 if time is None else time.num_times
    needed = peak_bytes(kept, times=times, adaptive=time is not None)
    say(f"Memory: about {describe_bytes(needed)} at most.")
    check_memory(needed, memory_bytes, "Pass a larger --memory-gb, or export a coarser mesh.")
    solution = (
        solve_steady(kept) if time is None else solve_heat(kept, time, estimate_steps=True, progress=_Progress(say))
    )
    return SolvedProblem(kept, solution, screening, None)


def _accuracy(goals: Goals, screening: Screening, found: ToleratedSolution) -> Accuracy:
    last = found.settings
    return Accuracy(
        tolerance_k=goals.tolerance_k,
        flow_tolerance=goals.flow_tolerance,
        met=found.met,
        estimated_k=last.error.temperature_k + screening.bound_k,
        estimated_flow=last.error.heat_flow,
        left_out_k=screening.bound_k,
        order=last.order,
        refinements=last.refinements,
        step_tolerance_k=last.step_tolerance_k,
        seconds=found.seconds,
        status=found.status,
        levels=tuple(asdict(level) for level in found.levels),
    )


def _say_what_is_built(screening: Screening, say: Say) -> None:
    for entry in screening.left_out:
        say(f"Left out: {entry.effect}, at most {entry.bound_k:.2g} K and {entry.bound_w:.3g} W: {entry.reason}.")
    for entry in screening.kept:
        bound = "" if entry.bound_k is None else f" (up to {_bound(entry.bound_k)})"
        say(f"Built: {entry.effect}{bound}")
    if not screening.kept and not screening.left_out:
        say("Nothing acts on the body: its surface is insulated.")


class _Progress:
    """Says how long a slow first step took, and every now and then how far a solution has come.

    What is left is told by the pace since the last line: steps that are chosen by their error begin short.
    """

    def __init__(self, say: Say) -> None:
        self._say = say
        self._share = self._said_share = 0.0
        self._called_s = self._said_s = clock.perf_counter()

    def __call__(self, share: float, steps: int) -> None:
        """Take the share of the duration that is done, and the number of steps."""
        if share < self._share:  # the next solution has begun
            self._said_share, self._said_s = 0.0, self._called_s
        self._share, self._called_s = share, clock.perf_counter()
        took_s = self._called_s - self._said_s
        if share >= 1.0 or share <= self._said_share:
            return
        if steps == 1 and took_s >= SAY_FIRST_S:
            self._say(f"The first step took {took_s:.1f} s, for {_percent(share)} of the time.")
        elif steps > 1 and took_s >= SAY_EVERY_S:
            left_s = took_s / (share - self._said_share) * (1.0 - share)
            self._say(f"{_percent(share)} of the time after {steps} steps; about {_duration(left_s)} left.")
        else:
            return
        self._said_share, self._said_s = share, self._called_s


def _percent(share: float) -> str:
    """Say a share, also a small one."""
    return f"{share:.0%}" if share >= 0.01 else f"{100.0 * share:.1g}%"


def _duration(seconds: float) -> str:
    """Say a time in the unit that suits it."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def _bound(bound_k: float) -> str:
    """Say a bound; far above what matters its size says nothing."""
    return f"{bound_k:.2g} K" if bound_k < 99.5 else "100 K or more"
