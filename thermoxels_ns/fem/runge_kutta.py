"""Diagonally implicit Runge-Kutta schemes, and one time step of such a scheme with the heat that flows in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.fem.implicit_equation import ImplicitEquation
from thermoxels_ns.fem.system import HeatSystem

Vector = FloatArray

_KEPT_EQUATIONS = 2  # Implicit equations, one for each length of a stage, whose matrices are kept
_SAME_LENGTH = 1e-12  # Relative difference up to which two lengths are one


@dataclass(frozen=True)
class Scheme:
    """Coefficients of a scheme.

    A scheme is its table of coefficients (Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.6).
    Each stage i solves M (T_i - T_n) = dt * sum_j a_ij F(T_j), F being the net heat flow into the nodes, and M (T_n+1 -
    T_n) = dt * sum_j b_j F(T_j): the heat that flows in during a step is the sum of the stages' flows, so the balance
    of heat closes whatever the step length.
    """

    name: str
    order: int  # Order of the error at the end as a power of the step length
    nodes: tuple[float, ...]  # c: time of each stage as a share of the step
    weights: tuple[tuple[float, ...], ...]
    """a: lower triangle, one row per stage; the last row is b. A stage whose row is all 0 is the start."""
    estimate: tuple[float, ...] | None = None
    """Weights of the heat flows at the start and of all stages in a scheme one order higher; None: no estimate."""

    @property
    def ends(self) -> tuple[float, ...]:
        """b: weights of the stages' heat flows in the whole step."""
        return self.weights[-1]


def _sdirk2() -> Scheme:
    """Alexander's two-stage scheme (SIAM Journal on Numerical Analysis 14, 1977), gamma = 1 - 1 / sqrt(2), L-stable.

    The estimate adds the flow at the start and meets the conditions of third order for constant loads.
    """
    gamma = 1.0 - 1.0 / math.sqrt(2.0)
    second = (1.0 - gamma) * gamma + gamma
    first_weight = (1.0 / 6.0 - 0.5 * second) / (gamma * gamma - gamma * second)
    second_weight = 0.5 - gamma * first_weight
    estimate = (1.0 - first_weight - second_weight, first_weight, second_weight)
    return Scheme("SDIRK2", 2, (gamma, 1.0), ((gamma, 0.0), (1.0 - gamma, gamma)), estimate)


BACKWARD_EULER = Scheme("backward Euler", 1, (1.0,), ((1.0,),))
"""First order. With lumped masses and non-obtuse tetrahedra no temperature ever leaves the range of what it came from
and of what surrounds it, however long the step."""
CRANK_NICOLSON = Scheme("Crank-Nicolson", 2, (0.0, 1.0), ((0.0, 0.0), (0.5, 0.5)))
"""Second order, but it does not damp: after a jump, long steps overshoot by up to the jump itself. No command uses it:
it is the reference that the published NAFEMS benchmark T3 is compared with."""
SDIRK2 = _sdirk2()
"""Second order and L-stable: it damps what a step is too long to follow. Very long steps may overshoot by 1 or 2 % of a
jump."""


@dataclass(frozen=True)
class Step:
    """The outcome of a step; converged: all stages were solved; the status is a sentence."""

    relative_k: Vector  # Temperatures at its end, relative to the system's reference, shape (n,), [K]
    group_heat_w: Vector  # Mean heat flow into the body of each group of the system, shape (g,), [W]
    iterations: int
    newton_iterations: int
    error_k: float
    """Estimated largest error that the step made, [K]; NaN if the scheme has no estimate or none was asked for."""
    converged: bool
    status: str
    unbalanced_w: float = 0.0  # Heat that is unbalanced at all nodes in its stages, [W]


