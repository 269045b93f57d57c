"""From step to step: equal ones, or as long as a tolerance allows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.limiter import RangeKeeper, RangeWatch, is_in_range
from thermoxels_ns.fem.problem import AdaptiveSteps, GivenSteps, TimeSteps
from thermoxels_ns.fem.schemes import BACKWARD_EULER, Scheme
from thermoxels_ns.fem.stepper import Step, Stepper
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

STEP_SHARE = 0.1
"""Share of the tolerance that one step may use. Conduction forgets errors, so that those of many steps do not add up
to their sum."""
RANGE_SHARE = 1e-3
"""Share of the tolerance by which a temperature may leave its range: less than that is not worth shorter steps."""
_SAFETY = 0.9
_SHRINK, _GROW = 0.2, 5.0
_KEEP_BELOW = 1.25
"""A step that could be longer by less than this stays as it is, and so do its matrices."""
_SHORTEST = 1e-60
"""Shortest step as a share of the duration; bodies with next to no heat capacity begin with such short ones."""


@dataclass(frozen=True)
class Taken:
    """A step that counts."""

    step: Step
    """Its outcome."""
    step_s: float
    """Its length, [s]."""
    ends_interval: bool
    """Whether temperatures are kept at its end."""
    limited: bool = False
    """Whether couplings with the wrong sign were left out to keep temperatures in range."""
    in_range: bool = True
    """Whether all temperatures are in the range of the start and of the surroundings."""
    failure: str = ""
    """Why the computation ends here; then the step does not count."""


def equal_steps(
    system: HeatSystem, scheme: Scheme, start_k: Vector, time: TimeSteps, tolerance: float
) -> Iterator[Taken]:
    """Take equal steps; those of backward Euler keep temperatures in range, those of other schemes are watched.

    Args:
        system: The equations.
        scheme: The scheme in time.
        start_k: Temperatures at the start, relative to the system's reference, shape (n,), [K].
        time: The steps.
        tolerance: Relative tolerance of the linear solver.

    Yields:
        Every step; the last one may be a failure.
    """
    keeper = RangeKeeper(system, relative_tolerance=tolerance) if scheme is BACKWARD_EULER else None
    stepper, relative_k = Stepper(system, scheme, relative_tolerance=tolerance), start_k
    watch = RangeWatch(system)
    for number, begin_s in enumerate(time.times_s[:-1]):
        limited = False
        if keeper is not None:
            kept = keeper.step(relative_k, float(begin_s), time.step_seconds)
            step, limited, in_range = kept.step, kept.limited, kept.in_range
        else:
            step = stepper.step(relative_k, float(begin_s), time.step_seconds)
            times = tuple(float(begin_s) + node * time.step_seconds for node in (0.0, *scheme.nodes))
            in_range = step.converged and is_in_range(step, *watch.at(relative_k, times))
        failure = ""
        if not step.converged:
            remedy = "Use shorter steps or check the mesh's quality."
            failure = f"Step {number + 1} of {time.steps} failed. {step.status} {remedy}"
        yield Taken(step, time.step_seconds, True, limited, in_range, failure)
        relative_k = step.relative_k


@dataclass(frozen=True)
class _Attempt:
    """A step that may count, if its error is small enough."""

    step: Step
    """Its outcome."""
    error_order: int
    """Power of the step length that its error estimate grows with."""
    made_safe: int = 0
    """1 if it was taken with backward Euler."""
    limited: bool = False
    """Whether couplings were left out."""
    in_range: bool = True
    """Whether all temperatures are in range."""


class AdaptiveMarch:
    """Steps as long as a tolerance allows, by the estimate of an embedded scheme.

    A step whose result leaves the range that temperatures may have, that of its start and of all surroundings, is
    taken with backward Euler and a `RangeKeeper` instead, which never leave it; the difference between both schemes is
    then the estimate. What couplings that are left out change is the mesh's error, not the step's, and no part of it:
    it would ask for ever shorter steps. So nothing overshoots by more than a thousandth of the tolerance or a millionth
    of the range, and second order returns as soon as it is safe. No step is longer than effects can be followed by, so
    that none steps over a day of sunshine.
    """

    def __init__(
        self,
        system: HeatSystem,
        scheme: Scheme,
        start_k: Vector,
        time: AdaptiveSteps | GivenSteps,
        *,
        relative_tolerance: float,
    ) -> None:
        """Prepare.

        Args:
            system: The equations.
            scheme: A scheme with an error estimate.
            start_k: Temperatures at the start, relative to the system's reference, shape (n,), [K].
            time: Duration, tolerance and outputs.
            relative_tolerance: Of the linear solver.
        """
        self.name = scheme.name
        """Name of the scheme."""
        self._system, self._time, self._start_k = system, time, start_k
        self._scheme = Stepper(system, scheme, relative_tolerance=relative_tolerance)
        self._safe = RangeKeeper(system, relative_tolerance=relative_tolerance)
        self._given = time.lengths_s if isinstance(time, GivenSteps) else None
        self._allowed_k = STEP_SHARE * time.tolerance_k if self._given is None else np.inf
        self._slack_k = RANGE_SHARE * time.tolerance_k
        self._range = RangeWatch(system)
        self._longest_s = system.problem.resolution_s
        self.repeated = 0
        """Steps that had to be repeated with a shorter length."""
        self.made_safe = 0
        """Steps taken with backward Euler."""

    def steps(self) -> Iterator[Taken]:
        """Take steps to the end.

        Yields:
            Every step that counts; the last one may be a failure.
        """
        if self._given is not None:
            yield from self._given_steps(self._given)
            return
        relative_k, now_s, wished_s = self._start_k, 0.0, self._first_length()
        for end_s in self._time.times_s[1:]:
            while now_s < end_s:
                left_s = float(end_s) - now_s
                step_s = _fitted(min(wished_s, self._longest_s), left_s)
                attempt = self._try(relative_k, now_s, step_s)
                factor = self._factor(attempt)
                if not attempt.step.converged or attempt.step.error_k > self._allowed_k:
                    self.repeated += 1
                    wished_s = step_s * min(factor, _SAFETY)
                    if wished_s < _SHORTEST * self._time.duration_s or now_s + 0.25 * wished_s == now_s:
                        yield Taken(attempt.step, step_s, False, failure=self._failure(attempt.step, now_s))
                        return
                    continue
                self.made_safe += attempt.made_safe
                now_s = float(end_s) if step_s == left_s else now_s + step_s
                relative_k = attempt.step.relative_k
                next_s = step_s * (factor if factor > _KEEP_BELOW else min(factor, 1.0))
                # A step cut short by an interval's end says nothing against the length wished for.
                wished_s = max(next_s, wished_s) if step_s < wished_s and factor >= 1.0 else next_s
                yield Taken(attempt.step, step_s, now_s == end_s, attempt.limited, attempt.in_range)

    def _given_steps(self, lengths_s: tuple[Vector, ...]) -> Iterator[Taken]:
        relative_k, now_s = self._start_k, 0.0
        for end_s, interval_s in zip(self._time.times_s[1:].tolist(), lengths_s):
            for number, step_s in enumerate(interval_s.tolist(), start=1):
                attempt, ends = self._try(relative_k, now_s, step_s), number == len(interval_s)
                self.made_safe += attempt.made_safe
                failure = "" if attempt.step.converged else f"At {now_s:.6g} s a step failed. {attempt.step.status}"
                yield Taken(attempt.step, step_s, ends, attempt.limited, attempt.in_range, failure)
                relative_k, now_s = attempt.step.relative_k, end_s if ends else now_s + step_s

    def _first_length(self) -> float:
        system, time = self._system, self._time
        rate = system.net_heat(self._start_k, 0.0)[0] / system.nodal_mass_j_k
        fastest = float(np.max(np.abs(rate[system.fixed.free]), initial=0.0))
        interval_s = time.duration_s / (time.num_times - 1)
        if fastest == 0.0:
            return interval_s
        return float(np.clip(time.tolerance_k / fastest, _SHORTEST * time.duration_s, interval_s))

    def _try(self, start_k: Vector, now_s: float, step_s: float) -> _Attempt:
        step = self._scheme.step(start_k, now_s, step_s, estimate=self._given is None)
        plain = _Attempt(step, self._scheme.scheme.order + 1)
        if not step.converged or step.error_k > self._allowed_k or self._in_range(step, start_k, now_s, step_s):
            return plain
        kept = self._safe.step(start_k, now_s, step_s, self._slack_k)
        if not kept.in_range:
            return replace(plain, in_range=False)
        safe = replace(
            kept.step,
            error_k=float(np.max(np.abs(kept.plain_k - step.relative_k))),
            iterations=kept.step.iterations + step.iterations,
            newton_iterations=kept.step.newton_iterations + step.newton_iterations,
        )
        return _Attempt(safe, BACKWARD_EULER.order + 1, made_safe=1, limited=kept.limited)

    def _in_range(self, step: Step, start_k: Vector, now_s: float, step_s: float) -> bool:
        times = (now_s, *(now_s + node * step_s for node in self._scheme.scheme.nodes))
        return is_in_range(step, *self._range.at(start_k, times, self._slack_k))

    def _factor(self, attempt: _Attempt) -> float:
        """How much longer the next step may be."""
        step = attempt.step
        if not step.converged or not np.isfinite(step.error_k):
            return _SHRINK
        if step.error_k == 0.0:
            return _GROW
        return float(np.clip(_SAFETY * (self._allowed_k / step.error_k) ** (1.0 / attempt.error_order), _SHRINK, _GROW))

    def _failure(self, step: Step, now_s: float) -> str:
        if not step.converged:
            return f"At {now_s:.6g} s no step however short succeeds. {step.status} Check the mesh's quality."
        return (
            f"At {now_s:.6g} s no step however short keeps within {self._time.tolerance_k:g} K. Something jumps in "
            "time: end an interval there, or raise the tolerance."
        )


def _fitted(wished_s: float, left_s: float) -> float:
    """Fit a step into what is left of an interval: two even steps to its end rather than a long and a tiny one.

    >>> [_fitted(wished, 10.0) for wished in (12.0, 8.0, 3.0)]
    [10.0, 5.0, 3.0]
    """
    if wished_s >= left_s:
        return left_s
    return min(wished_s, 0.5 * left_s)
