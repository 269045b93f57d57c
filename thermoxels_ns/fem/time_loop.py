"""The time loop: it follows the temperatures of a body in equal, given or adaptive steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

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
        HeatError: An effect does not fit the mesh, a material stores next to no heat, a step's solver does not
            converge, or the temperature falls below absolute zero.
    """
    _check_stores(problem)
    states = np.empty((len(time.times_s), len(problem.mesh.points_m)))
    system = HeatSystem(problem)
    states[0] = problem.start_c - system.reference_c
    if len(system.fixed.nodes):
        states[0, system.fixed.nodes] = system.fixed.temperature_k(0.0)
    balance, adaptive = HeatBalance(system, states, time.times_s), isinstance(time, AdaptiveSteps)
    kutta = RungeKutta(system, SDIRK2 if adaptive else scheme, relative_tolerance=relative_tolerance)
    if isinstance(time, AdaptiveSteps):
        steps = _adaptive_steps(kutta, states[0], time, balance)
    else:
        steps = _given_steps(kutta, states[0], time)
    for step, step_s, ends_interval in steps:
        refuse_too_cold(system, step.relative_k)
        balance.add(step, step_s, ends_interval=ends_interval)
        if progress is not None:
            progress(balance.followed_s / time.duration_s, balance.steps)
    solution = balance.close(balance.success() + _skips(problem, time), adaptive=adaptive)
    if not estimate_steps or not isinstance(time, TimeSteps):
        return solution
    doubled: HeatSolution | None = None
    if time.steps >= 2:
        with suppress(HeatError):
            twice = TimeSteps(time.steps // 2, 2.0 * time.step_seconds)
            doubled = solve_heat(problem, twice, scheme=scheme, relative_tolerance=relative_tolerance)
    return _error_of_equal_steps(solution, doubled, scheme.order)


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


def _given_steps(
    kutta: RungeKutta, start_k: Vector, time: TimeSteps | GivenSteps
) -> Iterator[tuple[Step, float, bool]]:
    """Yield equal or given steps from `start_k`, (n,), [K], each with its length, [s], and whether it ends an interval.

    Raises `HeatError` if a step's solver does not converge.
    """
    relative_k = start_k
    for number, (now_s, step_s) in enumerate(zip(time.times_s.tolist(), time.lengths_s.tolist()), start=1):
        step = kutta.step(relative_k, now_s, step_s)
        if not step.converged:
            remedy = "Use shorter steps or check the mesh's quality."
            raise HeatError(f"Step {number} of {len(time.lengths_s)} failed. {step.status} {remedy}")
        yield step, step_s, True
        relative_k = step.relative_k


def _adaptive_steps(
    kutta: RungeKutta, start_k: Vector, time: AdaptiveSteps, balance: HeatBalance
) -> Iterator[tuple[Step, float, bool]]:
    """Yield, as `_given_steps`, steps as long as their estimated errors and `HeatProblem.resolution_s` allow.

    Raises `HeatError` if no step is short enough; steps that are repeated are counted in `balance`.
    """
    system, allowed_k = kutta.system, STEP_SHARE * time.tolerance_k
    rate = system.net_heat(start_k, 0.0) / system.nodal_mass_j_k
    fastest, interval_s = float(np.max(np.abs(rate[system.fixed.free]), initial=0.0)), time.duration_s / time.outputs
    wished_s = interval_s
    if fastest > 0.0:
        wished_s = float(np.clip(time.tolerance_k / fastest, _SHORTEST * time.duration_s, interval_s))
    relative_k, now_s = start_k, 0.0
    for end_s in time.times_s[1:].tolist():
        while now_s < end_s:
            left_s = end_s - now_s
            step_s = _fitted(min(wished_s, system.problem.resolution_s), left_s)
            step = kutta.step(relative_k, now_s, step_s, estimate=True)
            factor = _SHRINK
            if step.converged and np.isfinite(step.error_k):
                longest = (allowed_k / max(step.error_k, _LEAST)) ** (1.0 / (kutta.scheme.order + 1))
                factor = float(np.clip(_SAFETY * longest, _SHRINK, _GROW))
            if not step.converged or step.error_k > allowed_k:
                balance.repeated += 1
                wished_s = step_s * min(factor, _SAFETY)
                if wished_s < _SHORTEST * time.duration_s or now_s + 0.25 * wished_s == now_s:
                    why = f"succeeds. {step.status} Check the mesh's quality."
                    if step.converged:
                        why = f"keeps within {time.tolerance_k:g} K. Something jumps in time: end an interval there, "
                        why += "or raise the tolerance."
                    raise HeatError(f"At {now_s:.6g} s no step however short {why}")
                continue
            now_s = end_s if step_s == left_s else now_s + step_s
            relative_k = step.relative_k
            next_s = step_s * (factor if factor > _KEEP_BELOW else min(factor, 1.0))
            # A good step that was cut short by an interval's end is no reason to shorten the length wished for.
            wished_s = max(next_s, wished_s) if step_s < wished_s and factor >= 1.0 else next_s
            yield step, step_s, now_s == end_s


class HeatBalance:
    """The account of a computation: temperatures at the ends of intervals, and the heat that flowed in between."""

    def __init__(self, system: HeatSystem, states_k: Vector, times_s: Vector) -> None:
        """Begin the account; `states_k`, (s + 1, n), [K], holds the start and room for the states at `times_s`, [s]."""
        self._system, self._states, self._times = system, states_k, times_s
        self._done = self._most_iterations = 0
        self.steps = 0
        """Number of steps that were added so far."""
        self.repeated = 0
        """Number of steps that were repeated with a shorter length."""
        self.followed_s = 0.0
        """Time that the steps so far have covered, [s]."""
        self._heat_j = np.zeros((len(times_s) - 1, len(system.groups)))
        self._exchanged_j = np.zeros(len(times_s) - 1)
        self._iterations = np.zeros((len(times_s) - 1, 2), dtype=np.int64)
        self._error_k = 0.0
        self._range_k = float(states_k[0].min()), float(states_k[0].max())
        self._overshoot_k, self._overshooting = 0.0, 0
        self._unbalanced_w = 0.0

    def add(self, step: Step, step_s: float, *, ends_interval: bool) -> None:
        """Add a step of length `step_s`, [s], to the account; if it ends an interval, keep its temperatures."""
        row = self._done
        self._heat_j[row] += step_s * step.group_heat_w
        self._iterations[row] += step.iterations, step.newton_iterations
        self._most_iterations = max(self._most_iterations, step.iterations)
        self._error_k += step.error_k
        self.steps += 1
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

    def success(self) -> str:
        """Return sentences on convergence, on the number of repeated steps, and on temperatures out of range."""
        sentence = f"All {self.steps} steps converged, in {self._most_iterations} iterations at most."
        sentence += f" {self.repeated} more were repeated with a shorter length." if self.repeated else ""
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
            steps=self.steps,
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
