"""Solve a heat problem to a tolerance: solve, refine or halve, estimate, repeat."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeAlias

import numpy as np

from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.error_estimate import (
    HALVED,
    ErrorSize,
    compared_values,
    difference_between,
    error_ratios,
    error_size,
    recovered_error_w_k,
    richardson,
)
from thermoxels_ns.fem.memory import DEFAULT_MEMORY_BYTES, describe_bytes, peak_bytes
from thermoxels_ns.fem.problem import AdaptiveSteps, GivenSteps, HeatProblem
from thermoxels_ns.fem.refine_mesh import refine_mesh, refined_values
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat

_STEADY_TOLERANCE, _STEP_TOLERANCE = 1e-8, 1e-10
"""Of the linear solver: its error is far below any estimate here."""
_STEPS_OVER_ERROR = 6.0
"""Tolerance of the first, adaptive steps over the allowed error: steps that are controlled to 1 K make an error of 0.03
to 0.07 K in all, because conduction forgets."""
_AIM = 0.95  # Share of the allowed error that a solution is chosen to make
_MOST_HALVINGS = 8  # Halvings of the mesh size or of the steps beyond which nothing is tried
_SUDDENLY_HELD = 0.5
"""Share of a flow's error that is left after the mesh size is halved where a surface is suddenly held."""
_MESH_COST, _STEP_COST = 10.0, 2.0
"""How much more half the mesh size and half the steps cost."""


@dataclass(frozen=True)
class Tolerance:
    """Errors that a user allows; what is None does not matter."""

    temperature_k: float | None = 0.05
    """Largest error of the temperature at any node of the mesh, [K]. The default is half of what building physics asks
    of a temperature (ISO 10211: 0.1 K)."""
    heat_flow: float | None = None
    """Largest error of the mean heat flow that any effect brings, as a share of all heat that flows through the body;
    0.01 is what building physics asks for (ISO 10211)."""

    def __post_init__(self) -> None:
        if self.temperature_k is None and self.heat_flow is None:
            remedy = "Give a tolerance in kelvin, or one for heat flows such as 0.01."
            raise HeatError("tolerance", expected="temperature_k or heat_flow", got="neither", remedy=remedy)
        for name, remedy in (("temperature_k", "Give it in kelvin."), ("heat_flow", "Give a share, such as 0.01.")):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, check_positive(name, value, remedy, HeatError))

    def excess(self, error: ErrorSize) -> float:
        """Error over what is allowed, whichever is worse; at most 1 is good."""
        shares = [0.0]
        if self.temperature_k is not None:
            shares.append(error.temperature_k / self.temperature_k)
        if self.heat_flow is not None:
            shares.append(error.heat_flow / self.heat_flow)
        return max(shares)

    def describe(self) -> str:
        """Say it in words."""
        parts = [] if self.temperature_k is None else [f"{self.temperature_k:g} K"]
        parts += [] if self.heat_flow is None else [f"{100.0 * self.heat_flow:g} % of the heat flow"]
        return " and ".join(parts)


