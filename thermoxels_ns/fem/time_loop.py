"""The time loop: it follows the temperatures of a body in equal, given or adaptive steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.fem.problem import AdaptiveSteps, GivenSteps, HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.runge_kutta import BACKWARD_EULER, SDIRK2, RungeKutta, Scheme, Step
from thermoxels_ns.fem.solution import HeatSolution, heat_by_effect
from thermoxels_ns.fem.steady import OVERSHOOT_K, refuse_too_cold
from thermoxels_ns.fem.system import HeatSystem

Vector = FloatArray
Steps = TimeSteps | AdaptiveSteps | GivenSteps

MAX_STATE_BYTES = 4 * 2**30
"""Most memory that the temperatures of all kept times may take, [bytes]; each time is also a file of an export."""
STEP_SHARE = 0.1
"""Largest estimated error of one step, as a share of the tolerance. Conduction damps errors, so that the errors of many
steps make less than their sum."""
_SAFETY = 0.9  # Length of the next step as a share of the longest step that is estimated to meet the tolerance
_SHRINK, _GROW = 0.2, 5.0
"""Least and largest factor between the lengths of one step and the next."""
_KEEP_BELOW = 1.25  # Factor below which a step is not lengthened, so that its matrices serve again
_SHORTEST = 1e-15  # Shortest step as a share of the duration
LEAST_CAPACITY_J_M3K = 1.0
"""Heat capacity per volume below which a body stores nothing to speak of: a thousandth of that of air, [J / (m3 K)]."""
_NOTHING = 1e-9  # Share of the heat content above absolute zero below which an exchange of heat is negligible


def solve_heat(
    problem: HeatProblem,
    time: Steps,
    *,
    scheme: Scheme = BACKWARD_EULER,
    relative_tolerance: float = 1e-12,
    estimate_steps: bool = False,
    progress: Callable[[float, int], None] | None = None,
) -> HeatSolution:
    """Follow the temperatures of a body through time, and account for the heat that each effect brings.

    Masses are lumped. With backward Euler and tetrahedra without obtuse angles no temperature leaves the range of the
    start and of the surroundings at any step length, unless a flux or source drives it out. If a temperature leaves
    this range without such a cause, the status says by how much.

    Args:
        problem: Body, materials, initial temperatures and effects; without effects the boundary is insulated.
        time: Equal steps, steps as long as a tolerance allows, or steps of given lengths.
        scheme: The scheme of equal or given steps. Adaptive steps are always those of SDIRK2.
        relative_tolerance: Relative tolerance of the linear solver in each step.
        estimate_steps: Estimate the error of equal steps (`time_error_k`), too, by solving again with steps of twice
            the length, which takes half as long again. Adaptive steps always have an estimate, given steps never.
        progress: Called after every step with the share of the duration that is done and the number of steps.

    Raises:
        HeatError: If the temperatures of all times do not fit into memory, an effect does not fit the mesh, a material
            stores next to no heat, a step's solver does not converge, or the temperature falls below absolute zero.
    """
    _check_stores(problem)
    states = _room_for_states(len(time.times_s), len(problem.mesh.points_m))
    system = HeatSystem(problem)
    states[0] = problem.start_c - system.reference_c
    if len(system.fixed.nodes):
        states[0, system.fixed.nodes] = system.fixed.temperature_k(0.0)
    balance, adaptive = HeatBalance(system, states, time.times_s), isinstance(time, AdaptiveSteps)
    loop = _TimeLoop(system, SDIRK2 if adaptive else scheme, time, relative_tolerance)
    for taken in loop.steps(states[0]):
        refuse_too_cold(system, taken.step.relative_k)
        balance.add(taken.step, taken.step_s, ends_interval=taken.ends_interval)
        if progress is not None:
            progress(balance.followed_s / time.duration_s, balance.steps)
    solution = balance.close(balance.success(loop.repeated) + _skips(problem, time), adaptive=adaptive)
    if not estimate_steps or not isinstance(time, TimeSteps):
        return solution
    doubled: HeatSolution | None = None
    if time.steps >= 2:
        with suppress(HeatError):
            twice = TimeSteps(time.steps // 2, 2.0 * time.step_seconds)
            doubled = solve_heat(problem, twice, scheme=scheme, relative_tolerance=relative_tolerance)
    return _error_of_equal_steps(solution, doubled, scheme.order)


@dataclass(frozen=True)
class _Taken:
    """A step that was taken and need not be repeated."""

    step: Step  # Outcome of the step
    step_s: float  # Length of the step, [s]
    ends_interval: bool  # True if the step ends an interval, where temperatures are kept


def _error_of_equal_steps(found: HeatSolution, doubled: HeatSolution | None, order: int) -> HeatSolution:
    """Return `found` with the error of its equal steps, from steps of twice their length (Richardson 1911).

    Halving the steps of a scheme of order p leaves 1 / 2^p of the error, so the two solutions differ by 2^p - 1 times
    the error of the shorter steps. `doubled` None: the status says why there is no estimate.
    """
    if doubled is None:
        why = "steps of twice the length fail" if found.steps > 1 else "it takes two of them"
        return replace(found, status=f"{found.status} The error of the steps is not estimated: {why}.")
    apart_k = np.abs(found.temperature_c[: 2 * len(doubled.times_s) - 1 : 2] - doubled.temperature_c).max(axis=1)
    most_k, last_k = (float(part) / (2.0**order - 1.0) for part in (apart_k.max(), apart_k[-1]))
    said = (
        f" The steps make an error of about {most_k:.2g} K at most and {last_k:.2g} K at the end (from steps of twice "
        "the length)."
    )
    return replace(found, status=found.status + said, time_error_k=most_k)


class _TimeLoop:
    """Takes one step after the other; no adaptive step is longer than `HeatProblem.resolution_s`."""

    def __init__(self, system: HeatSystem, scheme: Scheme, time: Steps, relative_tolerance: float) -> None:
        self._system, self._scheme, self._time = system, scheme, time
        self.runge_kutta = RungeKutta(system, scheme, relative_tolerance=relative_tolerance)
        self._allowed_k = STEP_SHARE * time.tolerance_k if isinstance(time, AdaptiveSteps) else np.inf
        self.repeated = 0
        """Number of steps that were repeated with a shorter length."""

    def steps(self, start_k: Vector) -> Iterator[_Taken]:
        """Take all steps from `start_k`, shape (n,), [K]; raises `HeatError` if a step fails."""
        if isinstance(self._time, AdaptiveSteps):
            return self._adaptive(start_k, self._time)
        return self._given(start_k, self._time)

    def _given(self, start_k: Vector, time: TimeSteps | GivenSteps) -> Iterator[_Taken]:
        """Take the equal or given steps of `time`; raises `HeatError` if a step's solver does not converge."""
        relative_k, count, total = start_k, 0, sum(map(len, time.lengths_s))
        for now_s, lengths_s in zip(time.times_s.tolist(), time.lengths_s):
            for number, step_s in enumerate(lengths_s, start=1):
                count += 1
                step = self.runge_kutta.step(relative_k, now_s, step_s)
                if not step.converged:
                    remedy = "Use shorter steps or check the mesh's quality."
                    raise HeatError(f"Step {count} of {total} failed. {step.status} {remedy}")
                yield _Taken(step, step_s, number == len(lengths_s))
                relative_k, now_s = step.relative_k, now_s + step_s

    def _adaptive(self, start_k: Vector, time: AdaptiveSteps) -> Iterator[_Taken]:
        """Take steps as long as their estimated errors allow; raises `HeatError` if no step is short enough."""
        relative_k, now_s, wished_s = start_k, 0.0, self._first_length(start_k, time)
        for end_s in time.times_s[1:].tolist():
            while now_s < end_s:
                left_s = end_s - now_s
                step_s = _fitted(min(wished_s, self._system.problem.resolution_s), left_s)
                step = self.runge_kutta.step(relative_k, now_s, step_s, estimate=True)
                factor = self._factor(step)
                if not step.converged or step.error_k > self._allowed_k:
                    self.repeated += 1
                    wished_s = step_s * min(factor, _SAFETY)
                    if wished_s < _SHORTEST * time.duration_s or now_s + 0.25 * wished_s == now_s:
                        raise HeatError(self._failure(step, now_s, time))
                    continue
                now_s = end_s if step_s == left_s else now_s + step_s
                relative_k = step.relative_k
                next_s = step_s * (factor if factor > _KEEP_BELOW else min(factor, 1.0))
                # A good step that was cut short by an interval's end is no reason to shorten the length wished for.
                wished_s = max(next_s, wished_s) if step_s < wished_s and factor >= 1.0 else next_s
                yield _Taken(step, step_s, now_s == end_s)

    def _first_length(self, start_k: Vector, time: AdaptiveSteps) -> float:
        system = self._system
        rate = system.net_heat(start_k, 0.0) / system.nodal_mass_j_k
        fastest = float(np.max(np.abs(rate[system.fixed.free]), initial=0.0))
        interval_s = time.duration_s / time.outputs
        if fastest == 0.0:
            return interval_s
        return float(np.clip(time.tolerance_k / fastest, _SHORTEST * time.duration_s, interval_s))

    def _factor(self, step: Step) -> float:
        """Return the length of the next step over that of this one, from `_SHRINK` to `_GROW`."""
        if not step.converged or not np.isfinite(step.error_k):
            return _SHRINK
        if step.error_k == 0.0:
            return _GROW
        longest = (self._allowed_k / step.error_k) ** (1.0 / (self._scheme.order + 1))
        return float(np.clip(_SAFETY * longest, _SHRINK, _GROW))

    def _failure(self, step: Step, now_s: float, time: AdaptiveSteps) -> str:
        if not step.converged:
            return f"At {now_s:.6g} s no step however short succeeds. {step.status} Check the mesh's quality."
        return (
            f"At {now_s:.6g} s no step however short keeps within {time.tolerance_k:g} K. Something jumps in "
            "time: end an interval there, or raise the tolerance."
        )


