"""Schemes in time: diagonally implicit Runge-Kutta methods."""

from __future__ import annotations

import math
from dataclasses import dataclass

from thermoxels_ns.core.errors import HeatError


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


def theta_scheme(theta: float) -> Scheme:
    """Make the theta method, theta from 0.5 (Crank-Nicolson) to 1 (backward Euler); below, it is unstable: `HeatError`.

    >>> theta_scheme(0.5).ends
    (0.5, 0.5)
    """
    if not 0.5 <= theta <= 1.0:
        remedy = "Use 1 for backward Euler or 0.5 for Crank-Nicolson."
        raise HeatError("theta", expected="a number from 0.5 to 1", got=repr(theta), remedy=remedy)
    if theta == 1.0:
        return BACKWARD_EULER
    order = 2 if theta == 0.5 else 1
    name = "Crank-Nicolson" if theta == 0.5 else f"theta = {theta:g}"
    return Scheme(name, order, (0.0, 1.0), ((0.0, 0.0), (1.0 - theta, theta)))


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
CRANK_NICOLSON = theta_scheme(0.5)
"""Second order, but it does not damp: after a jump, long steps overshoot by up to the jump itself. No command uses it:
it is the reference that the published NAFEMS benchmark T3 is compared with."""
SDIRK2 = _sdirk2()
"""Second order and L-stable: it damps what a step is too long to follow. Very long steps may overshoot by 1 or 2 % of a
jump."""
