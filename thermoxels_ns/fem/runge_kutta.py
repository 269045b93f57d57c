"""Diagonally implicit Runge-Kutta schemes, and one time step of such a scheme with the heat that flows in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.fem.implicit_equation import ImplicitEquation
from thermoxels_ns.fem.system import HeatSystem

Vector = FloatArray

_KEPT_EQUATIONS = 2  # Number of implicit equations that are kept with their matrices, each for one length of a stage
_SAME_LENGTH = 1e-12  # Relative difference up to which two lengths of a stage count as equal


@dataclass(frozen=True)
class Scheme:
    """A diagonally implicit Runge-Kutta scheme, given by its coefficients a, b and c.

    Notation is that of Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.6. Each stage i solves
    M (T_i - T_n) = dt * sum_j a_ij F(T_j), F being the net heat flow into the nodes; the step ends with M (T_n+1 - T_n)
    = dt * sum_j b_j F(T_j). So the heat stored in a step is the weighted sum of the stages' flows, and the balance of
    heat closes at any step length.
    """

    name: str  # Name of the scheme, for messages
    order: int  # Order p: at a given time the error is proportional to the step length to the power p
    weights: tuple[tuple[float, ...], ...]
    """The lower triangular matrix a, a row per stage; its last row is b. Sums of rows are the times of the stages as
    shares of the step; all entries on the diagonal are equal, so that stages share a matrix."""
    estimate: tuple[float, ...] | None = None
    """Weights of a scheme one order higher for the flows at the start and in each stage; None: no error estimate."""

    @property
    def nodes(self) -> tuple[float, ...]:
        """c: time of each stage as a share of the step."""
        return tuple(map(math.fsum, self.weights))

    @property
    def ends(self) -> tuple[float, ...]:
        """b: weights of the stages' heat flows in the whole step."""
        return self.weights[-1]


def _sdirk2() -> Scheme:
    """Return Alexander's L-stable two-stage scheme (SIAM J. Numer. Anal. 14, 1977), gamma = 1 - 1 / sqrt(2).

    Its estimate also uses the flow at the start, and is of third order if loads are constant.
    """
    gamma = 1.0 - 1.0 / math.sqrt(2.0)
    second = (1.0 - gamma) * gamma + gamma
    first_weight = (1.0 / 6.0 - 0.5 * second) / (gamma * gamma - gamma * second)
    second_weight = 0.5 - gamma * first_weight
    estimate = (1.0 - first_weight - second_weight, first_weight, second_weight)
    return Scheme("SDIRK2", 2, ((gamma, 0.0), (1.0 - gamma, gamma)), estimate)


BACKWARD_EULER = Scheme("backward Euler", 1, ((1.0,),))
"""Scheme of first order. With lumped masses and non-obtuse tetrahedra no temperature leaves the range of the start and
of the surroundings, however long the step."""
SDIRK2 = _sdirk2()
"""Scheme of second order, L-stable: changes too fast for the step length are damped. Very long steps may overshoot by
1 or 2 % of a jump."""


@dataclass(frozen=True)
class Step:
    """The outcome of `RungeKutta.step`."""

    relative_k: Vector  # Temperatures at the end of the step, relative to the system's reference, shape (n,), [K]
    group_heat_w: Vector  # Mean heat flow into the body for each entry of `HeatSystem.groups`, (g,), [W]
    iterations: int  # Iterations of the linear solver in all stages
    newton_iterations: int  # Steps of Newton's method in all stages; 0 without radiation
    error_k: float
    """Estimated largest error that the step made, [K]; NaN if the scheme has no estimate or none was asked for."""
    converged: bool  # True if all stages were solved; if False, `relative_k` is useless and heat flows are NaN
    status: str  # Sentence on the solver in the last stage
    unbalanced_w: float = 0.0  # Sum of the heat left unbalanced in the stages, [W]