class HeatBalance:
    """The account of a computation: temperatures at the ends of intervals, and the heat that flowed in between."""

    def __init__(self, system: HeatSystem, states_k: Vector, times_s: Vector) -> None:
        """Begin the account; `states_k`, (s + 1, n), [K], holds the start and room for the states at `times_s`, [s]."""
        self._system, self._states, self._times = system, states_k, times_s
        self._done = self._steps = self._most_iterations = 0
        self.followed_s = 0.0
        """Time that the steps so far have covered, [s]."""
        self._heat_j = np.zeros((len(times_s) - 1, len(system.groups)))
        self._exchanged_j = np.zeros(len(times_s) - 1)
        self._iterations = np.zeros((len(times_s) - 1, 2), dtype=np.int64)
        self._error_k = 0.0
        self._range_k = float(states_k[0].min()), float(states_k[0].max())
        self._overshoot_k, self._overshooting = 0.0, 0
        self._unbalanced_w = 0.0

    @property
    def steps(self) -> int:
        """Number of steps that were added so far."""
        return self._steps

    def add(self, step: Step, step_s: float, *, ends_interval: bool) -> None:
        """Add a step of length `step_s`, [s], to the account; if it ends an interval, keep its temperatures."""
        row = self._done
        self._heat_j[row] += step_s * step.group_heat_w
        self._iterations[row] += step.iterations, step.newton_iterations
        self._most_iterations = max(self._most_iterations, step.iterations)
        self._error_k += step.error_k
        self._steps += 1
        self._exchanged_j[row] += step_s * float(np.abs(step.group_heat_w).sum())
        self._unbalanced_w = max(self._unbalanced_w, step.unbalanced_w)
        overshoot_k = self._overshoot_of(step.relative_k, step_s)
        self._overshooting += overshoot_k > OVERSHOOT_K
        self._overshoot_k = max(self._overshoot_k, overshoot_k)
        self.followed_s += step_s
        if ends_interval:
            self._done += 1
            self._states[self._done] = step.relative_k

    def _overshoot_of(self, relative_k: Vector, step_s: float) -> float:
        """Return how far temperatures after a step leave the range of the start and of all surroundings so far, [K]."""
        times = self.followed_s, self.followed_s + step_s
        self._range_k = low, high = self._system.allowed_range_k(self._range_k, times)
        return max(low - float(relative_k.min()), float(relative_k.max()) - high)

    def success(self, repeated: int) -> str:
        """Return sentences on convergence, on the number of steps `repeated`, and on temperatures out of range."""
        sentence = f"All {self._steps} steps converged, in {self._most_iterations} iterations at most."
        sentence += f" {repeated} more were repeated with a shorter length." if repeated else ""
        if self._overshooting:
            sentence += (
                f" In {self._overshooting} a temperature left the range of the start and of the surroundings, by up to "
                f"{self._overshoot_k:.2g} K: the mesh or the steps do not resolve a jump."
            )
        return sentence

    def close(self, status: str, *, adaptive: bool) -> HeatSolution:
        """Return the solution with its heat and `status`; converts `states_k` to Celsius in place, to save memory."""
        system, states_k, times_s, heat_j = self._system, self._states, self._times, self._heat_j
        mass = system.nodal_mass_j_k
        total_mass = float(mass.sum())
        relative_content = states_k @ mass
        content = relative_content + total_mass * celsius_to_kelvin(system.reference_c)
        supplied = np.concatenate([[0.0], np.cumsum(heat_j.sum(axis=1))])
        unexplained = float(np.max(np.abs(relative_content - relative_content[0] - supplied)))
        exchanged = float(self._exchanged_j.sum())
        mean = relative_content[0] / total_mass
        # Summed without BLAS, whose sum depends on the number of its threads.
        spread = float(np.sum(mass * np.abs(states_k[0] - mean)))
        scale = max(float(content[0]), exchanged)
        spread_scale = max(spread + exchanged, _NOTHING * float(content[0]))
        lengths, last_facet_heat = np.diff(times_s), system.facet_heat(states_k[-1], float(times_s[-1]))
        states_k += system.reference_c
        return HeatSolution(
            times_s=times_s,
            temperature_c=states_k,
            heat_w=np.diff(relative_content) / lengths,
            heat_content_j=content,
            energy_residual=_share(unexplained, scale),
            energy_residual_of_spread=_share(unexplained, spread_scale),
            status=status,
            iterations=self._iterations[:, 0],
            effects=heat_by_effect(effect_labels(system.problem), system.groups, heat_j / lengths[:, None]),
            newton_iterations=self._iterations[:, 1],
            steps=self._steps,
            time_error_k=self._error_k if adaptive else float("nan"),
            unbalanced_w=self._unbalanced_w,
            last_facet_heat=last_facet_heat,
            overshoot_k=self._overshoot_k if self._overshooting else 0.0,
            assembled=system.assembled,
        )


