"""Solving a heat problem to a tolerance: solve, halve the mesh size, and compare (Richardson)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem
from thermoxels_ns.fem.refine_mesh import refine_mesh, refined_values
from thermoxels_ns.fem.solution import ErrorSize, Solution, SteadySolution, mean_flows_w, share_of_heat
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat

DEFAULT_MEMORY_BYTES = 4 * 2**30  # Most memory that a solution may need, [bytes]
HALVED = 0.3
"""Share of an error that is left after the mesh size is halved. Theory says 1/4 where temperatures are
smooth, and 0.4 at the edges of a notch of a right angle, where temperatures behave as r^(2/3)."""
_LEFT = {1: ErrorSize(HALVED, HALVED), 2: ErrorSize(0.2, 0.2)}
"""Share of an error left after halving, by order of the tetrahedra; for order 2 theory says 1/8, and 0.4 at a notch."""
TO_QUADRATIC = ErrorSize(0.2, 0.1)
"""Error of quadratic tetrahedra as a share of the error of linear ones on the same mesh, for temperatures and for heat
flows; from smooth to singular temperatures these shares range from 0.02 to 0.5 and from 0.002 to 0.25."""
MARGIN = 1.3
"""Factor by which an error of heat flow may exceed its estimate. The largest of eight bodies is 1.23, where a material
insulates 1e8 times better than the one beside it along the flow. Temperatures were off by 0.66 to 0.92 of estimates."""
_STEADY_TOLERANCE, _STEP_TOLERANCE = 1e-8, 1e-10
"""Relative tolerances of the linear solver for steady states and for steps: its error is far below any estimate."""
_FINER_STEPS, _LEFT_BY_STEPS, _STEPS_SHARE = 0.25, 0.4, 0.5
"""Tolerance of the steps that tell the error of others, as a share of theirs; the share of the error that these leave
(0.25^(2/3): errors of single steps, of third order, add up in a body that does not forget them; else 0.25); most of the
allowed error that steps may make."""
_MOST_TRIES = 6  # Tolerances of steps that are tried; a larger error than allowed then counts as what it is
_BYTES_PER_TET, _BYTES_PER_FACET = {1: 400.0, 2: 2600.0}, {1: 600.0, 2: 4000.0}
"""Most memory by order of the tetrahedra, [bytes], measured with convection and radiation; about half without both."""


@dataclass(frozen=True)
class Tolerance:
    """Errors that a user allows, above 0; None: any error. At least one of the two is given."""

    temperature_k: float | None = 0.05
    """Largest error of the temperature at any node of the mesh, [K]. The default is half of the error that building
    physics allows (ISO 10211: 0.1 K)."""
    heat_flow: float | None = None
    """Largest error of the mean heat flow that any effect brings, as a share of all heat that flows through the body;
    building physics allows 0.01 (ISO 10211)."""

    def excess(self, error: ErrorSize) -> float:
        """Return the larger ratio of an error, that of heat flow times `MARGIN`, to its allowed value; met up to 1."""
        pairs = (error.temperature_k, self.temperature_k), (MARGIN * error.heat_flow, self.heat_flow)
        return max(found / allowed for found, allowed in pairs if allowed is not None)

    def describe(self) -> str:
        """Return the allowed errors as text, such as "0.05 K and 1 % of the heat flow"."""
        parts = [] if self.temperature_k is None else [f"{self.temperature_k:g} K"]
        parts += [] if self.heat_flow is None else [f"{100.0 * self.heat_flow:g} % of the heat flow"]
        return " and ".join(parts)


@dataclass(frozen=True)
class Level:
    """One of the solutions that `solve_to_tolerance` computes: its mesh, steps and estimated errors."""

    order: int  # 1 for linear tetrahedra, 2 for quadratic ones
    refinements: int  # How often the size of the given mesh was halved
    step_tolerance_k: float | None  # Error that the time steps are estimated to make, [K]; None for a steady state
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
    problem: HeatProblem  # The problem that was solved: the given problem, or the same on a finer mesh
    tolerance: Tolerance  # Errors that were allowed
    settings: Level  # Order, refinements and steps of `solution`, and its estimated errors
    met: bool  # True if the estimated errors are within the tolerance
    status: str  # The outcome as a sentence, with the estimate and the seconds
    seconds: float  # Time for all solutions together, [s]
    levels: tuple[Level, ...]  # All solutions that were computed; the last entry is `settings`


def solve_to_tolerance(
    problem: HeatProblem,
    tolerance: Tolerance,
    *,
    duration_s: float | None = None,
    outputs: int = 10,
    memory_bytes: float = DEFAULT_MEMORY_BYTES,
    allow_unmet: bool = False,
    log: Callable[[str], None] = print,
    progress: Callable[[float, int], None] | None = None,
) -> ToleratedSolution:
    """Solve a problem on a mesh and in time steps so fine that the estimated errors are within `tolerance`.

    The difference of two solutions tells the errors of both, because the error of the finer solution is a known share
    of the error of the coarser one (Richardson 1911): `TO_QUADRATIC` or `HALVED`.

    A steady state is solved with linear and then with quadratic tetrahedra on the given mesh; while the error is too
    large, quadratic ones of half the size follow, or linear ones if the solver fails on quadratic ones. Through time
    tetrahedra stay linear and the second solution is on a mesh of half the size. Steps are those whose error on the
    given mesh, found by finer steps, is at most half of what is allowed. The area that flat facets miss of a round
    body is not estimated.

    Args:
        problem: Body, materials, initial temperatures and effects.
        tolerance: Allowed errors.
        duration_s: Time to follow the body for, [s], which needs `tolerance.temperature_k`; None: the steady state.
        outputs: Number of equal intervals at whose ends temperatures are kept and compared.
        memory_bytes: Most memory that a solution may need, [bytes].
        allow_unmet: Return the best solution that fits into memory, with `met` False, instead of raising.
        log: Called with a line on each solution and a line on the outcome; print by default.
        progress: Called in each solution through time as `progress` of `solve_heat`.

    Raises:
        HeatError: The tolerance cannot be met within the memory, or a solution fails.
    """
    if duration_s is None:

        def solve_state(problem: HeatProblem, order: int) -> Solution:
            return solve_steady(problem, order=order, relative_tolerance=_STEADY_TOLERANCE)

        run = _Run(problem, tolerance, memory_bytes, log)
        return run.close(_refine(run, solve_state, 2, 0), allow_unmet)
    allowed_k = tolerance.temperature_k
    assert allowed_k is not None, "steps in time are chosen by it"
    run = _Run(problem, tolerance, memory_bytes, log, times=outputs + 1)
    steps: list[AdaptiveSteps] = []

    def follow(problem: HeatProblem, steps: AdaptiveSteps) -> Solution:
        return solve_heat(problem, steps, relative_tolerance=_STEP_TOLERANCE, progress=progress)

    def solve_in_time(problem: HeatProblem, _: int) -> Solution:
        if steps:
            return follow(problem, steps[0])
        tried = AdaptiveSteps(duration_s, allowed_k, outputs=outputs)
        found = follow(problem, tried)
        for _ in range(_MOST_TRIES):
            finer = replace(tried, tolerance_k=_FINER_STEPS * tried.tolerance_k)
            better = follow(problem, finer)
            apart = difference_between(found, better, len(problem.mesh.points_m))
            run.of_steps = richardson(apart, ErrorSize(_LEFT_BY_STEPS, _LEFT_BY_STEPS))[0]
            if tolerance.excess(run.of_steps) <= _STEPS_SHARE:
                break
            tried, found = finer, better
        steps.append(tried)
        return found

    return run.close(_refine(run, solve_in_time, 1, 1), allow_unmet)


def steady_error(problem: HeatProblem, solution: SteadySolution) -> ErrorSize:
    """Estimate the errors of a steady solution of linear tetrahedra by solving with quadratic ones on the same mesh.

    Raises `HeatError` if the solution with quadratic tetrahedra fails.
    """
    start = replace(problem, initial_temperature_c=solution.temperature_c)
    finer = solve_steady(start, order=2, relative_tolerance=_STEADY_TOLERANCE)
    return richardson(difference_between(solution, finer, len(problem.mesh.points_m)), TO_QUADRATIC)[0]


def richardson(apart: ErrorSize, left: ErrorSize) -> tuple[ErrorSize, ErrorSize]:
    """Estimate the errors of a coarser and of a finer solution from their difference `apart`.

    If the finer error is `left` times the coarser error, the solutions differ by (1 - left) times the coarser error.

    >>> richardson(ErrorSize(0.75, 0.5), ErrorSize(0.25, 0.0))
    (ErrorSize(temperature_k=1.0, heat_flow=0.5), ErrorSize(temperature_k=0.25, heat_flow=0.0))
    """
    kelvin, flow = apart.temperature_k / (1.0 - left.temperature_k), apart.heat_flow / (1.0 - left.heat_flow)
    return ErrorSize(kelvin, flow), ErrorSize(kelvin * left.temperature_k, flow * left.heat_flow)


def difference_between(coarse: Solution, fine: Solution, num_nodes: int) -> ErrorSize:
    """Return the largest differences between two solutions with equal times and the same first `num_nodes` nodes."""
    apart_k = np.abs(fine.temperature_c[..., :num_nodes] - coarse.temperature_c[..., :num_nodes])
    before_w, after_w = mean_flows_w(coarse), mean_flows_w(fine)
    largest_w = max((abs(after_w[effect] - before_w[effect]) for effect in after_w), default=0.0)
    return ErrorSize(float(apart_k.max()), share_of_heat(largest_w, fine))


def peak_bytes(problem: HeatProblem, *, order: int = 1, refinements: int = 0, times: int = 1) -> float:
    """Return a forecast of the most memory that a solution takes besides the problem itself, [bytes].

    Each of the `refinements` makes eight tetrahedra of one; `times` is the number of times whose temperatures are kept.
    Interpreter and libraries take about 150 MB more.
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