class RungeKutta:
    """Takes single steps of any length with a scheme; matrices of the last used lengths are kept."""

    def __init__(self, system: HeatSystem, scheme: Scheme, *, relative_tolerance: float) -> None:
        self.scheme, self.system, self._relative_tolerance = scheme, system, relative_tolerance
        self._equations: dict[tuple[float, float], ImplicitEquation] = {}

    def step(self, start_k: Vector, time_s: float, step_s: float, *, estimate: bool = False) -> Step:
        """Take one step from `start_k`, (n,), [K], relative to the reference; `Step.converged` tells if that worked."""
        system, scheme = self.system, self.scheme
        states, inner_w, nothing_w = list[Vector](), list[Vector](), np.zeros(system.num_nodes)
        iterations = newton_iterations = 0
        unbalanced_w, status = 0.0, ""
        for number, (row, node) in enumerate(zip(scheme.weights, scheme.nodes)):
            now_s, implicit = time_s + node * step_s, row[number]
            given_w = sum((weight / implicit * flow_w for weight, flow_w in zip(row, inner_w)), nothing_w)
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
                inner_w.append(stored_w - given_w)
        heat_w = self._heat(start_k, states, time_s, step_s)
        error_k = self._error(start_k, inner_w, time_s, step_s) if estimate and scheme.estimate else np.nan
        return Step(states[-1], heat_w, iterations, newton_iterations, error_k, True, status, unbalanced_w)

    def _heat(self, start_k: Vector, states: list[Vector], time_s: float, step_s: float) -> Vector:
        """Return each group's mean heat flow, [W]; fixed nodes get the heat that balances storage and other flows."""
        system, scheme, fixed = self.system, self.scheme, self.system.fixed
        if not system.groups:
            return np.zeros(0)
        kept_w = (system.nodal_mass_j_k * (states[-1] - start_k))[fixed.nodes] / step_s
        parts_w: Vector | float = 0.0
        for weight, node, state in zip(scheme.ends, scheme.nodes, states):
            parts_w = parts_w + weight * system.part_heat_w(state, time_s + node * step_s)
            kept_w -= weight * system.net_heat_at_fixed(state, time_s + node * step_s)
        return system.by_group(np.concatenate([parts_w, fixed.facet_shares @ kept_w]))

    def _error(self, start_k: Vector, inner_w: list[Vector], time_s: float, step_s: float) -> float:
        """Return the largest error, [K], from the scheme of the next order; sums over pieces leave conduction out."""
        system, scheme = self.system, self.scheme
        assert scheme.estimate is not None
        implicit = scheme.weights[-1][-1]
        more = [float(part) / implicit for part in np.array(scheme.estimate) - np.array([0.0, *scheme.ends])]
        exchanged_w = system.exchanged_heat(start_k, time_s)
        exchange_w = sum((part * flow_w for part, flow_w in zip(more[1:], inner_w)), more[0] * exchanged_w)
        difference_w = exchange_w - more[0] * system.conducted_heat(start_k)
        end_s = time_s + scheme.nodes[-1] * step_s
        equation = self._equation(end_s, implicit * step_s)
        error = equation.damped(difference_w, system.pieces.sums(exchange_w), start_k, end_s)
        return float(np.max(np.abs(error)))

    def _equation(self, time_s: float, step_s: float) -> ImplicitEquation:
        time_s = time_s if self.system.matrix_in_time else 0.0
        # Lengths computed as differences of times differ in the last digits.
        alike = (
            key for key in self._equations if key[0] == time_s and math.isclose(key[1], step_s, rel_tol=_SAME_LENGTH)
        )
        key = next(alike, (time_s, step_s))
        equation = self._equations.pop(key, None)
        if equation is None:
            equation = ImplicitEquation(self.system, time_s, step_s, relative_tolerance=self._relative_tolerance)
        self._equations[key] = equation
        while len(self._equations) > _KEPT_EQUATIONS:
            del self._equations[next(iter(self._equations))]
        return equation
