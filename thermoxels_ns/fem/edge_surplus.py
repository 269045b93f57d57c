"""The error that linear tetrahedra make in time, as what an unknown in the middle of every edge would add."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.errors import HeatError
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
    times_s, num_mesh_nodes = solution.times_s, linear.num_nodes
    added_k, added_w = np.zeros((len(times_s), num_mesh_nodes)), np.zeros((len(times_s), len(linear.groups)))
    error_k, stage = np.zeros(quadratic.num_nodes), None
    for row, (time_s, step_s) in enumerate(zip(times_s[1:].tolist(), np.diff(times_s).tolist()), start=1):
        if stage is None or quadratic.matrix_in_time or abs(stage.step_s - step_s) > 1e-9 * step_s:
            stage = Stage(quadratic, time_s, step_s, relative_tolerance=_SOLVER_TOLERANCE)
        relative_k = solution.temperature_c[row] - linear.reference_c
        begin_k = quadratic.space.from_mesh_nodes(relative_k)
        rate_k_s = _rate(linear, relative_k, time_s, step_s)
        # M (rate + d error / dt) = net heat of P2 at the temperature and its error together.
        kept_w = quadratic.mass_product(quadratic.space.from_mesh_nodes(rate_k_s) - error_k / step_s)
        found = (_solved if quadratic.nonlinear else _balanced)(stage, begin_k, time_s, kept_w)
        if found.status:
            raise HeatError(f"The error of the mesh could not be estimated. {found.status} Check the mesh's quality.")
        error_k = found.error_k
        added_k[row] = error_k[:num_mesh_nodes]
        stored_w = kept_w + quadratic.mass_product(error_k) / step_s
        before_w = heat_of_groups_w(linear, relative_k, time_s, linear.mass_product(rate_k_s))
        added_w[row] = heat_of_groups_w(quadratic, begin_k + error_k, time_s, stored_w) - before_w
    return Surplus(added_k, added_w, linear.groups)


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
