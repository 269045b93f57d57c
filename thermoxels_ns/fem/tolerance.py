"""Solution of a heat problem to a tolerance: errors follow from the difference of two solutions (Richardson)."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.yaml_records import record
from thermoxels_ns.fem.linear_tets import refine_mesh
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, Positive, TimeSteps
from thermoxels_ns.fem.solution import ErrorSize, HeatSolution, Solution, SteadySolution, mean_flows_w, share_of_heat
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import Progress, solve_heat

LEAVE_OUT_BELOW = 0.005
"""Default of the largest share of all heat that the effects left out may bring together: half of the error of a heat
flow that building physics allows (ISO 10211: 1 %)."""
HALVED = 0.3
"""Share of the error of linear tetrahedra that is left after the mesh size is halved. In theory it is 1/4 for smooth
temperatures, and 0.4 at the edges of a right-angled notch, at which temperatures behave as r^(2/3)."""
_LEFT = {1: ErrorSize(HALVED, HALVED), 2: ErrorSize(0.2, 0.2)}
"""Share of the error left after halving, by order of the tetrahedra; in theory 1/8 for order 2, and 0.4 at a notch."""
TO_QUADRATIC = ErrorSize(0.2, 0.1)
"""Error of quadratic tetrahedra as a share of the error of linear ones on the same mesh, for temperatures and for heat
flows. From smooth to singular temperatures these shares range from 0.02 to 0.5 and from 0.002 to 0.25."""
MARGIN = 1.3
"""Factor by which the error of a heat flow may exceed its estimate. The largest factor of eight bodies is 1.23, for a
material that insulates 1e8 times better than its neighbour along the flow. For temperatures it was 0.66 to 0.92."""
_STEADY_TOLERANCE, _STEP_TOLERANCE = 1e-8, 1e-10
"""Relative tolerances of the linear solver for steady states and for steps; its error is far below any estimate."""
_FINER_STEPS, _LEFT_BY_STEPS, _STEPS_SHARE = 0.25, 0.4, 0.5
"""Tolerance of the finer steps of an estimate as a share of the tolerance of the coarser; share of the error that finer
steps leave (0.25^(2/3) if errors of single steps, of third order, add up; else 0.25); allowed share of all error."""
_NONE = ErrorSize(0.0, 0.0)
_MOST_TRIES = 6  # Number of step tolerances that are tried; after the last, a larger error than allowed is accepted
_BYTES_PER_TET, _BYTES_PER_FACET = {1: 400.0, 2: 2600.0}, {1: 600.0, 2: 4000.0}
"""Peak memory by order of the tetrahedra, [bytes], measured with convection and radiation; about half without both."""


@record(HeatError)
class Goals:
    """The largest errors and memory that a solution may have; raises `HeatError` if they are out of range or clash."""

    tolerance_k: Positive | None = None  # Largest allowed error of any temperature, [K]; None: any error
    flow_tolerance: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    """Largest allowed error of the mean heat flow of any effect, as a share of all heat; None: any error."""
    leave_out_below: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """Share of all heat that effects left out may bring together; None: `LEAVE_OUT_BELOW`, or 0 beside a tolerance."""
    memory_gb: Positive | None = 4.0  # Most memory that solving may take, [GiB]; None: any amount
    allow_unmet: bool = False  # True: if a tolerance cannot be met, return the best solution that fits into memory

    def __post_init__(self) -> None:
        if self.estimated and self.leave_out_below:
            expected, remedy = "0 or nothing beside a tolerance", "Remove one of the two."
            raise HeatError("leave_out_below", expected=expected, got=f"{self.leave_out_below:g}", remedy=remedy)

    @property
    def estimated(self) -> bool:
        """True if a tolerance is given, so that errors must be estimated."""
        return self.tolerance_k is not None or self.flow_tolerance is not None

    @property
    def left_out_share(self) -> float:
        """Largest share of all heat that the effects left out may bring together."""
        if self.leave_out_below is not None:
            return self.leave_out_below
        return 0.0 if self.estimated else LEAVE_OUT_BELOW

    @property
    def memory_bytes(self) -> float:
        """Most memory that solving may take, [bytes]."""
        return np.inf if self.memory_gb is None else self.memory_gb * 2**30

    def excess(self, error: ErrorSize) -> float:
        """Return the larger ratio of an error to its allowed value, at most 1 if the goals are met. The error of heat
        flow is multiplied by `MARGIN`. At least one error must be limited (`estimated`)."""
        pairs = (error.temperature_k, self.tolerance_k), (MARGIN * error.heat_flow, self.flow_tolerance)
        return max(found / allowed for found, allowed in pairs if allowed is not None)

    def describe(self) -> str:
        """Return the allowed errors as text, such as "0.05 K and 1 % of the heat flow"."""
        parts = [] if self.tolerance_k is None else [f"{self.tolerance_k:g} K"]
        parts += [] if self.flow_tolerance is None else [f"{100.0 * self.flow_tolerance:g} % of the heat flow"]
        return " and ".join(parts)


@dataclass(frozen=True)
class Level:
    """The mesh, steps and estimated errors of one of the solutions that `solve_to_tolerance` computes."""

    order: int  # 1 for linear tetrahedra, 2 for quadratic ones
    refinements: int  # Number of times that the size of the given mesh was halved
    step_tolerance_k: float | None  # Estimated error due to time steps, [K]; None for a steady state
    num_nodes: int  # Number of unknowns
    error: ErrorSize  # Estimated errors
    seconds: float  # Time to solve it, [s]

    def describe(self) -> str:
        """Return a line on mesh, steps and estimated errors of the solution."""
        mesh = "given mesh" if self.refinements == 0 else f"mesh size halved {self.refinements}x"
        steps = "" if self.step_tolerance_k is None else f", steps to {self.step_tolerance_k:.2g} K"
        return (
            f"P{self.order}, {mesh}{steps}, {self.num_nodes} unknowns: estimated error {self.error.describe()}, "
            f"{self.seconds:.2f} s"
        )


@dataclass(frozen=True)
class ToleratedSolution:
    """A solution with estimates of its errors; the outcome of `solve_to_tolerance`."""

    solution: Solution  # Temperatures and heat flows; nodes of the given mesh come first
    problem: HeatProblem  # The problem that was solved: the given problem, perhaps on a finer mesh
    goals: Goals  # Errors that were allowed
    settings: Level  # Order, refinements and steps of `solution`, and its estimated errors
    met: bool  # True if the estimated errors are within the tolerance
    status: str  # The outcome as a sentence, with the estimate and the seconds
    seconds: float  # Time for all solutions together, [s]
    levels: tuple[Level, ...]  # All solutions that were computed; the last entry is `settings`


def solve_to_tolerance(
    problem: HeatProblem,
    goals: Goals,
    time: TimeSteps | AdaptiveSteps | None = None,
    *,
    log: Callable[[str], None] = print,
    progress: Progress | None = None,
) -> ToleratedSolution:
    """Return a solution on a mesh and in time steps that are fine enough for the estimated errors to meet `goals`.

    Both errors of two solutions follow from their difference, because the error of the finer solution is a known share
    of the error of the coarser one (Richardson 1911): `TO_QUADRATIC` or `_LEFT`.

    A steady state is solved with linear and then with quadratic tetrahedra on the given mesh. Through time, linear
    tetrahedra of the given mesh and of half its size are used. While the error is too large, the mesh size is halved
    again; if the solver fails on quadratic tetrahedra of the given mesh, linear ones follow. Time steps are chosen on
    the given mesh so that their error, found by finer steps, is at most half of the allowed error. The error of area
    of flat facets on a round body is not estimated.

    Args:
        problem: Body, materials, initial temperatures and effects.
        goals: Allowed errors (at least one) and memory.
        time: Duration, and the times at which temperatures are kept and compared; None: the steady state.
        log: Called with a line on each solution and a line on the outcome; print by default.
        progress: The argument of `solve_heat`, for each solution through time.

    Raises:
        HeatError: The tolerance cannot be met within the memory, or a solution fails.
    """
    solved, begin_s = list[tuple[Level, HeatProblem, Solution]](), clock.perf_counter()

    def lacks_memory(order: int, refinements: int) -> str:
        """Return why a solution with the mesh size halved `refinements` times does not fit in memory; "" if it fits."""
        times = 1 if time is None else len(time.times_s)
        needed = peak_bytes(problem, order=order, refinements=refinements, times=times)
        where = "the given mesh" if refinements == 0 else f"the mesh size halved {refinements}x"
        what = f"P{order} on {where} needs about {describe_bytes(needed)}"
        if needed <= goals.memory_bytes:
            log(f"{what} at most.")
            return ""
        what += f", more than the {describe_bytes(goals.memory_bytes)} allowed (--memory-gb)"
        if not solved:
            remedy = "Allow more memory (--memory-gb), or use a coarser mesh."
            raise HeatError("memory_bytes", expected="room for a first estimate", got=what, remedy=remedy)
        return what

    def keep(problem: HeatProblem, solution: Solution, refinements: int, error: ErrorSize, seconds: float) -> None:
        """Append a solution to `solved`; `error` is due to its mesh, the error of the steps is added."""
        edges, steps_k = 0, None
        if isinstance(solution, SteadySolution):
            edges = len(solution.edge_temperature_c)
        else:
            steps_k = of_steps.temperature_k
            solution = replace(solution, time_error_k=steps_k)
        error = ErrorSize(error.temperature_k + of_steps.temperature_k, error.heat_flow + of_steps.heat_flow)
        nodes = solution.temperature_c.shape[-1] + edges
        level = Level(2 if edges else 1, refinements, steps_k, nodes, error, seconds)
        solved.append((level, problem, solution))
        log(level.describe())

    order, refinements = (2, 0) if time is None else (1, 1)  # of the second solution
    failure = lacks_memory(order, refinements)
    if time is None:
        before, steps, of_steps = solve_steady(problem, order=1, relative_tolerance=_STEADY_TOLERANCE), None, _NONE
        finer = replace(problem, initial_temperature_c=before.temperature_c)
    else:
        before, steps, of_steps = _in_good_steps(problem, time, goals, progress)
        finer = _halved(problem)
    seconds = clock.perf_counter() - begin_s
    while not failure:
        first_s, start_s = seconds, clock.perf_counter()
        try:
            if steps is None:
                solution = solve_steady(finer, order=order, relative_tolerance=_STEADY_TOLERANCE)
            else:
                solution = solve_heat(finer, steps, relative_tolerance=_STEP_TOLERANCE, progress=progress)
            seconds = clock.perf_counter() - start_s
        except HeatError as refusal:
            if order == 1 or refinements:
                failure = str(refusal)
                break
            log(f"P2 failed: {refusal} Linear tetrahedra of half the size follow.")
            order = 1
        else:
            left = TO_QUADRATIC if (order, refinements) == (2, 0) else _LEFT[order]
            coarse, fine = richardson(difference_between(before, solution, len(problem.mesh.points_m)), left)
            if not solved:
                keep(problem, before, 0, coarse, first_s)
            keep(finer, solution, refinements, fine, seconds)
            if any(goals.excess(level.error) <= 1.0 for level, _, _ in solved):
                break
            before = solution
        refinements += 1
        failure = lacks_memory(order, refinements)
        if not failure:
            finer = _halved(finer, None if time else before)
    if not solved:
        raise HeatError(failure)
    # The smallest solution within the tolerance, or else the most exact one.
    settings, chosen, solution = min(solved, key=lambda one: max(goals.excess(one[0].error), 1.0))
    seconds, levels = clock.perf_counter() - begin_s, (*(one[0] for one in solved if one[2] is not solution), settings)
    within = "Not within" if failure else "Within"
    status = f"{within} {goals.describe()}: {settings.describe()}, {seconds:.2f} s in all."
    if failure:
        status += (
            f" {failure.rstrip('.')}. Allow a larger error, or take what there is (--allow-unmet True); the worst "
            "temperature is often at a sharp edge."
        )
        if time is None and goals.flow_tolerance is None:
            status += " Heat flows are met far sooner: ask for them instead (--flow-tolerance 0.01)."
        if not goals.allow_unmet:
            raise HeatError(status)
    log(status)
    return ToleratedSolution(solution, chosen, goals, settings, not failure, status, seconds, levels)


def _in_good_steps(
    problem: HeatProblem, time: TimeSteps | AdaptiveSteps, goals: Goals, progress: Progress | None
) -> tuple[HeatSolution, AdaptiveSteps, ErrorSize]:
    """Return a solution in steps whose error is at most `_STEPS_SHARE` of the goals, the steps, and their error. The
    error is estimated by finer steps. It may be larger after `_MOST_TRIES`."""
    steps = AdaptiveSteps(time.duration_s, outputs=len(time.times_s) - 1)
    steps = steps if goals.tolerance_k is None else replace(steps, tolerance_k=goals.tolerance_k)
    found = solve_heat(problem, steps, relative_tolerance=_STEP_TOLERANCE, progress=progress)
    for _ in range(_MOST_TRIES):
        finer = replace(steps, tolerance_k=_FINER_STEPS * steps.tolerance_k)
        better = solve_heat(problem, finer, relative_tolerance=_STEP_TOLERANCE, progress=progress)
        apart = difference_between(found, better, len(problem.mesh.points_m))
        error = richardson(apart, ErrorSize(_LEFT_BY_STEPS, _LEFT_BY_STEPS))[0]
        if goals.excess(error) <= _STEPS_SHARE:
            break
        steps, found = finer, better
    return found, steps, error


def steady_error(problem: HeatProblem, solution: SteadySolution) -> ErrorSize:
    """Return estimated errors of a steady solution of linear tetrahedra, from quadratic ones on the same mesh.

    Raises `HeatError` if the solution with quadratic tetrahedra fails.
    """
    start = replace(problem, initial_temperature_c=solution.temperature_c)
    finer = solve_steady(start, order=2, relative_tolerance=_STEADY_TOLERANCE)
    return richardson(difference_between(solution, finer, len(problem.mesh.points_m)), TO_QUADRATIC)[0]


def richardson(apart: ErrorSize, left: ErrorSize) -> tuple[ErrorSize, ErrorSize]:
    """Return estimated errors of a coarser and of a finer solution from their difference `apart`.

    If the finer error is `left` times the coarser error, the solutions differ by (1 - left) times the coarser error.

    >>> richardson(ErrorSize(0.75, 0.5), ErrorSize(0.25, 0.0))
    (ErrorSize(temperature_k=1.0, heat_flow=0.5), ErrorSize(temperature_k=0.25, heat_flow=0.0))
    """
    kelvin, flow = apart.temperature_k / (1.0 - left.temperature_k), apart.heat_flow / (1.0 - left.heat_flow)
    return ErrorSize(kelvin, flow), ErrorSize(kelvin * left.temperature_k, flow * left.heat_flow)


def difference_between(coarse: Solution, fine: Solution, num_nodes: int) -> ErrorSize:
    """Return the largest differences between two solutions; they must share times and their first `num_nodes` nodes."""
    apart_k = np.abs(fine.temperature_c[..., :num_nodes] - coarse.temperature_c[..., :num_nodes])
    before_w, after_w = mean_flows_w(coarse), mean_flows_w(fine)
    largest_w = max((abs(after_w[effect] - before_w[effect]) for effect in after_w), default=0.0)
    return ErrorSize(float(apart_k.max()), share_of_heat(largest_w, fine))


def peak_bytes(problem: HeatProblem, *, order: int = 1, refinements: int = 0, times: int = 1) -> float:
    """Return a forecast of the peak memory of a solution, [bytes], besides the problem itself.

    The mesh size is halved `refinements` times; `times` states are kept. Libraries take about 150 MB more.
    """
    mesh = problem.mesh
    volume = _BYTES_PER_TET[order] * len(mesh.tets) + 8.0 * times * len(mesh.points_m)
    return 8.0**refinements * volume + 4.0**refinements * _BYTES_PER_FACET[order] * len(mesh.facets)


def describe_bytes(amount: float) -> str:
    """Return an amount of memory as text in GiB or MiB.

    >>> describe_bytes(3 * 2**30), describe_bytes(266000.0)
    ('3 GiB', '0.25 MiB')
    """
    return f"{amount / 2**30:.2g} GiB" if amount >= 2**30 else f"{amount / 2**20:.{3 if amount >= 1e8 else 2}g} MiB"


def _halved(problem: HeatProblem, start: Solution | None = None) -> HeatProblem:
    """Return the problem on a mesh of half the size with initial temperatures from `start`; None: from the problem."""
    nodal, edges = (problem.start_c if start is None else start.temperature_c), getattr(start, "edge_temperature_c", ())
    mesh = refine_mesh(replace(problem.mesh, temperature_c=nodal))
    start_c = np.concatenate([nodal, edges]) if len(edges) else mesh.temperature_c
    return replace(problem, mesh=mesh, initial_temperature_c=start_c)
