"""From a tolerance to a solution that meets it, at least cost."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from thermoxels_ns.checks import check_positive
from thermoxels_ns.errors import HeatError, explain
from thermoxels_ns.fem.edge_surplus import Surplus, edge_surplus
from thermoxels_ns.fem.error_budget import (
    ErrorSize,
    Tolerance,
    difference_between,
    flow_error,
)
from thermoxels_ns.fem.error_estimate import HALF_THE_SIZE, ErrorRatios, error_ratios, recovered_error, richardson
from thermoxels_ns.fem.linear_start import linear_start
from thermoxels_ns.fem.memory import DEFAULT_MEMORY_BYTES, describe_bytes, peak_bytes
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem
from thermoxels_ns.fem.refine_mesh import refine_mesh, refined_values
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.stepping import solve_heat

_LINEAR_TOLERANCE = 1e-8
"""Of the linear solver for a steady state: its error is far below any estimate here."""
_STEPS_OVER_TOLERANCE = 3.0
"""Tolerance of the first steps over the allowed error: steps that are controlled to 1 K make an error of 0.03 to 0.07 K
in all, because conduction forgets."""
_OF_THE_SUM = 0.4
"""Error of all steps over the sum of their estimates, per square root of their number. Measured on rods, slabs with
convection and radiation, cubes and two days of weather, with steps controlled to 0.05 to 6 K: 0.13 to 0.97."""
_TIME_SHARE = 0.3
"""Share of the allowed error that time steps may make once their error is known."""
_LONGEST_STEPS = 64.0
"""Most that the tolerance of the steps is raised by at once."""
_LEAST_LEFT = 0.1
"""Share of the allowed error that the mesh may make at least, however much time steps take of it."""
_HALVING_GAINS = 4.0
"""What half the mesh size may divide an error by. A mesh that turns out too coarse costs a tenth of the next."""


@dataclass(frozen=True)
class Level:
    """A solution on the way."""

    order: int
    """1 for linear tetrahedra, 2 for quadratic ones."""
    refinements: int
    """How often the size of the given mesh was halved."""
    step_tolerance_k: float | None
    """Tolerance of the time steps, [K]; None for a steady state."""
    num_nodes: int
    """Number of unknowns."""
    error: ErrorSize
    """Estimated errors."""
    seconds: float
    """Time for it and for the estimate, [s]."""

    def describe(self) -> str:
        """Say it in a line."""
        mesh = "given mesh" if self.refinements == 0 else f"mesh size halved {self.refinements}x"
        steps = "" if self.step_tolerance_k is None else f", steps to {self.step_tolerance_k:.2g} K"
        return (
            f"P{self.order}, {mesh}{steps}, {self.num_nodes} unknowns: estimated error {self.error.describe()}, "
            f"{self.seconds:.2f} s"
        )


@dataclass(frozen=True)
class ToleratedSolution:
    """A solution with what is known of its error."""

    solution: SteadySolution | HeatSolution
    """Temperatures and heat flows. Nodes of the given mesh come first."""
    problem: HeatProblem
    """What was solved last: the given problem, or the same on a finer mesh."""
    settings: Level
    """Order, refinements and steps that were chosen, and the estimated errors."""
    met: bool
    """Whether the estimated errors are within the tolerance."""
    status: str
    """The outcome as a sentence, with the estimate and the seconds."""
    seconds: float
    """Time for all, [s]."""
    levels: tuple[Level, ...]
    """All solutions on the way, the last one is `settings`."""


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
    ones of half the size and err less. In time tetrahedra stay linear, since the mass of quadratic ones cannot be
    lumped. What the embedded scheme says of each step tells the error of the steps, the surplus of quadratic tetrahedra
    that of the mesh, and the mesh is made as fine as the rest of the tolerance asks for. The body is the one that the
    mesh describes: what flat facets lack of a round body's area is not estimated.

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
    run = _Run(problem, tolerance, float(memory_bytes), log)
    if duration_s is None:
        failure = _steady(run, time_s)
    else:
        steps = AdaptiveSteps(duration_s, tolerance_k=_needs_kelvin(tolerance), outputs=outputs)
        failure = _in_time(run, steps, progress)
    return run.close(failure, allow_unmet)


class _Run:
    """What has been solved so far."""

    def __init__(
        self, problem: HeatProblem, tolerance: Tolerance, memory_bytes: float, log: Callable[[str], None]
    ) -> None:
        self.given, self.problem, self.tolerance = problem, problem, tolerance
        self.levels: list[Level] = []
        self.solution: SteadySolution | HeatSolution | None = None
        self._memory_bytes, self._log = memory_bytes, log
        self._begin_s = self._mark_s = time.perf_counter()

    @property
    def excess(self) -> float:
        """Error of the last solution over what is allowed."""
        return self.tolerance.excess(self.levels[-1].error)

    def add(
        self,
        problem: HeatProblem,
        solution: SteadySolution | HeatSolution,
        error: ErrorSize,
        *,
        refinements: int,
        step_tolerance_k: float | None = None,
    ) -> None:
        """Keep a solution."""
        now_s = time.perf_counter()
        edges = len(solution.edge_temperature_c) if isinstance(solution, SteadySolution) else 0
        num_nodes = solution.temperature_c.shape[-1] + edges
        seconds, self._mark_s = now_s - self._mark_s, now_s
        self.levels.append(Level(2 if edges else 1, refinements, step_tolerance_k, num_nodes, error, seconds))
        self.problem, self.solution = problem, solution
        self._log(self.levels[-1].describe())

    def lacks_memory(self, order: int, refinements: int, times: int = 1) -> str:
        """Say what a solution on the given mesh with its size halved so often takes; return that it does not fit."""
        needed = peak_bytes(self.given, order=order, refinements=refinements, times=times, adaptive=times > 1)
        where = "the given mesh" if refinements == 0 else f"the mesh size halved {refinements}x"
        what = f"P{order} on {where} needs about {describe_bytes(needed)}"
        if needed <= self._memory_bytes:
            self._log(f"{what} at most.")
            return ""
        return f"{what}, more than the {describe_bytes(self._memory_bytes)} allowed"

    def close(self, failure: str, allow_unmet: bool) -> ToleratedSolution:
        """Say how it ended."""
        if self.solution is None:
            remedy = "Allow more memory, or use a coarser mesh."
            raise HeatError(explain("memory_bytes", expected="room for a first estimate", got=failure, remedy=remedy))
        last, seconds = self.levels[-1], time.perf_counter() - self._begin_s
        allowed = self.tolerance.describe()
        status = f"{'Not within' if failure else 'Within'} {allowed}: {last.describe()}, {seconds:.2f} s in all."
        if failure:
            status += (
                f" {failure}. Allow more memory (--memory-gb) or a larger error, or take what there is (--allow-unmet "
                "True); the worst temperature is often at a sharp edge."
            )
        if failure and not allow_unmet:
            raise HeatError(status)
        self._log(status)
        return ToleratedSolution(self.solution, self.problem, last, not failure, status, seconds, tuple(self.levels))


def _steady(run: _Run, time_s: float) -> str:
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


def _in_time(run: _Run, steps: AdaptiveSteps, progress: Callable[[float, int], None] | None) -> str:
    """Follow the body through time well enough; returns why that was not possible, or nothing."""
    given, times = run.given, steps.outputs + 1
    failure = run.lacks_memory(2, 0, 3 * times)
    if failure:
        return failure

    def solve(problem: HeatProblem, tolerance_k: float) -> HeatSolution:
        return solve_heat(problem, replace(steps, tolerance_k=tolerance_k), progress=progress)

    tolerance_k = _STEPS_OVER_TOLERANCE * steps.tolerance_k
    solution = solve(given, tolerance_k)
    in_time = _of_steps(solution)
    in_space = _size(edge_surplus(given, solution), solution)
    run.add(given, solution, in_time + in_space, refinements=0, step_tolerance_k=tolerance_k)
    while run.excess > 1.0 and run.tolerance.excess(in_time) > 0.5:
        tolerance_k *= min(_steps_for(_TIME_SHARE, run.tolerance.excess(in_time)), 0.25)
        solution = solve(given, tolerance_k)
        in_time = _of_steps(solution)
        run.add(given, solution, in_time + in_space, refinements=0, step_tolerance_k=tolerance_k)
    problem, base, refinements = given, solution, 0
    # The estimate looks at the ends of intervals. Heat that rushes in at the start it may miss, a finer mesh does not.
    while run.excess > 1.0 or (refinements == 0 and run.tolerance.heat_flow is not None):
        left = max(1.0 - run.tolerance.excess(in_time), _LEAST_LEFT)
        wanted = max(run.tolerance.excess(in_space) / left, 1.0)
        halvings = max(int(np.ceil(np.log(wanted) / np.log(_HALVING_GAINS))), 1)
        failure = run.lacks_memory(1, refinements + halvings, times)
        if failure:
            return failure
        for _ in range(halvings):
            problem = _refined(problem, refined_values(problem.mesh, problem.start_c))
        refinements += halvings
        # A finer mesh costs more per step: no more steps than what the mesh leaves of the tolerance asks for.
        spare = 0.5 * (1.0 - run.tolerance.excess(in_space) / _HALVING_GAINS**halvings)
        longer = min(
            max(_steps_for(min(max(spare, 0.0), _TIME_SHARE), run.tolerance.excess(in_time)), 1.0), _LONGEST_STEPS
        )
        tolerance_k, growth = longer * tolerance_k, longer ** (2.0 / 3.0)
        in_time = ErrorSize(growth * in_time.temperature_k, growth * in_time.heat_flow)
        solution = solve(problem, tolerance_k)
        in_space = _richardson(base, solution, len(given.mesh.points_m), _same(HALF_THE_SIZE**refinements))
        run.add(problem, solution, in_time + in_space, refinements=refinements, step_tolerance_k=tolerance_k)
    return ""


def _steps_for(share: float, excess: float) -> float:
    """Factor on the tolerance of the steps that brings their error from `excess` to `share` of what is allowed.

    A step follows the cube root of the error that it may make, and the error of all steps the square of the step.
    """
    return (share / excess) ** 1.5 if excess > 0.0 else _LONGEST_STEPS


def _refined(problem: HeatProblem, start_c: np.ndarray) -> HeatProblem:
    """Pose the same problem on a finer mesh, with temperatures to start from."""
    return replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=start_c)


def _size(surplus: Surplus, solution: HeatSolution) -> ErrorSize:
    """Size of what an estimate adds."""
    rows = surplus.group_heat_w
    # Mean heat flows of intervals, from those at their ends.
    mean_w = np.mean(0.5 * (rows[1:] + rows[:-1]), axis=0)
    largest_k = float(np.max(np.abs(surplus.temperature_k)))
    return ErrorSize(largest_k, flow_error(surplus.by_effect(mean_w), solution))


def _same(ratio: float) -> ErrorRatios:
    return ErrorRatios(ratio, ratio)


def _richardson(
    coarse: SteadySolution | HeatSolution, fine: SteadySolution | HeatSolution, num_nodes: int, ratios: ErrorRatios
) -> ErrorSize:
    difference = difference_between(coarse, fine, num_nodes)
    return ErrorSize(
        richardson(difference.temperature_k, ratios.temperature), richardson(difference.heat_flow, ratios.heat_flow)
    )


def _of_steps(solution: HeatSolution) -> ErrorSize:
    """Error of the steps, from what their embedded scheme says of each.

    Conduction forgets, so that errors add up to far less than their sum. The heat flow, a mean over all times, errs by
    a smaller share of itself than the temperatures of theirs.
    """
    if solution.steps == 0 or not np.isfinite(solution.time_error_k):
        return ErrorSize(0.0, 0.0)
    largest_k = _OF_THE_SUM * solution.time_error_k / solution.steps**0.5
    range_k = float(np.ptp(solution.temperature_c))
    return ErrorSize(largest_k, largest_k / range_k if range_k > 0.0 else 0.0)


def _needs_kelvin(tolerance: Tolerance) -> float:
    if tolerance.temperature_k is None:
        remedy = "Give temperature_k too: steps in time are chosen by it."
        raise HeatError(explain("tolerance", expected="one in kelvin", got="heat_flow only", remedy=remedy))
    return tolerance.temperature_k
