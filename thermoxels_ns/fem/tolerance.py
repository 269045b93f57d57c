"""From a tolerance to a solution that meets it, at least cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.error_budget import ErrorSize, Tolerance, difference_between
from thermoxels_ns.fem.error_estimate import ErrorRatios, error_ratios, recovered_error, richardson
from thermoxels_ns.fem.linear_start import linear_start
from thermoxels_ns.fem.memory import DEFAULT_MEMORY_BYTES
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.fem.solution import SteadySolution
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.tolerance_in_time import follow_to_tolerance
from thermoxels_ns.fem.tolerance_run import Level, Run, ToleratedSolution

__all__ = ["Level", "ToleratedSolution", "solve_to_tolerance"]

_LINEAR_TOLERANCE = 1e-8
"""Of the linear solver for a steady state: its error is far below any estimate here."""


def solve_to_tolerance(
    problem: HeatProblem,
    tolerance: Tolerance,
    *,
    duration_s: float | None = None,
    outputs: int = 10,
    time_s: float = 0.0,
    memory_bytes: float = DEFAULT_MEMORY_BYTES,
    allow_unmet: bool = False,
    log: Callable[[str], None] = print,
    progress: Callable[[float, int], None] | None = None,
) -> ToleratedSolution:
    """Solve a problem with the cheapest choice of order, mesh size and time steps whose estimated error is allowed.

    A steady state is solved with linear tetrahedra on the given mesh, and what bubbles on its edges would add tells
    their error. If it is too large quadratic tetrahedra follow; how the errors of the fluxes of both compare tells the
    error of the better one. Then the mesh size is halved, again and again: quadratic tetrahedra cost less than linear
    ones of half the size and err less.

    In time tetrahedra stay linear, since the mass of quadratic ones cannot be lumped. Steps are as long as their error
    allows, which is followed from each to the next. The surplus of quadratic tetrahedra tells the error of the given
    mesh, and the mesh is made as fine as the tolerance asks for; where neighbouring gradients differ so much that the
    given mesh is clearly too coarse, a finer one follows at once. How a finer mesh differs from the given one tells its
    error. Those of mesh and steps are added, node by node and with their signs. The body is the one that the mesh
    describes: what flat facets lack of a round body's area is not estimated.

    Args:
        problem: Body, materials, initial temperatures and effects.
        tolerance: Allowed errors.
        duration_s: Time to follow the body for, [s]; None: its steady state.
        outputs: Number of equal intervals at whose ends temperatures are kept and compared.
        time_s: Time at which effects that change are taken in a steady state, [s].
        memory_bytes: Most memory that a solution may need, [bytes].
        allow_unmet: Return the last solution that fits into memory, with `met` False and the reason in `status`,
            instead of raising.
        log: Takes a line per solution and one on the outcome; print by default.
        progress: As in `solve_heat`, of each solution through time.

    Raises:
        HeatError: The tolerance cannot be met within the memory, or a solution fails.
    """
    check_positive("memory_bytes", memory_bytes, "Give the memory in bytes, such as 4e9.", HeatError)
    run = Run(problem, tolerance, float(memory_bytes), log)
    if duration_s is None:
        failure = _steady(run, time_s)
    else:
        steps = AdaptiveSteps(duration_s, tolerance_k=_needs_kelvin(tolerance), outputs=outputs)
        failure = follow_to_tolerance(run, steps, progress)
    return run.close(failure, allow_unmet)


def _steady(run: Run, time_s: float) -> str:
    """Climb to a steady state that is good enough; returns why that was not possible, or nothing."""

    def solve(problem: HeatProblem, order: int) -> SteadySolution:
        return solve_steady(problem, time_s=time_s, order=order, relative_tolerance=_LINEAR_TOLERANCE)

    given, num_nodes = run.given, len(run.given.mesh.points_m)
    failure = run.lacks_memory(1, 0)
    if failure:
        return failure
    start = linear_start(given, time_s=time_s, relative_tolerance=_LINEAR_TOLERANCE)
    linear = start.solution
    run.add(given, linear, start.error, refinements=0)
    earlier, before, refinements = given, linear, 0
    while run.excess > 1.0:
        failure = run.lacks_memory(2, refinements)
        if failure:
            return failure
        if refinements == 0:
            problem = replace(given, initial_temperature_c=linear.temperature_c)
        else:
            # The nodes of quadratic tetrahedra are those of the finer mesh.
            problem = _refined(earlier, np.concatenate([before.temperature_c, before.edge_temperature_c]))
        solution = solve(problem, 2)
        both = recovered_error(earlier, before), recovered_error(problem, solution)
        ratios = error_ratios(*both, same_order=refinements > 0)
        run.add(problem, solution, _richardson(before, solution, num_nodes, ratios), refinements=refinements)
        earlier, before, refinements = problem, solution, refinements + 1
    return ""


def _refined(problem: HeatProblem, start_c: np.ndarray) -> HeatProblem:
    """Pose the same problem on a finer mesh, with temperatures to start from."""
    return replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=start_c)


def _richardson(coarse: SteadySolution, fine: SteadySolution, num_nodes: int, ratios: ErrorRatios) -> ErrorSize:
    difference = difference_between(coarse, fine, num_nodes)
    return ErrorSize(
        richardson(difference.temperature_k, ratios.temperature), richardson(difference.heat_flow, ratios.heat_flow)
    )


def _needs_kelvin(tolerance: Tolerance) -> float:
    if tolerance.temperature_k is None:
        remedy = "Give temperature_k too: steps in time are chosen by it."
        raise HeatError("tolerance", expected="one in kelvin", got="heat_flow only", remedy=remedy)
    return tolerance.temperature_k