@dataclass(frozen=True)
class Level:
    """A solution on the way."""

    order: int  # 1 for linear tetrahedra, 2 for quadratic ones
    refinements: int  # How often the size of the given mesh was halved
    step_tolerance_k: float | None  # Error that the time steps are estimated to make, [K]; None for a steady state
    num_nodes: int  # Number of unknowns
    error: ErrorSize  # Estimated errors
    seconds: float  # Time to solve it, [s]

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

    solution: SteadySolution | HeatSolution  # Temperatures and heat flows. Nodes of the given mesh come first
    problem: HeatProblem  # What was solved: the given problem, or the same on a finer mesh
    settings: Level  # Order, refinements and steps that were chosen, and the estimated errors
    met: bool  # Whether the estimated errors are within the tolerance
    status: str  # The outcome as a sentence, with the estimate and the seconds
    seconds: float  # Time for all, [s]
    levels: tuple[Level, ...]  # All solutions on the way, the last one is `settings`


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
    """Solve a problem with order, mesh size and time steps whose estimated error is allowed.

    A steady state is solved with linear tetrahedra on the given mesh first, whose errors `p1_error` estimates from that
    solution alone. If they are too large, quadratic ones follow: the difference of both, and the ratio between the
    recovered errors of their fluxes, tell the errors of both. If these are too large still, quadratic tetrahedra on
    meshes of half the size follow, again and again. Where the solver fails on quadratic tetrahedra, as it may on very
    flat ones, linear ones of half the size follow instead, each with its own estimate. What does not fit into memory
    ends this with the best so far.

    In time tetrahedra stay linear, since the mass of quadratic ones cannot be lumped. Three solutions tell the errors
    of the mesh and of the steps: one on the given mesh, one with all steps halved, one on a mesh of half the size. From
    then on mesh and steps are made as fine as the tolerance asks for. Both errors are added with their signs, node by
    node. The body is the one that the mesh describes: what flat facets lack of a round body's area is not estimated.

    Args:
        problem: Body, materials, initial temperatures and effects.
        tolerance: Allowed errors.
        duration_s: Time to follow the body for, [s]; None: its steady state.
        outputs: Number of equal intervals at whose ends temperatures are kept and compared.
        time_s: Time at which effects that change are taken in a steady state, [s].
        memory_bytes: Most memory that a solution may need, [bytes].
        allow_unmet: Return the best solution that fits into memory, with `met` False and the reason in `status`,
            instead of raising.
        log: Takes a line per solution and one on the outcome; print by default.
        progress: As in `solve_heat`, of each solution through time.

    Raises:
        HeatError: The tolerance cannot be met within the memory, or a solution fails.
    """
    check_positive("memory_bytes", memory_bytes, "Give the memory in bytes, such as 4e9.", HeatError)
    run = _Run(problem, tolerance, float(memory_bytes), log)
    if duration_s is None:
        return run.close(_solve_steady(run, time_s), allow_unmet)
    if tolerance.temperature_k is None:
        remedy = "Give temperature_k too: steps in time are chosen by it."
        raise HeatError("tolerance", expected="one in kelvin", got="heat_flow only", remedy=remedy)
    steps = AdaptiveSteps(duration_s, _STEPS_OVER_ERROR * tolerance.temperature_k, outputs=outputs)
    return run.close(_solve_in_time(run, steps, progress), allow_unmet)


class _Run:
    """The solutions so far."""

    def __init__(
        self, problem: HeatProblem, tolerance: Tolerance, memory_bytes: float, log: Callable[[str], None]
    ) -> None:
        self.given, self.tolerance, self._memory_bytes, self.say = problem, tolerance, memory_bytes, log
        self._solved: list[tuple[Level, HeatProblem, SteadySolution | HeatSolution]] = []
        self._begin_s = time.perf_counter()

    @property
    def excess(self) -> float:
        """Smallest error of a solution over what is allowed."""
        return min((self.tolerance.excess(level.error) for level, _, _ in self._solved), default=np.inf)

    def add(
        self,
        problem: HeatProblem,
        solution: SteadySolution | HeatSolution,
        seconds: float,
        error: ErrorSize,
        refinements: int,
    ) -> None:
        """Keep a solution, with its estimated errors and the number of times that the mesh size was halved for it."""
        edges, steps_k = 0, None
        if isinstance(solution, SteadySolution):
            edges = len(solution.edge_temperature_c)
        else:
            steps_k = solution.time_error_k
        num_nodes = solution.temperature_c.shape[-1] + edges
        level = Level(2 if edges else 1, refinements, steps_k, num_nodes, error, seconds)
        self._solved.append((level, problem, solution))
        self.say(level.describe())

    def forget(self) -> None:
        """Take back what is estimated better by now."""
        self._solved.clear()

    def lacks_memory(self, order: int, refinements: int, times: int = 1) -> str:
        """Say what a solution on the given mesh with its size halved so often takes; return that it does not fit."""
        needed = peak_bytes(self.given, order=order, refinements=refinements, times=times, adaptive=times > 1)
        where = "the given mesh" if refinements == 0 else f"the mesh size halved {refinements}x"
        what = f"P{order} on {where} needs about {describe_bytes(needed)}"
        if needed <= self._memory_bytes:
            self.say(f"{what} at most.")
            return ""
        return f"{what}, more than the {describe_bytes(self._memory_bytes)} allowed (--memory-gb)"

    def close(self, failure: str, allow_unmet: bool) -> ToleratedSolution:
        """Choose the smallest solution whose error is allowed, or else the best; `failure` says why none is.

        Raises:
            HeatError: The tolerance was not met, or nothing was solved at all.
        """
        if not self._solved:
            remedy = "Allow more memory (--memory-gb), or use a coarser mesh."
            raise HeatError("memory_bytes", expected="room for a first estimate", got=failure, remedy=remedy)

        def rank(solved: tuple[Level, HeatProblem, SteadySolution | HeatSolution]) -> tuple[float, float]:
            excess = self.tolerance.excess(solved[0].error)
            return (float(solved[0].num_nodes), excess) if excess <= 1.0 else (np.inf, excess)

        chosen = min(self._solved, key=rank)
        levels = *(solved[0] for solved in self._solved if solved is not chosen), chosen[0]
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
        return ToleratedSolution(chosen[2], chosen[1], last, not failure, status, seconds, levels)


