"""Diagonally implicit Runge-Kutta schemes, and one time step of such a scheme with the heat that flows in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.implicit_equation import ImplicitEquation
from thermoxels_ns.fem.system import HeatSystem

Vector = FloatArray

_ESTIMATE_TOLERANCE = 1e-3  # Relative tolerance of the linear solver for error estimates
_SAME_LENGTH = 1e-12  # Relative difference up to which two lengths of a stage count as equal


@dataclass(frozen=True)
class Scheme:
    """A diagonally implicit Runge-Kutta scheme, given by its coefficients a, b and c.

    Notation is that of Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.6. Each stage i solves
    M (T_i - T_n) = dt * sum_j a_ij F(T_j), F being the net heat flow into the nodes; the step ends with M (T_n+1 - T_n)
    = dt * sum_j b_j F(T_j). So the heat stored in a step is the weighted sum of the stages' flows, and the balance of
    heat closes at any step length.
    """

    name: str  # Name of the scheme
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
    range_k: tuple[float, float]  # Range of the surroundings, relative to the reference, see `surroundings_k`, [K]
    iterations: int  # Iterations of the linear solver in all stages
    newton_iterations: int  # Steps of Newton's method in all stages; 0 without radiation
    unbalanced_w: float  # Sum of the heat left unbalanced in the stages, [W]
    error_k: float  # Estimated largest error that the step made, [K]; NaN if none was asked for


class RungeKutta:
    """Takes single steps of any length with a scheme; the matrix of the last used length is kept."""

    def __init__(self, system: HeatSystem, scheme: Scheme, relative_tolerance: float) -> None:
        self.system, self._scheme, self._relative_tolerance = system, scheme, relative_tolerance
        self._kept: tuple[float, float, ImplicitEquation] | None = None

    def step(self, start_k: Vector, time_s: float, step_s: float, *, estimate: bool = False) -> Step:
        """Take one step from `start_k`, (n,), [K], relative to the reference; `HeatError` if a stage is not solved."""
        system, scheme, nothing_w = self.system, self._scheme, np.zeros(self.system.num_nodes)
        states, inner_w, solutions = list[Vector](), list[Vector](), []
        for row, node, implicit in zip(scheme.weights, scheme.nodes, np.diag(scheme.weights)):
            now_s = time_s + node * step_s
            given_w = sum((weight / implicit * flow_w for weight, flow_w in zip(row, inner_w)), nothing_w)
            solution = self._equation(now_s, implicit * step_s).solve(start_k, now_s, given_w)
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
        """Return each group's mean heat flow, [W]; fixed nodes get the heat that balances storage and other flows."""
        system, scheme, fixed = self.system, self._scheme, self.system.fixed
        if not system.groups:
            return np.zeros(0)
        kept_w = (system.nodal_mass_j_k * (states[-1] - start_k))[fixed.nodes] / step_s
        parts_w: Vector | float = 0.0
        for weight, node, state in zip(scheme.weights[-1], scheme.nodes, states):
            parts_w = parts_w + weight * system.part_heat_w(state, time_s + node * step_s)
            kept_w -= weight * system.net_heat_at_fixed(state, time_s + node * step_s)
        return system.by_group(np.concatenate([parts_w, fixed.facet_shares @ kept_w]))

    def _error(self, start_k: Vector, inner_w: list[Vector], time_s: float, step_s: float) -> float:
        """Return the largest error, [K], from the scheme of the next order; the sum leaves conduction out."""
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
