"""Through time to a tolerance: how fine a mesh and how many steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.error_budget import ErrorSize, flow_error, mean_flows_w
from thermoxels_ns.fem.error_estimate import HALF_THE_SIZE, richardson
from thermoxels_ns.fem.even_steps import EvenSteps
from thermoxels_ns.fem.floating_components import check_stored
from thermoxels_ns.fem.hierarchical_error_in_time import edge_surplus
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem
from thermoxels_ns.fem.recovered_gradient import curvature_k
from thermoxels_ns.fem.refine_mesh import refine_mesh, refined_values
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.tolerance_run import Run

Vector = npt.NDArray[np.float64]

_TIME_SHARE = 0.6
"""Share of the allowed error that time steps may make."""
_CLOSE = 0.95
"""Share of the allowed error below which that of the mesh is small enough, and shorter steps do the rest."""
_LEAST_TIME_SHARE = 0.05
"""Share of the allowed error that time steps may make at least."""
_HALVING_GAINS = 4.0
"""What half the mesh size may divide an error by. A mesh that turns out too coarse costs a tenth of the next."""
_CLEARLY = 3.0
"""Rough errors over the allowed one from which on no better estimate is needed to know that the mesh is too coarse.
Measured on rods, slabs in wind and cubes: rough errors are 0.3 to 2.5 times the true ones."""
_ROUGH_START = 0.2
"""Share of the allowed error which, if the start makes it on a coarse mesh, a finer one begins with two steps for."""
_STEPS_OVER_ERROR = 10.0
"""Tolerance of adaptive steps over the error that they may make: steps that are controlled to 1 K make an error of 0.03
to 0.07 K in all, because conduction forgets."""
_OF_THE_SUM = 0.4
"""Error of adaptive steps over the sum of their estimates, per square root of their number. Measured on rods, slabs
with convection and radiation, cubes and two days of weather, with steps controlled to 0.05 to 6 K: 0.13 to 0.97."""


@dataclass(frozen=True)
class _Followed:
    """A body followed through time, and the error of the steps."""

    solution: HeatSolution
    """Temperatures and heat flows."""
    error_k: Vector
    """Minus the error of the steps at the outputs, shape (s + 1, n), or, where its sign is unknown, its size, shape
    (1, 1), [K]."""


@dataclass(frozen=True)
class _OfMesh:
    """Error that a mesh makes."""

    error_k: Vector
    """Minus the error at the outputs and nodes of the given mesh, shape (s + 1, n), or, where its sign is unknown, its
    size, shape (1, 1), [K]."""
    of_flow: float
    """Of the heat flow, as a share of it."""

    @property
    def size(self) -> ErrorSize:
        """The largest."""
        return ErrorSize(float(np.abs(self.error_k).max()), self.of_flow)


@dataclass(frozen=True)
class _Base:
    """What the error of a finer mesh is told by: the given mesh's temperatures at the outputs and mean heat flows."""

    temperature_c: Vector
    """Temperatures, shape (s + 1, n), [degrees Celsius]."""
    flows_w: dict[str, float]
    """Mean heat flow of each effect, [W]."""


def follow_to_tolerance(run: Run, steps: AdaptiveSteps, progress: Callable[[float, int], None] | None) -> str:
    """Follow a body through time well enough; returns why that was not possible, or nothing.

    Args:
        run: The problem and the tolerance; takes the solutions.
        steps: Duration and outputs; its tolerance is the allowed error of temperatures, [K].
        progress: As in `solve_heat`, of each solution.
    """
    return _Climb(run, steps, progress).climb()