class _Run:
    """The course of one `solve_to_tolerance`: the solutions so far, and the choice among them."""

    def __init__(
        self, problem: HeatProblem, tolerance: Tolerance, memory_bytes: float, log: Callable, times: int = 1
    ) -> None:
        self.given, self.tolerance, self._memory_bytes, self.say = problem, tolerance, memory_bytes, log
        self._times = times
        self.of_steps = ErrorSize(0.0, 0.0)
        """Error that time steps make; 0 in steady states."""
        self.solved: list[tuple[Level, HeatProblem, Solution]] = []
        self._begin_s = time.perf_counter()

    @property
    def met(self) -> bool:
        """True if the estimated error of any solution so far is allowed."""
        return any(self.tolerance.excess(level.error) <= 1.0 for level, _, _ in self.solved)

    def add(self, problem: HeatProblem, solution: Solution, seconds: float, error: ErrorSize, refinements: int) -> None:
        """Keep a solution with the `error` of its mesh; `refinements` is how often the mesh size was halved for it."""
        steady = isinstance(solution, SteadySolution)
        edges = len(solution.edge_temperature_c) if steady else 0
        nodes, steps_k = solution.temperature_c.shape[-1] + edges, None if steady else self.of_steps.temperature_k
        solution = solution if steady else replace(solution, time_error_k=steps_k)
        of_steps = self.of_steps
        error = ErrorSize(error.temperature_k + of_steps.temperature_k, error.heat_flow + of_steps.heat_flow)
        level = Level(2 if edges else 1, refinements, steps_k, nodes, error, seconds)
        self.solved.append((level, problem, solution))
        self.say(level.describe())

    def lacks_memory(self, order: int, refinements: int) -> str:
        """Return why a solution with the mesh size halved `refinements` times does not fit in memory, "" if it does."""
        needed = peak_bytes(self.given, order=order, refinements=refinements, times=self._times)
        where = "the given mesh" if refinements == 0 else f"the mesh size halved {refinements}x"
        what = f"P{order} on {where} needs about {describe_bytes(needed)}"
        if needed <= self._memory_bytes:
            self.say(f"{what} at most.")
            return ""
        return f"{what}, more than the {describe_bytes(self._memory_bytes)} allowed (--memory-gb)"

    def close(self, failure: str, allow_unmet: bool) -> ToleratedSolution:
        """Return the smallest solution within the tolerance, or if `failure` says why there is none the most exact one.

        Raises:
            HeatError: There is a `failure` and `allow_unmet` is False, or nothing was solved at all.
        """
        if not self.solved:
            remedy = "Allow more memory (--memory-gb), or use a coarser mesh."
            raise HeatError("memory_bytes", expected="room for a first estimate", got=failure, remedy=remedy)
        excess = [self.tolerance.excess(level.error) for level, _, _ in self.solved]
        sizes = (float(level.num_nodes) for level, _, _ in self.solved)
        rank = [(size if over <= 1.0 else np.inf, over) for size, over in zip(sizes, excess)]
        chosen = self.solved[rank.index(min(rank))]
        levels = *(solved[0] for solved in self.solved if solved is not chosen), chosen[0]
        last, seconds = chosen[0], time.perf_counter() - self._begin_s
        allowed = self.tolerance.describe()
        status = f"{'Not within' if failure else 'Within'} {allowed}: {last.describe()}, {seconds:.2f} s in all."
        if failure:
            status += (
                f" {failure.rstrip('.')}. Allow a larger error, or take what there is (--allow-unmet True); the worst "
                "temperature is often at a sharp edge."
            )
            if last.step_tolerance_k is None and self.tolerance.heat_flow is None:
                status += " Heat flows are met far sooner: ask for them instead (--flow-tolerance 0.01)."
        if failure and not allow_unmet:
            raise HeatError(status)
        self.say(status)
        return ToleratedSolution(chosen[2], chosen[1], self.tolerance, last, not failure, status, seconds, levels)


