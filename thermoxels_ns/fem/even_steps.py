"""Steps of a body whose equations are linear with constant coefficients, equal from output to output.

Stages of all steps of one length share a matrix, and where lengths are halved there are few of them. What
`AdaptiveMarch` does to be ready for anything, such as Newton's method and safe steps, is left out: what came of the
steps is checked instead, and whoever asks takes adaptive steps where it does not hold.

The error of the steps is followed, too. Each step adds what the embedded scheme says, as a vector, and takes what was
there before along as it does any temperature, so that conduction forgets it. Measured on rods with a swinging end,
slabs in wind, a suddenly heated rod and a cube, with 0.06 to 1 K allowed: 0.98 to 3.7 times the true error, 7 times
where two steps leap over a sudden start in wind that swings. Its sign is not to be trusted where loads change in time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.marching import RANGE_SHARE, Taken
from thermoxels_ns.fem.problem import AdaptiveSteps
from thermoxels_ns.fem.range_keeper import RangeWatch, is_in_range
from thermoxels_ns.fem.schemes import SDIRK2
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.stage import Stage
from thermoxels_ns.fem.steady import too_cold
from thermoxels_ns.fem.step_account import StepAccount
from thermoxels_ns.fem.stepper import Step
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
_EASY = 0.25
"""Share of the allowed error below which the next interval is tried with half as many steps."""
_MOST_STEPS = 64
"""Steps in an interval beyond which adaptive ones are better."""


@dataclass
class _Leap:
    """One step."""

    begin_s: float
    """Time at its start."""
    length_s: float
    """Its length, [s]."""
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


class EvenSteps:
    """Steps of SDIRK2. Temperatures come first; heat flows and checks are left to `solution`."""

    def __init__(
        self,
        system: HeatSystem,
        time: AdaptiveSteps,
        allowed_k: float,
        only_at_start: bool = False,
        first_count: int = 1,
        progress: Callable[[float, int], None] | None = None,
    ) -> None:
        """Find the temperatures.

        Args:
            system: The equations, of linear tetrahedra with lumped masses.
            time: Duration and outputs. Its tolerance tells how far temperatures may leave their range.
            allowed_k: Error that the steps may make, [K]; an interval that makes more is taken again with twice as many
                steps.
            only_at_start: Look at the error in the first interval only, where a sudden start shows.
            first_count: Steps of the first interval to begin with.
            progress: As in `solve_heat`.
        """
        self._system, self._time, self._allowed_k = system, time, allowed_k
        self._only_at_start, self._progress = only_at_start, progress
        self._first_count = first_count
        self._exchange = system.exchange_matrix(0.0)
        self._no_pieces = np.zeros(system.pieces.count)
        self._stages: dict[int, Stage] = {}
        self._leaps: list[_Leap] = []
        suits = not (system.nonlinear or system.matrix_in_time)
        self.found: bool = suits and self._march()
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
        states = np.empty((time.num_times, system.num_nodes))
        states[0] = self._leaps[0].states[0]
        account, watch, slack_k = (
            StepAccount(system, states, time.times_s),
            RangeWatch(system),
            RANGE_SHARE * time.tolerance_k,
        )
        for leap in self._leaps:
            times = (leap.begin_s, *(leap.begin_s + node * leap.length_s for node in SDIRK2.nodes))
            step = Step(leap.states[2], self._heat_w(leap), leap.iterations, 0, 0.0, True, "The step converged.")
            if too_cold(system, leap.states[2]) or not is_in_range(step, *watch.at(leap.states[0], times, slack_k)):
                return None
            account.add(Taken(step, leap.length_s, leap.ends_interval))
        solution = account.close(account.success(None), True, adaptive=True)
        if solution.energy_residual_of_spread > _UNBALANCED:
            return None
        return replace(solution, time_error_k=float(np.max(np.abs(self.errors_k()))))

    def mean_flows_w(self) -> dict[str, float]:
        """Mean heat flow into the body of each effect over all times, [W], as `error_budget.mean_flows_w`."""
        shares = sum(leap.length_s * self._heat_w(leap) for leap in self._leaps) / self._time.duration_s
        flows = dict.fromkeys((effect for effect, _ in self._system.groups), 0.0)
        for (effect, _), heat_w in zip(self._system.groups, np.asarray(shares).tolist()):
            flows[effect] += heat_w
        return flows

    def _march(self) -> bool:
        times_s, count = self._time.times_s.tolist(), self._first_count
        state_k, fixed = self._system.start_k, self._system.fixed.nodes
        if len(fixed):
            state_k[fixed] = self._system.fixed.temperature_k(0.0)
        error_k, size_k = np.zeros(self._system.num_nodes), 0.0
        for begin_s in times_s[:-1]:
            while True:
                if count > _MOST_STEPS:
                    return False
                if times_s[1] / count > self._system.problem.resolution_s:
                    count *= 2
                    continue
                leaps = self._interval(state_k, begin_s, count)
                if leaps is None:
                    return False
                if self._only_at_start and self._leaps:
                    break
                end_k = error_k
                for leap in leaps:
                    leap.error_k = end_k = self._followed(leap, end_k)
                size_k = float(np.max(np.abs(end_k)))
                if size_k <= self._allowed_k:
                    error_k = end_k
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

    def _interval(self, state_k: Vector, begin_s: float, count: int) -> list[_Leap] | None:
        """Take some steps to the next output; None if the solver does not converge."""
        length_s = float(self._time.times_s[1]) / count
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
        mass_w_k, conducted_w = system.nodal_mass_j_k / stage.step_s, system.stiffness @ begin_k
        exchanged_w = self._exchanged(begin_k, begin_s)
        lacking_w, lacking_in_pieces_w = (
            _MORE[0] * (exchanged_w - conducted_w),
            _MORE[0] * self._sums(stage, exchanged_w),
        )
        given_w, given_to_pieces_w, states = 0.0, 0.0, [begin_k]
        for node, more in zip(SDIRK2.nodes, _MORE[1:]):
            now_s = begin_s + node * length_s
            exchanged_w = self._exchanged(begin_k, now_s)
            heat_w = exchanged_w - conducted_w + given_w
            change_k = np.zeros(system.num_nodes)
            if len(fixed.nodes):
                change_k[fixed.nodes] = fixed.temperature_k(now_s) - begin_k[fixed.nodes]
                heat_w -= system.stiffness @ change_k
                heat_w -= 0.0 if self._exchange is None else self._exchange @ change_k
            found_k, linear = stage.balance(heat_w, self._sums(stage, exchanged_w) + given_to_pieces_w)
            if not linear.converged:
                return None
            iterations += linear.iterations
            change_k += found_k
            states.append(begin_k + change_k)
            system.surroundings_k(now_s)  # Kept for the check of the range.
            flow_w = mass_w_k * change_k - given_w
            flow_to_pieces_w = self._sums(stage, self._exchanged(states[-1], now_s))
            lacking_w += more * flow_w
            lacking_in_pieces_w += more * flow_to_pieces_w
            given_w, given_to_pieces_w = _EARLIER * flow_w, _EARLIER * flow_to_pieces_w
        after = states[0], states[1], states[2]
        return _Leap(begin_s, length_s, after, stage, lacking_w, lacking_in_pieces_w, iterations)

    def _followed(self, leap: _Leap, error_k: Vector) -> Vector:
        """What a step leaves of an error, and its own, which its last stage damps as it does what it solves."""
        stage, nothing = leap.stage, error_k
        lacking_w, lacking_in_pieces_w = leap.lacking_w, leap.lacking_in_pieces_w
        if error_k.any():
            mass_w_k = self._system.nodal_mass_j_k / stage.step_s
            before_w = mass_w_k * error_k
            first_k = stage.damped(before_w, self._sums(stage, before_w), nothing, 0.0)
            given_w = before_w + _EARLIER * (mass_w_k * first_k - before_w)
            lacking_w, lacking_in_pieces_w = lacking_w + given_w, lacking_in_pieces_w + self._sums(stage, given_w)
        return stage.damped(lacking_w, lacking_in_pieces_w, nothing, 0.0)

    def _heat_w(self, leap: _Leap) -> Vector:
        """Mean heat flow of each group during a step, as in `Stepper`."""
        system, fixed, (begin_k, *states) = self._system, self._system.fixed, leap.states
        heat_w = np.zeros(len(system.groups) - len(fixed.groups))
        kept_w = (system.nodal_mass_j_k * (states[-1] - begin_k))[fixed.nodes] / leap.length_s
        for end, node, relative_k in zip(SDIRK2.ends, SDIRK2.nodes, states):
            now_s = leap.begin_s + node * leap.length_s
            if len(heat_w):
                heat_w += end * system.group_heat_w(relative_k, now_s)
            if len(fixed.nodes):
                kept_w -= end * (self._exchanged(relative_k, now_s) - system.stiffness @ relative_k)[fixed.nodes]
        return np.concatenate([heat_w, fixed.shares @ kept_w]) if len(fixed.nodes) else heat_w

    def _exchanged(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat from outside the body, shape (n,), [W]."""
        load_w = self._system.load(time_s)
        return load_w if self._exchange is None else load_w - self._exchange @ relative_k

    def _sums(self, stage: Stage, heat_w: Vector) -> Vector:
        """Sums over the pieces that float, shape (p,)."""
        return np.where(stage.floating, self._system.pieces.sums(heat_w), 0.0) if stage.floats else self._no_pieces