class _Climb:
    """From the given mesh to finer ones."""

    def __init__(self, run: Run, steps: AdaptiveSteps, progress: Callable[[float, int], None] | None) -> None:
        self._run, self._steps, self._progress = run, steps, progress
        self._num_nodes, self._times = len(run.given.mesh.points_m), steps.outputs + 1
        self._share, self._range_k, self._first_count = _TIME_SHARE, 0.0, 1

    def climb(self) -> str:
        """Find a solution; returns why that was not possible, or nothing."""
        run, refinements = self._run, 0
        problem, failure = run.given, run.lacks_memory(2, 0, 3 * self._times)
        if failure:
            return failure
        base, space = self._begin()
        # Ends of intervals are looked at. Heat that rushes in at the start they may miss, a finer mesh does not.
        while not run.levels or run.excess > 1.0 or (refinements == 0 and run.tolerance.heat_flow is not None):
            excess = run.tolerance.excess(space.size)
            if run.levels and run.excess > 1.0 and excess <= _CLOSE and self._share > _LEAST_TIME_SHARE:
                self._share = max(min(0.5 * self._share, 1.0 - excess), _LEAST_TIME_SHARE)
                self._add(problem, self._follow(problem), space, refinements)
                continue
            halvings = _halvings(excess)
            if run.levels:
                failure = run.lacks_memory(1, refinements + halvings, self._times)
                if failure:
                    return failure
            for _ in range(halvings):
                start_c = refined_values(problem.mesh, problem.start_c)
                problem = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=start_c)
            refinements += halvings
            finer = self._follow(problem)
            space = self._against(base, finer.solution, refinements)
            self._add(problem, finer, space, refinements)
        return ""

    def _begin(self) -> tuple[_Base, _OfMesh]:
        """Follow the given mesh. Where it is clearly too coarse that is no solution; it tells a finer one's error."""
        run, given = self._run, self._run.given
        system = HeatSystem(given)
        check_stored(system, self._steps.duration_s)
        if run.tolerance.heat_flow is not None:
            start_k = system.start_k
            ends_k = float(start_k.min()), float(start_k.max())
            low, high = system.allowed_range_k(ends_k, (0.0, self._steps.duration_s))
            self._range_k = high - low if np.isfinite(high - low) else 0.0

        def starts_well(temperature_c: Vector, error_k: float) -> bool:
            if error_k <= self._allowed_k():
                return True
            # Of a mesh that is left at once, errors of steps are divided as the difference of both meshes is.
            excess = self._rough_excess(temperature_c[None])
            return excess > _CLEARLY and error_k * richardson(1.0, HALF_THE_SIZE ** _halvings(excess)) <= (
                _ROUGH_START * self._steps.tolerance_k
            )

        even = EvenSteps(system, self._steps, self._allowed_k(), starts_well=starts_well, progress=self._progress)
        if even.found and even.start_error_k > _ROUGH_START * self._allowed_k():
            self._first_count = 2
        if even.found and run.tolerance.heat_flow is None:
            excess = self._rough_excess(even.temperature_c)
            if excess > _CLEARLY and not run.lacks_memory(1, _halvings(excess), self._times):
                space = _OfMesh(np.full((1, 1), excess * self._steps.tolerance_k), 0.0)
                return _Base(even.temperature_c, even.mean_flows_w()), space
        first = self._checked(even)
        if first is None:
            first = self._follow(given, system)
        solution = first.solution
        self._range_k = float(np.ptp(solution.temperature_c))
        surplus = edge_surplus(given, solution, system=system)
        rows = surplus.group_heat_w
        # Mean heat flows of intervals, from those at their ends.
        flows_w = surplus.by_effect(np.mean(0.5 * (rows[1:] + rows[:-1]), axis=0))
        space = _OfMesh(surplus.temperature_k, flow_error(flows_w, solution))
        self._add(given, first, space, 0)
        return _Base(solution.temperature_c, mean_flows_w(solution)), space

    def _rough_excess(self, temperature_c: Vector) -> float:
        """Rough error of the given mesh over what is allowed; nothing is rough where heat flows matter."""
        if self._run.tolerance.heat_flow is not None:
            return 0.0
        return curvature_k(self._run.given.mesh, temperature_c) / self._steps.tolerance_k

    def _allowed_k(self) -> float:
        """Error that steps may make, [K]; of heat flows they err by no larger share than of temperatures."""
        tolerance, allowed_k = self._run.tolerance, self._steps.tolerance_k
        if tolerance.heat_flow is not None and self._range_k > 0.0:
            allowed_k = min(allowed_k, tolerance.heat_flow * self._range_k)
        return self._share * allowed_k

    def _follow(self, problem: HeatProblem, system: HeatSystem | None = None) -> _Followed:
        """Take steps whose error is allowed: even ones, or adaptive ones where those do not suit."""
        allowed_k = self._allowed_k()
        even = EvenSteps(
            system or HeatSystem(problem),
            self._steps,
            allowed_k,
            first_count=self._first_count,
            progress=self._progress,
        )
        found = self._checked(even)
        if found is not None:
            return found
        tolerance_k = _STEPS_OVER_ERROR * allowed_k
        while True:
            solution = solve_heat(problem, replace(self._steps, tolerance_k=tolerance_k), progress=self._progress)
            error_k = _of_adaptive_steps(solution)
            if error_k <= allowed_k:
                return _Followed(solution, np.full((1, 1), error_k))
            # A step follows the cube root of the error that it may make, and the error of all steps its square.
            tolerance_k *= min((0.8 * allowed_k / error_k) ** 1.5, 0.25)

    def _checked(self, even: EvenSteps) -> _Followed | None:
        """What even steps found, if it holds and their error is allowed."""
        if not even.found:
            return None
        allowed_k = self._allowed_k()
        solution = even.solution() if float(np.abs(even.errors_k()).max()) <= allowed_k else None
        # Steps that left the range of temperatures have been replaced by shorter ones.
        return None if solution is None or solution.time_error_k > allowed_k else _Followed(solution, even.errors_k())

    def _against(self, base: _Base, solution: HeatSolution, refinements: int) -> _OfMesh:
        """Error of a finer mesh by how it differs from the given one."""
        ratio = HALF_THE_SIZE**refinements
        change_k = solution.temperature_c[:, : self._num_nodes] - base.temperature_c
        change_w = {effect: flow_w - base.flows_w[effect] for effect, flow_w in mean_flows_w(solution).items()}
        return _OfMesh(change_k * richardson(1.0, ratio), richardson(flow_error(change_w, solution), ratio))

    def _add(self, problem: HeatProblem, followed: _Followed, space: _OfMesh, refinements: int) -> None:
        """Keep a solution. Errors of mesh and steps add up, node by node; where a sign is unknown, their sizes do."""
        in_time_k, range_k = followed.error_k[:, : self._num_nodes], float(np.ptp(followed.solution.temperature_c))
        of_flow = float(np.abs(in_time_k).max()) / range_k if range_k > 0.0 else 0.0
        if space.error_k.shape == in_time_k.shape and in_time_k.size > 1:
            error_k = np.abs(space.error_k + in_time_k)
        else:
            error_k = np.abs(space.error_k) + np.abs(in_time_k)
        error = ErrorSize(float(error_k.max()), space.of_flow + of_flow)
        allowed_k = self._allowed_k()
        self._run.add(problem, followed.solution, error, refinements=refinements, step_tolerance_k=allowed_k)


def _halvings(excess: float) -> int:
    return max(int(np.ceil(np.log(max(excess, 1.0)) / np.log(_HALVING_GAINS))), 1)


def _of_adaptive_steps(solution: HeatSolution) -> float:
    """Error of adaptive steps from what their embedded scheme says of each, [K]: far less than the sum."""
    if solution.steps == 0 or not np.isfinite(solution.time_error_k):
        return 0.0
    return _OF_THE_SUM * solution.time_error_k / solution.steps**0.5