def _share(part: float, whole: float) -> float:
    """Return part / whole; 0 if the part is 0, infinite if only the whole is 0."""
    if part == 0.0:
        return 0.0
    return part / whole if whole > 0.0 else float("inf")


def _fitted(wished_s: float, left_s: float) -> float:
    """Return the length of the next step, [s]: `left_s`, which ends the interval, or at most half of `left_s`.

    >>> [_fitted(wished, 10.0) for wished in (12.0, 8.0, 3.0)]
    [10.0, 5.0, 3.0]
    """
    return left_s if wished_s >= left_s else min(wished_s, 0.5 * left_s)


def _skips(problem: HeatProblem, time: Steps) -> str:
    """Return a sentence if equal steps are too long to see how an effect changes, else ""."""
    if not isinstance(time, TimeSteps) or time.step_seconds <= problem.resolution_s:
        return ""
    return (
        f" Steps of {time.step_seconds:g} s are longer than the {problem.resolution_s:g} s by which effects that "
        "change with time can be followed; what happens in between is missed."
    )


def _check_stores(problem: HeatProblem) -> None:
    least = float(np.min(problem.heat_capacity_j_m3k))
    if least < LEAST_CAPACITY_J_M3K:
        expected = f"at least {LEAST_CAPACITY_J_M3K:g} J/(m3 K) to follow a body through time (air has 1200)"
        remedy = "Correct density and specific heat of the material, or ask for the steady state."
        raise HeatError("heat capacity", expected=expected, got=f"{least:g} J/(m3 K)", remedy=remedy)


def _room_for_states(num_times: int, num_nodes: int) -> Vector:
    """Return an empty array, shape (num_times, num_nodes); raise `HeatError` if it needs more memory than allowed."""
    needed = num_times * num_nodes * 8
    try:
        if needed <= MAX_STATE_BYTES:
            return np.empty((num_times, num_nodes))
        room = f"{MAX_STATE_BYTES} bytes"
    except MemoryError:
        room = "the memory that is free"
    raise HeatError(
        "steps",
        expected=f"temperatures of all times in at most {room}",
        got=f"{num_times} times x {num_nodes} nodes x 8 bytes = {needed} bytes",
        remedy=f"Take at most {max(MAX_STATE_BYTES // (8 * num_nodes) - 1, 1)} steps, or a coarser mesh.",
    )