class RungeKutta:
    """Takes steps of any length; matrices and preconditioners of the lengths used last are kept."""

    def __init__(self, system: HeatSystem, scheme: Scheme, *, relative_tolerance: float) -> None:
        self.scheme, self._system, self._relative_tolerance = scheme, system, relative_tolerance
        self._equations: dict[tuple[float, float], ImplicitEquation] = {}

    def step(self, start_k: Vector, time_s: float, step_s: float, *, estimate: bool = False) -> Step:
        """Take one step from `start_k`, shape (n,), [K], relative to the reference; estimate its error if asked."""
        system, scheme = self._system, self.scheme
        states: list[Vector] = []
        inner_w: list[Vector] = []
        iterations = newton_iterations = 0
        unbalanced_w, status = 0.0, ""
        for number, (row, node) in enumerate(zip(scheme.weights, scheme.nodes)):
            now_s, implicit = time_s + node * step_s, row[number]
            if implicit == 0.0:
                states.append(start_k)
                inner_w.append(system.net_heat(start_k, now_s))
                continue
            given_w = _weighted([weight / implicit for weight in row[:number]], inner_w)
            solution = self._equation(now_s, implicit * step_s).solve(start_k, now_s, given_w)
            iterations += solution.iterations
            newton_iterations += solution.newton_iterations
            unbalanced_w += solution.unbalanced_w
            status = solution.status
            states.append(solution.relative_k)
            if not solution.converged:
                unknown = np.full(len(system.groups), np.nan)
                return Step(solution.relative_k, unknown, iterations, newton_iterations, np.nan, False, status)
            if estimate or number + 1 < len(scheme.nodes):
                stored_w = system.nodal_mass_j_k * solution.change_k / (implicit * step_s)
                inner_w.append(stored_w if given_w is None else stored_w - given_w)
        heat_w = self._heat(start_k, states, time_s, step_s)
        error_k = self._error(start_k, inner_w, time_s, step_s) if estimate and scheme.estimate else np.nan
        return Step(states[-1], heat_w, iterations, newton_iterations, error_k, True, status, unbalanced_w)

    def _heat(self, start_k: Vector, states: list[Vector], time_s: float, step_s: float) -> Vector:
        """Mean heat flow of each group: the stages' flows, and what the balance of the fixed nodes leaves."""
        system, scheme = self._system, self.scheme
        if not system.groups:
            return np.zeros(0)
        flows, fixed = np.zeros(len(system.groups) - len(system.fixed.groups)), system.fixed
        kept_w = (system.nodal_mass_j_k * (states[-1] - start_k))[fixed.nodes] / step_s
        for weight, node, state in zip(scheme.ends, scheme.nodes, states):
            if weight != 0.0:
                flows += weight * system.group_heat_w(state, time_s + node * step_s)
                kept_w -= weight * system.net_heat_at_fixed(state, time_s + node * step_s)
        return np.concatenate([flows, fixed.shares @ kept_w])

    def _error(self, start_k: Vector, inner_w: list[Vector], time_s: float, step_s: float) -> float:
        """Largest error by the scheme of the next order; sums over pieces come from what they exchange."""
        system, scheme = self._system, self.scheme
        assert scheme.estimate is not None
        implicit = scheme.weights[-1][-1]
        more = [float(part) / implicit for part in np.array(scheme.estimate) - np.array([0.0, *scheme.ends])]
        exchanged_w = system.exchanged_heat(start_k, time_s)
        exchange_w = _weighted(more, [exchanged_w, *inner_w])
        assert exchange_w is not None
        difference_w = exchange_w - more[0] * system.conducted_heat(start_k)
        end_s = time_s + scheme.nodes[-1] * step_s
        equation = self._equation(end_s, implicit * step_s)
        error = equation.damped(difference_w, system.pieces.sums(exchange_w), start_k, end_s)
        return float(np.max(np.abs(error)))

    def _equation(self, time_s: float, step_s: float) -> ImplicitEquation:
        time_s = time_s if self._system.matrix_in_time else 0.0
        # Lengths that are differences of times differ in the last digits.
        alike = (
            key for key in self._equations if key[0] == time_s and math.isclose(key[1], step_s, rel_tol=_SAME_LENGTH)
        )
        key = next(alike, (time_s, step_s))
        equation = self._equations.pop(key, None)
        if equation is None:
            equation = ImplicitEquation(self._system, time_s, step_s, relative_tolerance=self._relative_tolerance)
        self._equations[key] = equation
        while len(self._equations) > _KEPT_EQUATIONS:
            del self._equations[next(iter(self._equations))]
        return equation


def _weighted(weights: list[float], vectors: list[Vector]) -> Vector | None:
    """Weighted sum, None of nothing."""
    total: Vector | None = None
    for weight, vector in zip(weights, vectors):
        total = weight * vector if total is None else total + weight * vector
    return total
