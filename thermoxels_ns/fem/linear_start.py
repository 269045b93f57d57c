"""A steady state of linear tetrahedra together with its equations, which serve the estimate of its error too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.fem.error_budget import ErrorSize, flow_error
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import SteadySolution, heat_by_effect
from thermoxels_ns.fem.stage import Stage
from thermoxels_ns.fem.steady import heat_of_groups_w, solve_steady, too_cold
from thermoxels_ns.fem.steady_surplus import steady_surplus
from thermoxels_ns.fem.system import HeatSystem, effect_labels


@dataclass(frozen=True)
class LinearStart:
    """A steady state and its error."""

    solution: SteadySolution
    """The steady state of linear tetrahedra."""
    error: ErrorSize
    """What the mesh is estimated to err by."""


def linear_start(problem: HeatProblem, *, time_s: float, relative_tolerance: float) -> LinearStart:
    """Solve with linear tetrahedra and estimate the error, with one assembly for both.

    Args:
        problem: Body, materials and effects.
        time_s: Time at which effects that change are taken, [s].
        relative_tolerance: Of the linear solver.

    Raises:
        HeatError: As `solve_steady`, or the estimate fails.
    """
    system = HeatSystem(problem)
    solution = _solved(system, time_s, relative_tolerance)
    surplus = steady_surplus(system, solution.temperature_c - system.reference_c, time_s)
    change_w = dict.fromkeys((effect for effect, _ in surplus.groups), 0.0)
    for (effect, _), heat_w in zip(surplus.groups, surplus.group_heat_w[0].tolist()):
        change_w[effect] += heat_w
    return LinearStart(
        solution, ErrorSize(float(np.max(np.abs(surplus.temperature_k))), flow_error(change_w, solution))
    )


def _solved(system: HeatSystem, time_s: float, relative_tolerance: float) -> SteadySolution:
    """Do what `solve_steady` does on a system that is there already; it explains what cannot be solved."""
    held = bool(system.exchanging_pieces(time_s).all())
    stage = Stage(system, time_s, np.inf, relative_tolerance=relative_tolerance) if held else None
    found = None if stage is None else stage.solve(system.start_k, time_s)
    if found is None or not found.converged or too_cold(system, found.relative_k):
        return solve_steady(system.problem, time_s=time_s, relative_tolerance=relative_tolerance)
    group_heat = heat_of_groups_w(system, found.relative_k, time_s)
    size = float(np.abs(group_heat).sum())
    return SteadySolution(
        temperature_c=found.relative_k + system.reference_c,
        effects=heat_by_effect(effect_labels(system.problem), system.groups, group_heat[None]),
        energy_residual=abs(float(group_heat.sum())) / size if size > 0.0 else 0.0,
        status=f"The steady state was found. {found.status}",
        converged=True,
        iterations=found.iterations,
        newton_iterations=found.newton_iterations,
        assembled=system.assembled,
    )