SteadySolver: TypeAlias = Callable[[HeatProblem, int], tuple[SteadySolution, float]]  # Gives the seconds it took too


def _solve_steady(run: _Run, time_s: float) -> str:
    """Find a steady state that is good enough; returns why that was not possible, or nothing."""

    def solve(problem: HeatProblem, order: int) -> tuple[SteadySolution, float]:
        begin_s = time.perf_counter()
        solution = solve_steady(problem, time_s=time_s, order=order, relative_tolerance=_STEADY_TOLERANCE)
        return solution, time.perf_counter() - begin_s

    problem, refinements, apart_k = run.given, 0, 0.0
    failure = run.lacks_memory(1, 0)
    if failure:
        return failure
    before, first_seconds = solve(problem, 1)
    if before.error is not None:
        run.add(problem, before, first_seconds, before.error, 0)
    failure = "" if run.excess <= 1.0 else run.lacks_memory(2, 0)
    if run.excess <= 1.0 or failure:
        return failure
    linear, before_w_k = before, recovered_error_w_k(problem, before)
    problem = replace(problem, initial_temperature_c=before.temperature_c)
    while True:
        try:
            solution, seconds = solve(problem, 2)
        except HeatError as refusal:
            run.say(f"P2 failed: {refusal} Linear tetrahedra of half the size follow.")
            return _halve_linear(run, solve, linear)
        after_w_k = recovered_error_w_k(problem, solution)
        apart = difference_between(before, solution, len(run.given.mesh.points_m))
        decrease = apart.temperature_k / apart_k if apart_k > 0.0 else None
        ratios = error_ratios(before_w_k, after_w_k, decrease)
        error = ErrorSize(
            richardson(apart.temperature_k, ratios.temperature_k), richardson(apart.heat_flow, ratios.heat_flow)
        )
        if refinements == 0:
            both = ErrorSize(error.temperature_k + apart.temperature_k, error.heat_flow + apart.heat_flow)
            run.forget()
            run.add(run.given, before, first_seconds, both, 0)
        run.add(problem, solution, seconds, error, refinements)
        if run.excess <= 1.0:
            return ""
        refinements += 1
        failure = run.lacks_memory(2, refinements)
        if failure:
            return failure
        # The nodes of quadratic tetrahedra are those of the finer mesh.
        start_c = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
        problem = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=start_c)
        before, before_w_k, apart_k = solution, after_w_k, apart.temperature_k


def _halve_linear(run: _Run, solve: SteadySolver, solution: SteadySolution) -> str:
    """Halve the mesh size of linear tetrahedra until their own estimate is allowed; returns what `_solve_steady` does.

    `solution` is that on the given mesh.
    """
    problem, refinements = run.given, 0
    while True:
        refinements += 1
        failure = run.lacks_memory(1, refinements)
        if failure:
            return failure
        start_c = refined_values(problem.mesh, solution.temperature_c)
        problem = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=start_c)
        try:
            solution, seconds = solve(problem, 1)
        except HeatError as refusal:
            return str(refusal)
        if solution.error is not None:
            run.add(problem, solution, seconds, solution.error, refinements)
        if run.excess <= 1.0:
            return ""


