"""What has been solved on the way to a tolerance, and how it ended."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.error_budget import ErrorSize, Tolerance
from thermoxels_ns.fem.memory import describe_bytes, peak_bytes
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution


@dataclass(frozen=True)
class Level:
    """A solution on the way."""

    order: int
    """1 for linear tetrahedra, 2 for quadratic ones."""
    refinements: int
    """How often the size of the given mesh was halved."""
    step_tolerance_k: float | None
    """Error that the time steps may make, [K]; None for a steady state."""
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


class Run:
    """What has been solved so far."""

    def __init__(
        self, problem: HeatProblem, tolerance: Tolerance, memory_bytes: float, log: Callable[[str], None]
    ) -> None:
        """Begin.

        Args:
            problem: What is to be solved.
            tolerance: Allowed errors.
            memory_bytes: Most memory that a solution may need, [bytes].
            log: Takes a line per solution and one on the outcome.
        """
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
        """Keep a solution.

        Args:
            problem: What was solved.
            solution: Its solution.
            error: Its estimated errors.
            refinements: How often the size of the given mesh was halved for it.
            step_tolerance_k: Error that its time steps were allowed, [K]; None for a steady state.
        """
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
        """Say how it ended.

        Args:
            failure: Why the tolerance was not met, or nothing.
            allow_unmet: Return the last solution even so.

        Raises:
            HeatError: The tolerance was not met, or nothing was solved at all.
        """
        if self.solution is None:
            remedy = "Allow more memory, or use a coarser mesh."
            raise HeatError("memory_bytes", expected="room for a first estimate", got=failure, remedy=remedy)
        last, seconds = self.levels[-1], time.perf_counter() - self._begin_s
        allowed = self.tolerance.describe()
        status = f"{'Not within' if failure else 'Within'} {allowed}: {last.describe()}, {seconds:.2f} s in all."
        if failure:
            status += (
                f" {failure}. Allow more memory (--memory-gb) or a larger error, or take what there is (--allow-unmet "
                "True); the worst temperature is often at a sharp edge."
            )
            if last.step_tolerance_k is None and self.tolerance.heat_flow is None:
                status += " Heat flows are met far sooner: ask for them instead (--flow-tolerance 0.01)."
        if failure and not allow_unmet:
            raise HeatError(status)
        self._log(status)
        return ToleratedSolution(self.solution, self.problem, last, not failure, status, seconds, tuple(self.levels))