def _halved(problem: HeatProblem, start: Solution | None = None) -> HeatProblem:
    """Return the problem on a mesh of half the size; it starts from `start`, or if None from its own start."""
    nodal, edges = (problem.start_c if start is None else start.temperature_c), getattr(start, "edge_temperature_c", ())
    start_c = np.concatenate([nodal, edges]) if len(edges) else refined_values(problem.mesh, nodal)
    return replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=start_c)


def _refine(run: _Run, solve: Callable[[HeatProblem, int], Solution], order: int, refinements: int) -> str:
    """Add finer and finer solutions to `run` until one is within the tolerance; return why none can be, or "".

    `solve` takes a problem and the order of its tetrahedra. The first solution has linear ones on the given mesh, the
    second has the `order` and `refinements` of the arguments.
    """

    def timed(problem: HeatProblem, order: int) -> tuple[Solution, float]:
        begin_s = time.perf_counter()
        return solve(problem, order), time.perf_counter() - begin_s

    failure = run.lacks_memory(order, refinements)
    if failure:
        return failure
    before, first_seconds = timed(run.given, 1)
    steady = isinstance(before, SteadySolution)
    problem = replace(run.given, initial_temperature_c=before.temperature_c) if steady else _halved(run.given)
    while True:
        try:
            solution, seconds = timed(problem, order)
        except HeatError as refusal:
            if order == 1 or refinements:
                return str(refusal)
            run.say(f"P2 failed: {refusal} Linear tetrahedra of half the size follow.")
            order = 1
        else:
            left = TO_QUADRATIC if (order, refinements) == (2, 0) else _LEFT[order]
            coarse, fine = richardson(difference_between(before, solution, len(run.given.mesh.points_m)), left)
            if not run.solved:
                run.add(run.given, before, first_seconds, coarse, 0)
            run.add(problem, solution, seconds, fine, refinements)
            if run.met:
                return ""
            before = solution
        refinements += 1
        failure = run.lacks_memory(order, refinements)
        if failure:
            return failure
        problem = _halved(problem, before if steady else None)