class _Refinable:
    """Solves a problem in time on meshes of halved size, with halved steps."""

    def __init__(
        self, problem: HeatProblem, steps: AdaptiveSteps, progress: Callable[[float, int], None] | None
    ) -> None:
        self.problems, self._steps, self._progress = [problem], steps, progress
        self._num_nodes = len(problem.mesh.points_m)
        self._first_steps: GivenSteps | None = None

    def solve(self, refinements: int, halvings: int) -> tuple[HeatSolution, float]:
        """Solve; the first solution, on the given mesh, chooses the steps to halve. Gives the seconds it took too."""
        begin_s = time.perf_counter()
        while len(self.problems) <= refinements:
            coarse = self.problems[-1]
            start_c = refined_values(coarse.mesh, coarse.start_c)
            self.problems.append(replace(coarse, mesh=refine_mesh(coarse.mesh), initial_temperature_c=start_c))
        steps = self._steps if self._first_steps is None else self._first_steps.halved(halvings)
        solution = solve_heat(
            self.problems[refinements], steps, relative_tolerance=_STEP_TOLERANCE, progress=self._progress
        )
        if self._first_steps is None:
            self._first_steps = GivenSteps(self._steps.duration_s, solution.step_lengths_s, self._steps.tolerance_k)
        return solution, time.perf_counter() - begin_s


def _solve_in_time(run: _Run, steps: AdaptiveSteps, progress: Callable[[float, int], None] | None) -> str:
    """Follow a body through time well enough; returns why that was not possible, or nothing.

    The error of m halvings of the mesh and j of the steps is of_mesh * left^m + of_steps * HALVED^j. There left is
    HALVED, except for heat flows if a surface is suddenly held at a temperature: half an element around it has it at
    once, heat that no flow accounts for and that halves with the size.
    """
    failure = run.lacks_memory(1, 1, steps.num_times)
    if failure:
        return failure
    num_nodes, num_values = len(run.given.mesh.points_m), len(run.given.mesh.points_m) * steps.num_times
    body = _Refinable(run.given, steps, progress)
    solved = {choice: body.solve(*choice) for choice in ((0, 0), (0, 1), (1, 0))}
    values = {choice: compared_values(solution, num_nodes) for choice, (solution, _) in solved.items()}
    first = values[0, 0]
    left = np.full(len(first), HALVED)
    if np.any(solved[0, 0][0].temperature_c[0] != run.given.start_c):
        left[num_values:] = _SUDDENLY_HELD
    of_steps, of_mesh = (first - values[0, 1]) / (1.0 - HALVED), (first - values[1, 0]) / (1.0 - left)

    def error(choice: tuple[int, int]) -> ErrorSize:
        total = of_mesh * left ** choice[0] + of_steps * HALVED ** choice[1]
        return error_size(total, solved[1, 0][0])

    def keep(choice: tuple[int, int]) -> None:
        (solution, seconds), of_halved = solved[choice], HALVED ** choice[1] * of_steps[:num_values]
        solution = replace(solution, time_error_k=float(np.max(np.abs(of_halved))))
        run.add(body.problems[choice[0]], solution, seconds, error(choice), choice[0])

    for choice in tuple(solved):
        keep(choice)
    halvings = range(_MOST_HALVINGS + 1)
    choices = sorted(product(halvings, halvings), key=lambda choice: _MESH_COST ** choice[0] * _STEP_COST ** choice[1])
    while run.excess > 1.0:
        open_choices = (choice for choice in choices if choice not in solved)
        choice = next((choice for choice in open_choices if run.tolerance.excess(error(choice)) <= _AIM), None)
        if choice is None:
            return f"It would take more than {_MOST_HALVINGS} halvings of the mesh size or of the steps"
        failure = run.lacks_memory(1, choice[0], steps.num_times)
        if failure:
            return failure
        solved[choice] = body.solve(*choice)
        change = first - compared_values(solved[choice][0], num_nodes)
        mesh_gain, steps_gain = 1.0 - left ** choice[0], 1.0 - HALVED ** choice[1]
        if choice[0] > 0:
            of_mesh = (change - of_steps * steps_gain) / mesh_gain
        else:
            of_steps = change / steps_gain
        keep(choice)
    return ""
