"""The error that linear tetrahedra make in time, as what an unknown in the middle of every edge would add."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.stage import Stage
from thermoxels_ns.fem.steady import heat_of_groups_w
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

_SOLVER_TOLERANCE = 1e-2
"""Relative tolerance of the linear solver: of an error, two digits are enough."""
_SHORT = 1e-4
"""Share of an interval over which the rate of a given temperature is measured."""
_EQUAL = 1e-9
"""Lengths of intervals that differ by a smaller share are one."""
_AT_ONCE = 200_000
"""Numbers that the states which are looked at together may have."""
_NONE = np.zeros(0)


@dataclass(frozen=True)
class Surplus:
    """What quadratic tetrahedra would add to a solution of linear ones: estimates of minus its error."""

    temperature_k: Vector
    """At the mesh's nodes, one row per time, shape (s, n), [K]."""
    group_heat_w: Vector
    """To the heat flow into the body of each effect and patch or region, shape (s, g), [W]."""
    groups: tuple[tuple[str, str], ...]
    """Effect and patch or region of each column."""

    def by_effect(self, group_w: Vector) -> dict[str, float]:
        """Add up values of the columns, shape (g,), by effect."""
        total = dict.fromkeys((effect for effect, _ in self.groups), 0.0)
        for (effect, _), heat_w in zip(self.groups, group_w.tolist()):
            total[effect] += heat_w
        return total


def edge_surplus(problem: HeatProblem, solution: HeatSolution, *, system: HeatSystem | None = None) -> Surplus:
    """Estimate the error that the mesh makes at each of a solution's times.

    The error obeys the heat equation too. With what the temperatures leave unbalanced in the equations of quadratic
    tetrahedra as its source, it is followed from output to output by backward Euler; so few and long steps are enough
    for an estimate, and cost less than the solution. Heat flows are those at the ends of intervals: what rushes in
    when a surface is suddenly warmed is over by then, and most of its error is missed.

    Args:
        problem: What was solved.
        solution: From `solve_heat`.
        system: The equations that were solved, of linear tetrahedra; None: they are made here.

    Returns:
        The surplus at each time, 0 at the start: the mesh's own temperatures are what the body starts from.

    Raises:
        HeatError: The equations of the error could not be solved.
    """
    linear, quadratic = system or HeatSystem(problem), HeatSystem(problem, lumped=False, order=2)
    lengths_s = np.diff(solution.times_s)
    if not (quadratic.nonlinear or quadratic.matrix_in_time) and np.ptp(lengths_s) <= _EQUAL * lengths_s[0]:
        return _by_one_matrix(linear, quadratic, solution)
    return _by_rows(linear, quadratic, solution)


