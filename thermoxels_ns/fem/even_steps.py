"""Steps of a body whose equations are linear with constant coefficients, equal from output to output.

Stages of all steps of one length share a matrix, and where lengths are halved there are few of them. What
`AdaptiveMarch` does to be ready for anything, such as Newton's method and safe steps, is left out: what came of the
steps is checked instead, and whoever asks takes adaptive steps where it does not hold.

The error of the steps is followed, too. Each step adds what the embedded scheme says, as a vector, and takes what was
there before along as it does any temperature, so that conduction forgets it. Measured on rods with a swinging end:
0.7 to 1.7 times the true error at each output, with its sign (cosine of the angle between both 0.9 or more).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.effect_forms import effect_labels
from thermoxels_ns.fem.limiter import RangeWatch
from thermoxels_ns.fem.marching import RANGE_SHARE
from thermoxels_ns.fem.matrix_parts import product_of_rows
from thermoxels_ns.fem.problem import AdaptiveSteps
from thermoxels_ns.fem.schemes import SDIRK2
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.stage import Stage
from thermoxels_ns.fem.steady import is_too_cold
from thermoxels_ns.fem.step_account import StepAccount
from thermoxels_ns.fem.stepping import skips
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

_LINEAR_TOLERANCE = 1e-10
"""Of the linear solver: its error is far below any estimate here."""
_UNBALANCED = 1e-9
"""Share of the heat that moved that may be unaccounted for."""
_IMPLICIT = SDIRK2.weights[0][0]
"""Length of a stage as a share of the step; both stages have the same."""
_EARLIER = SDIRK2.weights[1][0] / _IMPLICIT
"""Share of the heat flow of the first stage in the second one, in units of a stage."""
_MORE = tuple((more - end) / _IMPLICIT for more, end in zip(SDIRK2.estimate or (), (0.0, *SDIRK2.ends), strict=True))
"""Weights in the error of the heat flows at the start and of the stages, in units of a stage."""
_OF_LOADS = (1.0 / 3.0 - sum(more * node**2 for more, node in zip((SDIRK2.estimate or ())[1:], SDIRK2.nodes))) / (
    (SDIRK2.nodes[0] ** 2 - SDIRK2.nodes[0]) * _IMPLICIT
)
"""Weight in the error of what the load of the first stage is above that at the start; that of the second one has
minus `SDIRK2.nodes[0]` times it. With them the embedded scheme is of third order for loads that change in time, too:
its weights then meet sum b c^2 = 1 / 3 for them."""
_LOADS = (_OF_LOADS, -SDIRK2.nodes[0] * _OF_LOADS)
_EASY = 0.2
"""Share of the allowed error below which the next interval is tried with half as many steps, which err four times as
much."""
_MOST_STEPS = 64
"""Steps in an interval beyond which adaptive ones are better."""
_MOST_IN_RANGE = 16
"""The same where only the range asks for shorter steps."""


@dataclass
class _Leap:
    """One step."""

    begin_s: float
    """Time at its start."""
    length_s: float
    """Its length, [s]."""
    times_s: tuple[float, float]
    """Times of its stages, [s]."""
    states: tuple[Vector, Vector, Vector]
    """Temperatures at the start and after each stage."""
    stage: Stage
    """What both stages were solved with."""
    lacking_w: Vector
    """What the embedded scheme adds to the heat flow into each node, in units of a stage, shape (n,), [W]."""
    lacking_in_pieces_w: Vector
    """Its sum over each piece that floats, shape (p,), [W]."""
    iterations: int
    """Iterations of the linear solver."""
    error_k: Vector | None = None
    """Minus the error of all steps so far, shape (n,), [K]; None: not looked at yet."""
    ends_interval: bool = False
    """Whether temperatures are kept at its end."""


def _ends(relative_k: Vector) -> tuple[float, float]:
    """The smallest and the largest."""
    return float(relative_k.min()), float(relative_k.max())


class EvenSteps:
    """Steps of SDIRK2. Temperatures come first; heat flows and checks are left to `solution`."""

    def __init__(
        self,
        system: HeatSystem,
        time: AdaptiveSteps,
        allowed_k: float,
        starts_well: Callable[[Vector, float], bool] | None = None,
        first_count: int = 1,
        progress: Callable[[float, int], None] | None = None,
    ) -> None:
        """Find the temperatures.

        Args:
            system: The equations, of linear tetrahedra with lumped masses.
            time: Duration and outputs. Its tolerance tells how far temperatures may leave their range.
            allowed_k: Error that the steps may make, [K]; an interval that makes more is taken again with twice as many
                steps.
            starts_well: Says from the temperatures after the first interval, [degrees Celsius], and from the error made
                there, [K], whether that is allowed, instead of `allowed_k`; later intervals are not looked at then.
            first_count: Steps of the first interval to begin with.
            progress: As in `solve_heat`.
        """
        self._system, self._time, self._allowed_k = system, time, allowed_k
        self._starts_well, self._progress = starts_well, progress
        self._times_s: list[float] = time.times_s.tolist()
        self._exchange = system.exchange_matrix(0.0)
        self._last_load: tuple[float, Vector] | None = None
        self._no_pieces = np.zeros(system.pieces.count)
        self._stages: dict[int, Stage] = {}
        self._leaps: list[_Leap] = []
        suits = not (system.nonlinear or system.matrix_in_time)
        self.found: bool = suits and self._march(0, first_count)
        """Whether there are temperatures. There are none where coefficients change or radiation acts, effects change
        faster than can be followed, or the solver or the error of the steps does not converge."""

    @property
    def temperature_c(self) -> Vector:
        """Temperatures at the outputs, the start first, shape (s + 1, n), [degrees Celsius]."""
        kept = [self._leaps[0].states[0], *(leap.states[2] for leap in self._leaps if leap.ends_interval)]
        return np.stack(kept) + self._system.reference_c

    @property
    def start_error_k(self) -> float:
        """Largest error that the steps of the first interval made, [K]."""
        error_k = next(leap.error_k for leap in self._leaps if leap.ends_interval)
        return 0.0 if error_k is None else float(np.max(np.abs(error_k)))

    def errors_k(self) -> Vector:
        """Estimates of minus the error of the steps at the outputs, shape (s + 1, n), [K]."""
        error_k = np.zeros(self._system.num_nodes)
        kept = [error_k]
        for leap in self._leaps:
            if leap.error_k is None:
                leap.error_k = self._followed(leap, error_k)
            error_k = leap.error_k
            if leap.ends_interval:
                kept.append(error_k)
        return np.stack(kept)

    def solution(self) -> HeatSolution | None:
        """Complete the account of the heat; None if temperatures leave their range or the heat does not balance."""
        system, time = self._system, self._time
        if not self._stays_in_range():
            return None
        states = np.empty((time.num_times, system.num_nodes))
        states[0] = self._leaps[0].states[0]
        ends = [number for number, leap in enumerate(self._leaps) if leap.ends_interval]
        for row, number in enumerate(ends, start=1):
            states[row] = self._leaps[number].states[2]
        account = StepAccount(system, states, time.times_s)
        intervals = np.searchsorted(ends, np.arange(len(self._leaps)))
        account.add_all(intervals, self._lengths_s, self._heat_w, [leap.iterations for leap in self._leaps])
        solution = account.close(account.success(None) + skips(system.problem, time), True, adaptive=True)
        if solution.energy_residual_of_spread > _UNBALANCED:
            return None
        return replace(solution, time_error_k=float(np.max(np.abs(self.errors_k()))))

    def mean_flows_w(self) -> dict[str, float]:
        """Mean heat flow into the body of each effect over all times, [W], as `error_budget.mean_flows_w`."""
        mean_w = self._lengths_s @ self._heat_w / self._time.duration_s
        flows = dict.fromkeys(effect_labels(self._system.problem), 0.0)
        for (effect, _), heat_w in zip(self._system.groups, mean_w.tolist()):
            flows[effect] += heat_w
        return flows

    @cached_property
    def _lengths_s(self) -> Vector:
        """Length of each step, shape (l,), [s]."""
        return np.array([leap.length_s for leap in self._leaps])

    def _stays_in_range(self) -> bool:
        """Whether no temperature leaves the range of those before the step and of the surroundings.

        Where one does, by an error that is allowed or in the middle of an interval, as air that turns makes one that
        follows it do, the interval is taken again with more steps, and so is what comes after.
        """
        watch, ends_k, first = RangeWatch(self._system), _ends(self._leaps[0].states[0]), 0
        for number in range(len(self._times_s) - 1):
            last = next(k for k in range(first, len(self._leaps)) if self._leaps[k].ends_interval)
            earlier, end_k = copy(watch), self._watched(watch, self._leaps[first : last + 1], ends_k)
            if end_k is None:
                self.errors_k()
                count = last + 1 - first
                del self._leaps[first:]
                if not self._march(number, 2 * count, earlier):
                    return False
                break
            ends_k, first = end_k, last + 1
        return not is_too_cold(self._system, min(float(leap.states[2].min()) for leap in self._leaps))

    def _watched(
        self, watch: RangeWatch, leaps: list[_Leap], ends_k: tuple[float, float]
    ) -> tuple[float, float] | None:
        """Coldest and warmest temperature after some steps, from those before, [K]; None if one has left its range."""
        slack_k = RANGE_SHARE * self._time.tolerance_k
        for leap in leaps:
            low, high = watch.after(*ends_k, (leap.begin_s, *leap.times_s), slack_k)
            ends_k = _ends(leap.states[2])
            if not (low <= ends_k[0] and ends_k[1] <= high):
                return None
        return ends_k

    def _march(self, first: int, count: int, watch: RangeWatch | None = None) -> bool:
        """Take steps from an interval on; with a watch, as many in each as keep temperatures in range, within limits.

        Args:
            first: Number of the interval.
            count: Steps in it to begin with.
            watch: The range of what came before.
        """
        times_s, fixed, most = self._times_s, self._system.fixed, _MOST_STEPS if watch is None else _MOST_IN_RANGE
        if self._leaps:
            state_k, error_k = self._leaps[-1].states[2], self._leaps[-1].error_k
        else:
            state_k, error_k = self._system.start_k, None
            if len(fixed.nodes):
                state_k[fixed.nodes] = fixed.temperature_k(0.0)
        error_k = np.zeros(self._system.num_nodes) if error_k is None else error_k
        size_k = 0.0
        for begin_s in times_s[first:-1]:
            while True:
                if count > most:
                    return False
                if times_s[1] / count > self._system.problem.resolution_s:
                    count *= 2
                    continue
                leaps = self._interval(state_k, begin_s, count)
                if leaps is None:
                    return False
                looked_at = watch is None and self._starts_well is not None and bool(self._leaps)
                if looked_at:
                    break
                end_k = error_k
                for leap in leaps:
                    leap.error_k = end_k = self._followed(leap, end_k)
                size_k = float(np.max(np.abs(end_k)))
                tried = None if watch is None else copy(watch)
                in_range = tried is None or self._watched(tried, leaps, _ends(state_k)) is not None
                if in_range and self._is_allowed(leaps[-1].states[2], size_k):
                    error_k, watch = end_k, tried
                    break
                count *= 2
            leaps[-1].ends_interval = True
            self._leaps += leaps
            state_k = leaps[-1].states[2]
            if self._progress is not None:
                self._progress(min((begin_s + times_s[1]) / self._time.duration_s, 1.0), len(self._leaps))
            if size_k <= _EASY * self._allowed_k:
                count = max(count // 2, 1)
        return True

    def _is_allowed(self, relative_k: Vector, size_k: float) -> bool:
        if self._starts_well is None or self._leaps:
            return size_k <= self._allowed_k
        return self._starts_well(relative_k + self._system.reference_c, size_k)

    def _interval(self, state_k: Vector, begin_s: float, count: int) -> list[_Leap] | None:
        """Take some steps to the next output; None if the solver does not converge."""
        length_s = self._times_s[1] / count
        stage = self._stages.get(count)
        if stage is None:
            stage = Stage(self._system, 0.0, _IMPLICIT * length_s, relative_tolerance=_LINEAR_TOLERANCE)
            self._stages[count] = stage
        leaps: list[_Leap] = []
        for number in range(count):
            leap = self._leap(stage, state_k, begin_s + number * length_s, length_s)
            if leap is None:
                return None
            leaps.append(leap)
            state_k = leap.states[2]
        return leaps

    def _leap(self, stage: Stage, begin_k: Vector, begin_s: float, length_s: float) -> _Leap | None:
        """Take a step; what is balanced is as in `Stage`."""
        system, fixed, iterations = self._system, self._system.fixed, 0
        times_s = begin_s + SDIRK2.nodes[0] * length_s, begin_s + SDIRK2.nodes[1] * length_s
        moved_k = [fixed.temperature_k(now_s) - begin_k[fixed.nodes] for now_s in times_s]
        conducted_w, lost_w, left_w = self._lost(begin_k, moved_k)
        mass_w_k, first_w = system.nodal_mass_j_k / stage.step_s, self._loaded(begin_s) - lost_w
        net_w, to_pieces_w = first_w - conducted_w, self._sums(stage, first_w)
        lacking_w, lacking_in_pieces_w = _MORE[0] * net_w, _MORE[0] * to_pieces_w
        given_w, given_to_pieces_w, states = 0.0, 0.0, [begin_k]
        for number, (now_s, more, of_load) in enumerate(zip(times_s, _MORE[1:], _LOADS)):
            exchanged_w = self._loaded(now_s) - lost_w
            heat_w = exchanged_w - conducted_w
            if left_w is not None:
                heat_w -= left_w[:, number]
            lacking_w += of_load * (heat_w - net_w)
            heat_w += given_w
            found_k, linear = stage.balance(heat_w, self._sums(stage, exchanged_w) + given_to_pieces_w)
            if not linear.converged:
                return None
            iterations += linear.iterations
            if len(fixed.nodes):
                found_k[fixed.nodes] = moved_k[number]
            states.append(begin_k + found_k)
            flow_w = mass_w_k * found_k - given_w
            lacking_w += more * flow_w
            given_w = _EARLIER * flow_w
            if stage.floats:
                more_to_pieces_w = of_load * (self._sums(stage, exchanged_w) - to_pieces_w)
                lacking_in_pieces_w = lacking_in_pieces_w + more_to_pieces_w
                flow_to_pieces_w = self._sums(stage, self._exchanged(states[-1], now_s))
                lacking_in_pieces_w = lacking_in_pieces_w + more * flow_to_pieces_w
                given_to_pieces_w = _EARLIER * flow_to_pieces_w
        after = states[0], states[1], states[2]
        return _Leap(begin_s, length_s, times_s, after, stage, lacking_w, lacking_in_pieces_w, iterations)

    def _followed(self, leap: _Leap, error_k: Vector) -> Vector:
        """What a step leaves of an error, and its own, which both stages damp as they do what they solve.

        Damped by one stage only, the error that a swinging temperature makes beside it is told three times too large.
        """
        stage, lacking_w, sums_w = leap.stage, leap.lacking_w, leap.lacking_in_pieces_w
        mass_w_k = self._system.nodal_mass_j_k / stage.step_s
        left_w = np.zeros_like(error_k)
        if error_k.any():
            before_w = mass_w_k * error_k
            lacking_w, left_w = lacking_w + _EARLIER * before_w, (1.0 - _EARLIER) * before_w
            sums_w = sums_w + self._sums(stage, _EARLIER * before_w)
        left_w = left_w + mass_w_k * stage.damped(lacking_w, sums_w, error_k, 0.0)
        return stage.damped(left_w, self._sums(stage, left_w), error_k, 0.0)

    @cached_property
    def _heat_w(self) -> Vector:
        """Mean heat flow of each group during each step, as in `Stepper`, shape (l, g)."""
        system, fixed = self._system, self._system.fixed
        heat_w = np.zeros((len(self._leaps), len(system.groups)))
        given, nodes = len(system.groups) - len(fixed.groups), fixed.nodes
        kept_w = np.zeros((len(nodes), len(self._leaps)))
        if len(nodes):
            mass_j_k = system.nodal_mass_j_k[nodes]
            for column, leap in enumerate(self._leaps):
                kept_w[:, column] += mass_j_k * (leap.states[2][nodes] - leap.states[0][nodes]) / leap.length_s
                for end, relative_k in zip(SDIRK2.ends, leap.states[1:]):
                    kept_w[:, column] += end * product_of_rows(system.stiffness, nodes, relative_k)
        if system.exchanges:
            for row, leap in enumerate(self._leaps):
                for end, node, relative_k in zip(SDIRK2.ends, SDIRK2.nodes, leap.states[1:]):
                    now_s = leap.begin_s + node * leap.length_s
                    heat_w[row, :given] += end * system.group_heat_w(relative_k, now_s)
                    if len(nodes):
                        kept_w[:, row] -= end * self._exchanged(relative_k, now_s)[nodes]
        if len(nodes):
            heat_w[:, given:] = (fixed.shares @ kept_w).T
        return heat_w

    def _lost(self, begin_k: Vector, moved_k: list[Vector]) -> tuple[Vector, Vector | float, Vector | None]:
        """Heat that a step's start conducts away from each node, and that it loses to what is around the body, [W].

        Last comes what nodes lose more in each stage as given temperatures move, shape (n, 2), None if they do not: all
        products with a matrix are taken together, which reads it once.
        """
        stiffness, exchange = self._system.stiffness, self._exchange
        if not any(part_k.any() for part_k in moved_k):
            return stiffness @ begin_k, 0.0 if exchange is None else exchange @ begin_k, None
        together_k = np.zeros((len(begin_k), 1 + len(moved_k)))
        together_k[:, 0] = begin_k
        together_k[self._system.fixed.nodes, 1:] = np.stack(moved_k, axis=1)
        conducted_w: Vector = stiffness @ together_k
        if exchange is None:
            return conducted_w[:, 0], 0.0, conducted_w[:, 1:]
        lost_w: Vector = exchange @ together_k
        return conducted_w[:, 0], lost_w[:, 0], np.add(conducted_w[:, 1:], lost_w[:, 1:], dtype=np.float64)

    def _loaded(self, time_s: float) -> Vector:
        """Heat from outside that does not depend on the temperature, shape (n,), [W]; the last one is kept."""
        if self._last_load is None or (self._last_load[0] != time_s and self._system.exchanges):
            self._last_load = time_s, self._system.load(time_s)
        return self._last_load[1]

    def _exchanged(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat from outside the body, shape (n,), [W]."""
        load_w = self._loaded(time_s)
        return load_w if self._exchange is None else load_w - self._exchange @ relative_k

    def _sums(self, stage: Stage, heat_w: Vector) -> Vector:
        """Sums over the pieces that float, shape (p,)."""
        return np.where(stage.floating, self._system.pieces.sums(heat_w), 0.0) if stage.floats else self._no_pieces
