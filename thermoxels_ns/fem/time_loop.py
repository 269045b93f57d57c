"""Temperatures through time by diagonally implicit Runge-Kutta schemes, in equal, given or adaptive steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.fem.implicit_equation import ImplicitEquation
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.steady import out_of_range, refuse_too_cold
from thermoxels_ns.fem.system import Engine, HeatSystem

Vector = FloatArray
Progress = Callable[[float, int], None]

STEP_SHARE = 0.1
"""Largest estimated error of one step as a share of the tolerance; conduction damps the errors of earlier steps."""
_SAFETY = 0.9  # Length of the next step as a share of the longest step that is estimated to meet the tolerance
_SHRINK, _GROW = 0.2, 5.0  # Least and largest ratio of the lengths of the next step and of this one
_KEEP_BELOW = 1.25  # A step is not lengthened by less than this factor, so that its matrices can be used again
_SHORTEST = 1e-15  # Shortest step as a share of the duration
_LEAST = float(np.finfo(np.float64).tiny)
LEAST_CAPACITY_J_M3K = 1.0  # Least accepted heat capacity per volume, [J / (m3 K)]: a thousandth of that of air
_NOTHING = 1e-9  # Share of the heat content above absolute zero below which an exchange of heat is negligible
_ESTIMATE_TOLERANCE = 1e-3  # Relative tolerance of the linear solver for error estimates
_SAME_LENGTH = 1e-12  # Relative difference up to which two lengths of a stage count as equal


@dataclass(frozen=True)
class Scheme:
    """A diagonally implicit Runge-Kutta scheme with the coefficients a, b and c.

    The notation follows Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.6. Each stage i
    solves M (T_i - T_n) = dt * sum_j a_ij F(T_j) with the net heat flow F into the nodes. The step ends with
    M (T_n+1 - T_n) = dt * sum_j b_j F(T_j), so the heat balance closes at any step length.
    """

    name: str  # Name of the scheme
    order: int  # Order p: the error at a given time is proportional to the step length to the power p
    weights: tuple[tuple[float, ...], ...]
    """The lower triangular matrix a, a row per stage; its last row is b. The sum of a row is c, the time of the stage
    as a share of the step. All diagonal entries are equal, so that stages share a matrix."""
    estimate: tuple[float, ...] | None = None
    """Weights, for the flows at the start and in each stage, of a scheme one order higher; None: no error estimate."""

    @property
    def nodes(self) -> tuple[float, ...]:
        """The coefficients c, the time of each stage as a share of the step."""
        return tuple(map(math.fsum, self.weights))


def _sdirk2() -> Scheme:
    """Return Alexander's L-stable two-stage scheme (SIAM J. Numer. Anal. 14, 1977), gamma = 1 - 1 / sqrt(2). Its
    estimate also uses the flow at the start, and is of third order if loads are constant."""
    gamma = 1.0 - 1.0 / math.sqrt(2.0)
    second = (1.0 - gamma) * gamma + gamma
    first_weight = (1.0 / 6.0 - 0.5 * second) / (gamma * gamma - gamma * second)
    second_weight = 0.5 - gamma * first_weight
    estimate = (1.0 - first_weight - second_weight, first_weight, second_weight)
    return Scheme("SDIRK2", 2, ((gamma, 0.0), (1.0 - gamma, gamma)), estimate)


BACKWARD_EULER = Scheme("backward Euler", 1, ((1.0,),))
"""Scheme of first order. With lumped masses and non-obtuse tetrahedra, all temperatures are within the range of the
start and of the surroundings for any step length."""
SDIRK2 = _sdirk2()
"""Scheme of second order, L-stable: it damps fast changes. Very long steps may overshoot by 1 or 2 % of a jump."""


@dataclass(frozen=True)
class Step:
    """The outcome of `RungeKutta.step`."""

    relative_k: Vector  # Temperatures at the end of the step, minus the system's reference, shape (n,), [K]
    group_heat_w: Vector  # Mean heat flow into the body for each entry of `HeatSystem.groups`, (g,), [W]
    range_k: tuple[float, float]  # Range of `HeatSystem.surroundings_k` at start and end of the step, [K]
    iterations: int  # Iterations of the linear solver in all stages
    newton_iterations: int  # Steps of Newton's method in all stages; 0 without radiation
    unbalanced_w: float  # Sum over the stages of `ImplicitSolution.unbalanced_w`, [W]
    error_k: float  # Estimated largest error of the step, [K]; NaN if no estimate was asked for


class RungeKutta:
    """Solver of single time steps of any length with a scheme; it keeps the matrix of the last length."""

    def __init__(self, system: HeatSystem, scheme: Scheme, relative_tolerance: float) -> None:
        self.system, self._scheme, self._relative_tolerance = system, scheme, relative_tolerance
        self._kept: tuple[float, float, ImplicitEquation] | None = None

    def step(
        self, start_k: Vector, time_s: float, step_s: float, *, estimate: bool = False, found_k: Vector | None = None
    ) -> Step:
        """Return a step of length `step_s` from `start_k`, (n,), [K], minus the reference, at time `time_s`.

        The error is estimated if `estimate` is True. `found_k` (n,) are the temperatures at the end of a step of
        backward Euler if they were found elsewhere. Raises `HeatError` if a stage does not converge.
        """
        system, scheme, nothing_w = self.system, self._scheme, np.zeros(self.system.num_nodes)
        states, inner_w, solutions = list[Vector](), list[Vector](), []
        for row, node, implicit in zip(scheme.weights, scheme.nodes, np.diag(scheme.weights)):
            now_s = time_s + node * step_s
            given_w = sum((weight / implicit * flow_w for weight, flow_w in zip(row, inner_w)), nothing_w)
            solution = self._equation(now_s, implicit * step_s).solve(start_k, now_s, given_w, found_k)
            if not solution.converged:
                remedy = "Use shorter steps or check the mesh's quality."
                raise HeatError(f"The step from {time_s:.6g} s failed. {solution.status} {remedy}")
            solutions.append(solution)
            states.append(solution.relative_k)
            inner_w.append(system.nodal_mass_j_k * solution.change_k / (implicit * step_s) - given_w)
        (low, high), (then_low, then_high) = map(system.surroundings_k, (time_s, time_s + step_s))
        return Step(
            relative_k=states[-1],
            group_heat_w=self._heat(start_k, states, time_s, step_s),
            range_k=(min(low, then_low), max(high, then_high)),
            iterations=sum(one.iterations for one in solutions),
            newton_iterations=sum(one.newton_iterations for one in solutions),
            unbalanced_w=sum(one.unbalanced_w for one in solutions),
            error_k=self._error(start_k, inner_w, time_s, step_s) if estimate else math.nan,
        )

    def _heat(self, start_k: Vector, states: list[Vector], time_s: float, step_s: float) -> Vector:
        """Return the mean heat flow in a step of each of `HeatSystem.groups`, (g,), [W], from the stages' `states`. The
        heat of fixed nodes is what balances their storage and all other flows."""
        system, scheme, fixed = self.system, self._scheme, self.system.fixed
        kept_w = (system.nodal_mass_j_k * (states[-1] - start_k))[fixed.nodes] / step_s
        parts_w: Vector | float = 0.0
        for weight, node, state in zip(scheme.weights[-1], scheme.nodes, states):
            parts_w = parts_w + weight * system.part_heat_w(state, time_s + node * step_s)
            kept_w -= weight * system.net_heat_at_fixed(state, time_s + node * step_s)
        return system.by_group(np.concatenate([parts_w, fixed.facet_shares @ kept_w]))

    def _error(self, start_k: Vector, inner_w: list[Vector], time_s: float, step_s: float) -> float:
        """Return the estimated largest error of a step, [K]: its difference to the scheme `Scheme.estimate`. `inner_w`
        are the net heat flows into the nodes in each stage, (n,) each, [W]."""
        system, scheme = self.system, self._scheme
        assert scheme.estimate is not None
        implicit = scheme.weights[-1][-1]
        more = [float(part) / implicit for part in np.array(scheme.estimate) - np.array([0.0, *scheme.weights[-1]])]
        start_w = more[0] * system.exchanged_heat(start_k, time_s)
        exchange_w = sum((part * flow_w for part, flow_w in zip(more[1:], inner_w)), start_w)
        difference_w = exchange_w - more[0] * system.conducted_heat(start_k)
        end_s = time_s + scheme.nodes[-1] * step_s
        equation = self._equation(end_s, implicit * step_s)
        error_k, _ = equation.correction(difference_w, float(np.sum(exchange_w)), start_k, end_s, _ESTIMATE_TOLERANCE)
        return float(np.max(np.abs(error_k)))

    def _equation(self, time_s: float, step_s: float) -> ImplicitEquation:
        time_s = time_s if self.system.matrix_in_time else 0.0
        # Lengths computed as differences of times differ in the last digits.
        if self._kept and self._kept[0] == time_s and math.isclose(self._kept[1], step_s, rel_tol=_SAME_LENGTH):
            return self._kept[2]
        equation = ImplicitEquation(self.system, time_s, step_s, relative_tolerance=self._relative_tolerance)
        self._kept = time_s, step_s, equation
        return equation


def solve_heat(
    problem: HeatProblem,
    time: TimeSteps | AdaptiveSteps | FloatArray,
    *,
    scheme: Scheme = BACKWARD_EULER,
    relative_tolerance: float = 1e-12,
    estimate_steps: bool = False,
    progress: Progress | None = None,
    engine: Engine | None = None,
) -> HeatSolution:
    """Return the temperatures of a body through time, and the heat that each effect brings.

    Masses are lumped. With backward Euler and tetrahedra without obtuse angles, only a flux or source can drive a
    temperature out of the range of the start and of the surroundings, at any step length. If a temperature leaves this
    range without such a cause, the status says by how much.

    Args:
        problem: Body, materials, initial temperatures and effects; without effects the boundary is insulated.
        time: Equal steps, adaptive steps, or the lengths of the steps, shape (k,), [s].
        scheme: The scheme of equal or given steps. Adaptive steps always use SDIRK2.
        relative_tolerance: Relative tolerance of the linear solver in each step.
        estimate_steps: Also estimate the error of equal steps (`time_error_k`) by a solution with steps twice as long,
            which takes half as long again. Adaptive steps always have an estimate, given steps never.
        progress: Called after every step with the share of the duration that is done and the number of steps.
        engine: Function that finds the temperatures of equal or given steps of backward Euler; None: our own solver.

    Raises:
        HeatError: An effect does not fit the mesh, a material's heat capacity is below `LEAST_CAPACITY_J_M3K`, a step's
            solver does not converge, or the temperature falls below absolute zero.
    """
    if engine is not None and (isinstance(time, AdaptiveSteps) or scheme is not BACKWARD_EULER):
        remedy = "Leave out --engine, or give the scene time: {steps, step_seconds}."
        raise HeatError("engine", expected="equal steps of backward Euler", got="other steps", remedy=remedy)
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
        lengths_s = time if isinstance(time, np.ndarray) else np.full(time.steps, time.step_seconds)
        kutta = RungeKutta(balance.system, scheme, relative_tolerance)
        found = None if engine is None else engine(balance.system, times_s)
        steps = _given_steps(balance, kutta, lengths_s, found)
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
            doubled = solve_heat(problem, twice_s, scheme=scheme, relative_tolerance=relative_tolerance, engine=engine)
            apart_k = np.abs(found.temperature_c[: 2 * doubled.steps + 1 : 2] - doubled.temperature_c).max(axis=1)
            most_k, last_k = (float(part) / (2.0**scheme.order - 1.0) for part in (apart_k.max(), apart_k[-1]))
            said = f" The steps make an error of about {most_k:.2g} K at most and {last_k:.2g} K at the end (from steps"
            return replace(found, status=f"{found.status}{said} of twice the length).", time_error_k=most_k)
    why = "steps of twice the length fail" if found.steps > 1 else "it takes two of them"
    return replace(found, status=f"{found.status} The error of the steps is not estimated: {why}.")


def _given_steps(
    balance: HeatBalance, kutta: RungeKutta, lengths_s: Vector, found_k: FloatArray | None = None
) -> Iterator[float]:
    """Add steps of given lengths, [s], to `balance`, and yield the time, [s], at the end of each step.

    `found_k` (s, n) are the temperatures at the ends if they were found elsewhere. Raises `HeatError` if a step's
    solver does not converge.
    """
    relative_k = balance.start_k
    for number, (now_s, step_s) in enumerate(zip(balance.times_s.tolist(), lengths_s.tolist())):
        step = kutta.step(relative_k, now_s, step_s, found_k=None if found_k is None else found_k[number])
        balance.add(step, step_s, ends_interval=True)
        relative_k = step.relative_k
        yield now_s + step_s


def _adaptive_steps(balance: HeatBalance, time: AdaptiveSteps, relative_tolerance: float) -> Iterator[float]:
    """Add adaptive steps to `balance`, and yield the time, [s], at the end of each step.

    Estimated errors and `HeatProblem.resolution_s` limit the lengths. A step that fails is repeated with a shorter
    length and counted in `balance.repeated`. Raises `HeatError` if no length succeeds.
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
            step_s = min(wished_s, system.problem.resolution_s)
            # All that is left of the interval, or at most half of it: no tiny step ends an interval.
            step_s = left_s if step_s >= left_s else min(step_s, 0.5 * left_s)
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
    """The record of a computation: temperatures at the ends of intervals, and the heat that flowed in between."""

    def __init__(self, system: HeatSystem, times_s: Vector) -> None:
        """Start an empty record; `times_s`, (s + 1,), [s], ascending from 0, are the ends of the s intervals."""
        self.system, self.times_s = system, times_s
        self._states = np.empty((len(times_s), system.num_nodes))
        self._states[0] = system.start_k
        if len(system.fixed.nodes):
            self._states[0, system.fixed.nodes] = system.fixed.temperature_k(0.0)
        self._done = 0
        self.steps = 0  # Number of steps that were added so far
        self.repeated = 0  # Number of steps that failed and were repeated with a shorter length
        self._heat_j = np.zeros((len(times_s) - 1, len(system.groups)))
        self._exchanged_j = 0.0
        self._iterations = np.zeros((len(times_s) - 1, 2), dtype=np.int64)
        self._range_k = float(self.start_k.min()), float(self.start_k.max())
        self._beyond_k = self._unbalanced_w = self._error_k = 0.0

    @property
    def start_k(self) -> Vector:
        """Initial temperatures minus the reference, (n,), [K]; fixed nodes have their fixed temperature."""
        return self._states[0]

    def add(self, step: Step, step_s: float, *, ends_interval: bool) -> None:
        """Add a step of length `step_s`, [s], to the record; keep its temperatures if `ends_interval` is True."""
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
        """Return the solution; the record's states become degrees Celsius in place, so nothing can be added after."""
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
            effects=system.heat_of_effects(heat_j / lengths[:, None]),
            newton_iterations=self._iterations[:, 1],
            steps=self.steps,
            time_error_k=self._error_k,
            unbalanced_w=self._unbalanced_w,
            facet_heat_w=facet_heat_w,
            overshoot_k=overshoot_k,
        )
