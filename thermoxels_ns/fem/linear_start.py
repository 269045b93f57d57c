"""A steady state of linear tetrahedra together with its equations, which serve the estimate of its error too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.fem.error_budget import ErrorSize, flow_error
from thermoxels_ns.fem.hierarchical_error import steady_surplus
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import SteadySolution
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem


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
    solution = solve_steady(problem, time_s=time_s, relative_tolerance=relative_tolerance, system=system)
    surplus = steady_surplus(system, solution.temperature_c - system.reference_c, time_s)
    change_w = surplus.by_effect(surplus.group_heat_w[0])
    return LinearStart(
        solution, ErrorSize(float(np.max(np.abs(surplus.temperature_k))), flow_error(change_w, solution))
    )
