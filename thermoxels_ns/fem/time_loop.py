"""The time loop: it follows the temperatures of a body in equal, given or adaptive steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.runge_kutta import BACKWARD_EULER, SDIRK2, RungeKutta, Scheme, Step
from thermoxels_ns.fem.solution import HeatSolution, heat_by_effect
from thermoxels_ns.fem.steady import out_of_range, refuse_too_cold
from thermoxels_ns.fem.system import HeatSystem

Vector = FloatArray
Progress = Callable[[float, int], None]

STEP_SHARE = 0.1
"""Largest estimated error of one step, as a share of the tolerance. Conduction damps errors, so that the errors of many
steps make less than their sum."""
_SAFETY = 0.9  # Length of the next step as a share of the longest step that is estimated to meet the tolerance
_SHRINK, _GROW = 0.2, 5.0
"""Least and largest factor between the lengths of one step and the next."""
_KEEP_BELOW = 1.25  # Factor below which a step is not lengthened, so that its matrices serve again
_SHORTEST = 1e-15  # Shortest step as a share of the duration
_LEAST = float(np.finfo(np.float64).tiny)
LEAST_CAPACITY_J_M3K = 1.0
"""Heat capacity per volume below which a body stores nothing to speak of: a thousandth of that of air, [J / (m3 K)]."""
_NOTHING = 1e-9  # Share of the heat content above absolute zero below which an exchange of heat is negligible


def solve_heat(
    problem: HeatProblem,
    time: TimeSteps | AdaptiveSteps | FloatArray,
    *,
    scheme: Scheme = BACKWARD_EULER,
    relative_tolerance: float = 1e-12,
    estimate_steps: bool = False,
    progress: Progress | None = None,
) -> HeatSolution:
    """Follow the temperatures of a body through time, and account for the heat that each effect brings.

    Masses are lumped. With backward Euler and tetrahedra without obtuse angles no temperature leaves the range of the
    start and of the surroundings at any step length, unless a flux or source drives it out. If a temperature leaves
    this range without such a cause, the status says by how much.

    Args:
        problem: Body, materials, initial temperatures and effects; without effects the boundary is insulated.
        time: Equal steps, steps as long as a tolerance allows, or the lengths of the steps, shape (k,), [s].
        scheme: The scheme of equal or given steps. Adaptive steps are always those of SDIRK2.
        relative_tolerance: Relative tolerance of the linear solver in each step.
        estimate_steps: Estimate the error of equal steps (`time_error_k`), too, by solving again with steps of twice
            the length, which takes half as long again. Adaptive steps always have an estimate, given steps never.
        progress: Called after every step with the share of the duration that is done and the number of steps.

    Raises:
        HeatError: An effect does not fit the mesh, a material stores next to no heat, a step's solver does not
            converge, or the temperature falls below absolute zero.
    """
    least = float(np.min(problem.heat_capacity_j_m3k))
    if least < LEAST_CAPACITY_J_M3K:
        expected = f"at least {LEAST_CAPACITY_J_M3K:g} J/(m3 K) to follow a body through time (air has 1200)"
        remedy = "Correct density and specific heat of the material, or ask for the steady state."
        raise HeatError("heat capacity", expected=expected, got=f"{least:g} J/(m3 K)", remedy=remedy)
    times_s = np.append(0.0, np.cumsum(time)) if isinstance(time, np.ndarray) else time.times_s
    balance = HeatBalance(HeatSystem(problem), times_s)
    if isinstance(time, AdaptiveSteps):
        steps = _adaptive_steps(balance, time, relative_tolerance)
    else:
        lengths_s = time if isinstance(time, np.ndarray) else time.lengths_s
        steps = _given_steps(balance, RungeKutta(balance.system, scheme, relative_tolerance), lengths_s)
    for done_s in steps:
        if progress is not None:
            progress(done_s / float(times_s[-1]), balance.steps)
    found = balance.close()
    if isinstance(time, TimeSteps) and time.step_seconds > problem.resolution_s:
        said = (
            f" Steps of {time.step_seconds:g} s are longer than the {problem.resolution_s:g} s by which effects that "
            "change with time can be followed; what happens in between is missed."
        )
        found = replace(found, status=found.status + said)
    if not estimate_steps or not isinstance(time, TimeSteps):
        return found
    if time.steps >= 2:
        twice_s = np.full(time.steps // 2, 2.0 * time.step_seconds)
        with suppress(HeatError):
            doubled = solve_heat(problem, twice_s, scheme=scheme, relative_tolerance=relative_tolerance)
            apart_k = np.abs(found.temperature_c[: 2 * doubled.steps + 1 : 2] - doubled.temperature_c).max(axis=1)
            most_k, last_k = (float(part) / (2.0**scheme.order - 1.0) for part in (apart_k.max(), apart_k[-1]))
            said = f" The steps make an error of about {most_k:.2g} K at most and {last_k:.2g} K at the end (from steps"
            return replace(found, status=f"{found.status}{said} of twice the length).", time_error_k=most_k)
    why = "steps of twice the length fail" if found.steps > 1 else "it takes two of them"
    return replace(found, status=f"{found.status} The error of the steps is not estimated: {why}.")


def _given_steps(balance: HeatBalance, kutta: RungeKutta, lengths_s: Vector) -> Iterator[float]:
    """Add steps of given lengths, [s], to `balance`, and yield after each of them the time that is reached, [s].

    Raises `HeatError` if a step's solver does not converge.
    """
    relative_k = balance.start_k
    for now_s, step_s in zip(balance.times_s.tolist(), lengths_s.tolist()):
        step = kutta.step(relative_k, now_s, step_s)
        balance.add(step, step_s, ends_interval=True)
        relative_k = step.relative_k
        yield now_s + step_s


def _adaptive_steps(balance: HeatBalance, time: AdaptiveSteps, relative_tolerance: float) -> Iterator[float]:
    """Add steps as long as their estimated errors and `HeatProblem.resolution_s` allow, and yield as `_given_steps`.

    Raises `HeatError` if no step is short enough; steps that are repeated are counted in `balance`.
    """
    system, allowed_k, relative_k = balance.system, STEP_SHARE * time.tolerance_k, balance.start_k
    kutta, now_s = RungeKutta(system, SDIRK2, relative_tolerance), 0.0
    rate = system.net_heat(relative_k, 0.0) / system.nodal_mass_j_k
    fastest, interval_s = float(np.max(np.abs(rate[system.fixed.free]), initial=0.0)), time.duration_s / time.outputs
    wished_s = interval_s
    if fastest > 0.0:
        wished_s = float(np.clip(time.tolerance_k / fastest, _SHORTEST * time.duration_s, interval_s))
    for end_s in time.times_s[1:].tolist():
        while now_s < end_s:
            left_s = end_s - now_s
            step_s = _fitted(min(wished_s, system.problem.resolution_s), left_s)
            try:
                step = kutta.step(relative_k, now_s, step_s, estimate=True)
                error_k, why = step.error_k, f"keeps within {time.tolerance_k:g} K. Something jumps in time: end an"
                why += " interval there, or raise the tolerance."
            except HeatError as failure:
                step, error_k, why = None, np.inf, f"succeeds. {failure}"
            longest = (allowed_k / max(error_k, _LEAST)) ** (1.0 / (SDIRK2.order + 1))
            factor = float(np.clip(_SAFETY * longest, _SHRINK, _GROW))
            if step is None or error_k > allowed_k:
                balance.repeated += 1
                wished_s = step_s * min(factor, _SAFETY)
                if wished_s < _SHORTEST * time.duration_s or now_s + 0.25 * wished_s == now_s:
                    raise HeatError(f"At {now_s:.6g} s no step however short {why}")
                continue
            now_s = end_s if step_s == left_s else now_s + step_s
            balance.add(step, step_s, ends_interval=now_s == end_s)
            relative_k = step.relative_k
            next_s = step_s * (factor if factor > _KEEP_BELOW else min(factor, 1.0))
            # A good step that was cut short by an interval's end is no reason to shorten the length wished for.
            wished_s = max(next_s, wished_s) if step_s < wished_s and factor >= 1.0 else next_s
            yield now_s


class HeatBalance:
    """The account of a computation: temperatures at the ends of intervals, and the heat that flowed in between."""

    def __init__(self, system: HeatSystem, times_s: Vector) -> None:
        """Begin the account of what happens between `times_s`, ascending from 0, shape (s + 1,), [s]."""
        self.system, self.times_s = system, times_s
        self._states = np.empty((len(times_s), system.num_nodes))
        self._states[0] = system.start_k
        if len(system.fixed.nodes):
            self._states[0, system.fixed.nodes] = system.fixed.temperature_k(0.0)
        self._done = 0
        self.steps = 0
        """Number of steps that were added so far."""
        self.repeated = 0
        """Number of steps that were repeated with a shorter length."""
        self._heat_j = np.zeros((len(times_s) - 1, len(system.groups)))
        self._exchanged_j = 0.0
        self._iterations = np.zeros((len(times_s) - 1, 2), dtype=np.int64)
        self._range_k = float(self.start_k.min()), float(self.start_k.max())
        self._beyond_k = self._unbalanced_w = self._error_k = 0.0

    @property
    def start_k(self) -> Vector:
        """Temperatures at the start, nodes of fixed temperature included, relative to the reference, (n,), [K]."""
        return self._states[0]

    def add(self, step: Step, step_s: float, *, ends_interval: bool) -> None:
        """Add a step of length `step_s`, [s], to the account; if it ends an interval, keep its temperatures."""
        refuse_too_cold(self.system, step.relative_k)
        self._heat_j[self._done] += step_s * step.group_heat_w
        self._exchanged_j += step_s * float(np.abs(step.group_heat_w).sum())
        self._iterations[self._done] += step.iterations, step.newton_iterations
        self._unbalanced_w = max(self._unbalanced_w, step.unbalanced_w)
        self._error_k += step.error_k
        self._range_k = low, high = min(self._range_k[0], step.range_k[0]), max(self._range_k[1], step.range_k[1])
        self._beyond_k = max(self._beyond_k, low - float(step.relative_k.min()), float(step.relative_k.max()) - high)
        self.steps += 1
        if ends_interval:
            self._done += 1
            self._states[self._done] = step.relative_k

    def close(self) -> HeatSolution:
        """Return the solution with its heat; converts the states to Celsius in place, to save memory."""
        system, states_k, times_s, heat_j = self.system, self._states, self.times_s, self._heat_j
        mass = system.nodal_mass_j_k
        total_mass = float(mass.sum())
        relative_content = states_k @ mass
        content = relative_content + total_mass * celsius_to_kelvin(system.reference_c)
        supplied = np.append(0.0, np.cumsum(heat_j.sum(axis=1)))
        unexplained = float(np.max(np.abs(relative_content - relative_content[0] - supplied)))
        # Summed without BLAS, whose sum depends on the number of its threads.
        spread = float(np.sum(mass * np.abs(states_k[0] - relative_content[0] / total_mass)))
        scale = max(spread + self._exchanged_j, _NOTHING * float(content[0]), _LEAST)
        lengths, facet_heat_w = np.diff(times_s), system.facet_heat_w(states_k[-1], float(times_s[-1]))
        overshoot_k, overshoot = out_of_range(self._beyond_k)
        repeated = f" {self.repeated} more were repeated with a shorter length." if self.repeated else ""
        states_k += system.reference_c
        return HeatSolution(
            times_s=times_s,
            temperature_c=states_k,
            heat_w=np.diff(relative_content) / lengths,
            heat_content_j=content,
            energy_residual=unexplained / scale,
            status=f"All {self.steps} steps converged.{repeated}{overshoot}",
            iterations=self._iterations[:, 0],
            effects=heat_by_effect(effect_labels(system.problem), system.groups, heat_j / lengths[:, None]),
            newton_iterations=self._iterations[:, 1],
            steps=self.steps,
            time_error_k=self._error_k,
            unbalanced_w=self._unbalanced_w,
            facet_heat_w=facet_heat_w,
            overshoot_k=overshoot_k,
        )


def _fitted(wished_s: float, left_s: float) -> float:
    """Return the length of the next step, [s]: `left_s`, which ends the interval, or at most half of `left_s`.

    >>> [_fitted(wished, 10.0) for wished in (12.0, 8.0, 3.0)]
    [10.0, 5.0, 3.0]
    """
    return left_s if wished_s >= left_s else min(wished_s, 0.5 * left_s)