def _by_one_matrix(linear: HeatSystem, quadratic: HeatSystem, solution: HeatSolution) -> Surplus:
    """Solve linear equations, whose sources at several times are found together."""
    times_s, free_of = solution.times_s, quadratic.fixed.nodes
    step_s = float(times_s[1] - times_s[0])
    stage = Stage(quadratic, float(times_s[1]), step_s, relative_tolerance=_SOLVER_TOLERANCE)
    width = max(_AT_ONCE // quadratic.num_nodes, 1)
    error_k = held_w = np.zeros(quadratic.num_nodes)
    added_k, added_w = [np.zeros((1, linear.num_nodes))], [np.zeros((1, len(linear.groups)))]
    for begin in range(1, len(times_s), width):
        now_s = times_s[begin : begin + width].tolist()
        states_k = solution.temperature_c[begin : begin + width].T - linear.reference_c
        net_w = _net_heat(linear, states_k, now_s)
        rates_k_s = _rates(linear, net_w, now_s, step_s)
        start_k = quadratic.space.from_mesh_nodes(states_k)
        kept_w = _stored(quadratic, quadratic.space.from_mesh_nodes(rates_k_s))
        given_k = np.zeros_like(start_k)
        if len(free_of):
            given_k[free_of] = _fixed(quadratic, now_s) - start_k[free_of]
        sources_w = _net_heat(quadratic, start_k + given_k, now_s) - kept_w
        if given_k.any():
            sources_w -= _stored(quadratic, given_k) / step_s
        errors_k, more_w = np.empty((len(now_s), len(error_k))), np.empty((len(now_s), len(error_k)))
        for column in range(len(now_s)):
            heat_w = sources_w[:, column] + held_w
            sums_w = np.where(stage.floating, quadratic.pieces.sums(heat_w), 0.0) if stage.floats else _NONE
            found_k, outcome = stage.balance(heat_w, sums_w)
            if not outcome.converged:
                raise HeatError(_explain(outcome.status))
            error_k = errors_k[column] = given_k[:, column] + found_k
            before_w, held_w = held_w, quadratic.mass_product(error_k) / step_s
            more_w[column] = held_w - before_w
        full_k, stored_w = start_k + errors_k.T, kept_w + more_w.T
        flows_w = _heat_of_groups(quadratic, full_k, now_s, stored_w - _net_heat(quadratic, full_k, now_s))
        added_w.append(flows_w - _heat_of_groups(linear, states_k, now_s, _stored(linear, rates_k_s) - net_w))
        added_k.append(errors_k[:, : linear.num_nodes])
    return Surplus(np.concatenate(added_k), np.concatenate(added_w), linear.groups)


def _net_heat(system: HeatSystem, states_k: Vector, times_s: list[float]) -> Vector:
    """As `HeatSystem.net_heat` without radiation, of one state per column, shape (n, s), [W]."""
    heat_w = -(system.stiffness @ states_k)
    if system.exchanges:
        heat_w += np.stack([system.load(time_s) for time_s in times_s], axis=1)
        exchange = system.exchange_matrix(0.0)
        if exchange is not None:
            heat_w -= exchange @ states_k
    return heat_w


def _stored(system: HeatSystem, states_k: Vector) -> Vector:
    """As `HeatSystem.mass_product`, of one state per column, shape (n, s), [J]."""
    matrix = system.mass_matrix
    return system.nodal_mass_j_k[:, None] * states_k if matrix is None else matrix @ states_k


def _rates(system: HeatSystem, net_w: Vector, times_s: list[float], step_s: float) -> Vector:
    """As `_rate`, of one state per column, from `_net_heat`, shape (n, s), [K / s]."""
    rates_k_s = net_w / system.nodal_mass_j_k[:, None]
    if len(system.fixed.nodes):
        earlier_s = [time_s - _SHORT * step_s for time_s in times_s]
        change_k = _fixed(system, times_s) - _fixed(system, earlier_s) if system.fixed.in_time else 0.0
        rates_k_s[system.fixed.nodes] = change_k / (_SHORT * step_s)
    return rates_k_s


def _fixed(system: HeatSystem, times_s: list[float]) -> Vector:
    """Given temperatures, shape (d, s), [K]."""
    return np.stack([system.fixed.temperature_k(time_s) for time_s in times_s], axis=1)


def _heat_of_groups(system: HeatSystem, states_k: Vector, times_s: list[float], kept_w: Vector) -> Vector:
    """As `heat_of_groups_w`, of one state per column, shape (s, g), [W]; what is kept is stored less `_net_heat`."""
    flows_w = np.zeros((len(times_s), len(system.groups)))
    given = len(system.groups) - len(system.fixed.groups)
    if given:
        for row, time_s in enumerate(times_s):
            flows_w[row, :given] = system.group_heat_w(states_k[:, row], time_s)
    if len(system.fixed.nodes):
        flows_w[:, given:] = (system.fixed.shares @ kept_w[system.fixed.nodes]).T
    return flows_w


def _by_rows(linear: HeatSystem, quadratic: HeatSystem, solution: HeatSolution) -> Surplus:
    """Solve one time after the other, each with its own matrix where that changes."""
    times_s, num_mesh_nodes = solution.times_s, linear.num_nodes
    added_k, added_w = np.zeros((len(times_s), num_mesh_nodes)), np.zeros((len(times_s), len(linear.groups)))
    error_k, stage = np.zeros(quadratic.num_nodes), None
    for row, (time_s, step_s) in enumerate(zip(times_s[1:].tolist(), np.diff(times_s).tolist()), start=1):
        if stage is None or quadratic.matrix_in_time or abs(stage.step_s - step_s) > _EQUAL * step_s:
            stage = Stage(quadratic, time_s, step_s, relative_tolerance=_SOLVER_TOLERANCE)
        relative_k = solution.temperature_c[row] - linear.reference_c
        begin_k = quadratic.space.from_mesh_nodes(relative_k)
        rate_k_s = _rate(linear, relative_k, time_s, step_s)
        # M (rate + d error / dt) = net heat of P2 at the temperature and its error together.
        kept_w = quadratic.mass_product(quadratic.space.from_mesh_nodes(rate_k_s) - error_k / step_s)
        found = (_solved if quadratic.nonlinear else _balanced)(stage, begin_k, time_s, kept_w)
        if found.status:
            raise HeatError(_explain(found.status))
        error_k = found.error_k
        added_k[row] = error_k[:num_mesh_nodes]
        stored_w = kept_w + quadratic.mass_product(error_k) / step_s
        before_w = heat_of_groups_w(linear, relative_k, time_s, linear.mass_product(rate_k_s))
        added_w[row] = heat_of_groups_w(quadratic, begin_k + error_k, time_s, stored_w) - before_w
    return Surplus(added_k, added_w, linear.groups)


def _explain(status: str) -> str:
    return f"The error of the mesh could not be estimated. {status} Check the mesh's quality."


@dataclass(frozen=True)
class _Found:
    """A solution of the equations of the error."""

    error_k: Vector
    """Minus the error, shape (n,), [K]."""
    status: str
    """Why it is none, or nothing."""


def _solved(stage: Stage, begin_k: Vector, time_s: float, kept_w: Vector) -> _Found:
    """Solve by Newton's method."""
    found = stage.solve(begin_k, time_s, -kept_w, -stage.system.pieces.sums(kept_w))
    return _Found(found.relative_k - begin_k, "" if found.converged else found.status)


def _balanced(stage: Stage, begin_k: Vector, time_s: float, kept_w: Vector) -> _Found:
    """Solve linear equations: at once, and no better than an estimate asks for."""
    system, error_k = stage.system, np.zeros_like(begin_k)
    fixed = system.fixed.nodes
    heat_w = -kept_w
    if len(fixed):
        error_k[fixed] = system.fixed.temperature_k(time_s) - begin_k[fixed]
        if error_k.any():
            heat_w -= system.mass_product(error_k) / stage.step_s
    heat_w += system.net_heat(begin_k + error_k, time_s)[0]
    found_k, linear = stage.balance(heat_w, np.where(stage.floating, system.pieces.sums(heat_w), 0.0))
    return _Found(error_k + found_k, "" if linear.converged else linear.status)


def _rate(system: HeatSystem, relative_k: Vector, time_s: float, step_s: float) -> Vector:
    """How fast temperatures change, [K / s]."""
    rate = system.net_heat(relative_k, time_s)[0] / system.nodal_mass_j_k
    if len(system.fixed.nodes):
        earlier_s = time_s - _SHORT * step_s
        change_k = system.fixed.temperature_k(time_s) - system.fixed.temperature_k(earlier_s)
        rate[system.fixed.nodes] = change_k / (time_s - earlier_s)
    return rate
