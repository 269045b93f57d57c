"""The error of linear tetrahedra, as what an unknown in the middle of every edge would add.

The temperature of P1 is put into the equations of P2; what does not balance there is solved for by a few steps of
conjugate gradients, preconditioned by the diagonal and, for what is smooth, by the equations of P1. The number of steps
does not grow with the mesh (additive Schwarz method: Dryja and Widlund 1987; Xu, SIAM Review 34, 1992), so that the
estimate costs a part of a solution with P2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution
from thermoxels_ns.fem.solver_choice import LinearSolver
from thermoxels_ns.fem.steady import heat_of_groups_w
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

_ITERATIONS = 6
_NODE_TOLERANCE = 0.1
"""Both are enough to get what P2 adds to a few percent on the problems of the tests."""
_SHORT = 1e-4
"""Share of an interval over which the rate of a given temperature is measured."""


@dataclass(frozen=True)
class Surplus:
    """What P2 would add to a solution of P1: estimates of minus its error."""

    temperature_k: Vector
    """At the mesh's nodes, shape (s, n), [K]; one row per time, one only in a steady state."""
    group_heat_w: Vector
    """To the heat flow into the body of each effect and patch or region, shape (s, g), [W]."""
    groups: tuple[tuple[str, str], ...]
    """Effect and patch or region of each column."""


class EdgeSurplus:
    """Estimates errors of solutions of one problem."""

    def __init__(self, problem: HeatProblem) -> None:
        """Assemble P1 and P2.

        Args:
            problem: The problem that was solved.
        """
        self._linear = HeatSystem(problem)
        self._quadratic = HeatSystem(problem, lumped=False, order=2)
        # What is left of P2 without its edges: P1 without lumping.
        self._nodes = HeatSystem(problem, lumped=False, lumped_boundary=False)
        self._kept: tuple[float, sparse.csr_matrix, LinearSolver] | None = None

    def of_steady(self, solution: SteadySolution, time_s: float = 0.0) -> Surplus:
        """Estimate the error of a steady state.

        Args:
            solution: From `solve_steady` with linear tetrahedra.
            time_s: Time at which effects that change were taken.

        Raises:
            HeatError: The equations of the nodes could not be solved.
        """
        linear, quadratic = self._linear, self._quadratic
        relative_k = solution.temperature_c - linear.reference_c
        begin_k = quadratic.space.from_mesh_nodes(relative_k)
        end_k = self._corrected(begin_k, None, time_s, np.inf)
        heat_w = heat_of_groups_w(quadratic, end_k, time_s) - heat_of_groups_w(linear, relative_k, time_s)
        added_k = (end_k - begin_k)[: linear.num_nodes]
        return Surplus(added_k[None], heat_w[None], linear.groups)

    def in_time(self, solution: HeatSolution) -> Surplus:
        """Estimate the error that the mesh makes at each of a solution's times.

        The error obeys the heat equation too. It is followed from output to output by backward Euler, with what P2 does
        not balance as its source; so few and long steps are enough for an estimate. Of the heat that flows through surfaces
        with a given temperature the estimate is too large, by up to a factor of 4 where the mesh is too coarse for the
        layer that has been warmed.

        Args:
            solution: From `solve_heat`.

        Returns:
            The surplus at each time, 0 at the start: the mesh's own temperatures are what the body starts from.

        Raises:
            HeatError: The equations of the nodes could not be solved.
        """
        linear, quadratic = self._linear, self._quadratic
        times_s = solution.times_s
        added_k = np.zeros((len(times_s), linear.num_nodes))
        added_w = np.zeros((len(times_s), len(linear.groups)))
        error_k = np.zeros(quadratic.num_nodes)
        for row, (time_s, step_s) in enumerate(zip(times_s[1:], np.diff(times_s)), start=1):
            time_s, step_s = float(time_s), float(step_s)
            relative_k = solution.temperature_c[row] - linear.reference_c
            rate_k_s = self._rate(relative_k, time_s, step_s)
            begin_k = quadratic.space.from_mesh_nodes(relative_k)
            stored_w = quadratic.mass_product(quadratic.space.from_mesh_nodes(rate_k_s) - error_k / step_s)
            end_k = self._corrected(begin_k, stored_w, time_s, step_s)
            stored_w += quadratic.mass_product(end_k - begin_k) / step_s
            error_k = end_k - begin_k
            added_k[row] = error_k[: linear.num_nodes]
            before_w = heat_of_groups_w(linear, relative_k, time_s, linear.mass_product(rate_k_s))
            added_w[row] = heat_of_groups_w(quadratic, end_k, time_s, stored_w) - before_w
        return Surplus(added_k, added_w, linear.groups)

    def _rate(self, relative_k: Vector, time_s: float, step_s: float) -> Vector:
        """How fast temperatures change, [K / s]."""
        rate = self._linear.net_heat(relative_k, time_s)[0] / self._linear.nodal_mass_j_k
        fixed = self._linear.fixed
        if len(fixed.nodes):
            earlier_s = time_s - _SHORT * step_s
            change_k = fixed.temperature_k(time_s) - fixed.temperature_k(earlier_s)
            rate[fixed.nodes] = change_k / (time_s - earlier_s)
        return rate

    def _corrected(self, begin_k: Vector, stored_w: Vector | None, time_s: float, step_s: float) -> Vector:
        """Move temperatures of P2 towards M (T - begin) / step + stored = net heat(T)."""
        system = self._quadratic
        matrix, nodes = self._matrices(begin_k, time_s, step_s)
        end_k = begin_k.copy()
        fixed = system.fixed.nodes
        if len(fixed):
            end_k[fixed] = system.fixed.temperature_k(time_s)
        rest_w = system.net_heat(begin_k, time_s)[0] - matrix @ (end_k - begin_k)
        if stored_w is not None:
            rest_w -= stored_w
        rest_w[fixed] = 0.0
        diagonal, direction, before = matrix.diagonal(), np.zeros_like(rest_w), np.inf
        for _ in range(_ITERATIONS):
            preconditioned = rest_w / diagonal + self._at_nodes(nodes, rest_w)
            now = float(np.sum(rest_w * preconditioned))
            if not now > 0.0:
                break
            direction = preconditioned + (now / before) * direction
            image = matrix @ direction
            image[fixed] = 0.0
            along = now / float(np.sum(direction * image))
            end_k += along * direction
            rest_w -= along * image
            before = now
        return end_k

    def _at_nodes(self, nodes: LinearSolver, heat_w: Vector) -> Vector:
        """Correction by P1, 0 at fixed nodes."""
        space, free = self._quadratic.space, self._nodes.fixed.free
        found = nodes.solve(space.to_mesh_nodes(heat_w)[free])
        if not found.converged:
            raise HeatError(f"The error could not be estimated. {found.status} Check the mesh's quality.")
        nodal_k = np.zeros(self._nodes.num_nodes)
        nodal_k[free] = found.x
        change_k = space.from_mesh_nodes(nodal_k)
        change_k[self._quadratic.fixed.nodes] = 0.0
        return change_k

    def _matrices(self, begin_k: Vector, time_s: float, step_s: float) -> tuple[sparse.csr_matrix, LinearSolver]:
        """Matrix of P2 and solver of P1 with the slope of radiation; kept for steps of the same length without it."""
        linear, quadratic = self._nodes, self._quadratic
        changes = quadratic.matrix_in_time or quadratic.nonlinear
        if self._kept is None or changes or abs(self._kept[0] - step_s) > 1e-9 * step_s:
            matrix, nodes = quadratic.matrix(time_s, step_s), linear.matrix(time_s, step_s)
            if quadratic.nonlinear:
                matrix = sparse.csr_matrix(matrix + quadratic.radiation_slope(begin_k, time_s))
                nodes = nodes + linear.radiation_slope(begin_k[: linear.num_nodes], time_s)
            free = linear.fixed.free
            block = sparse.csr_matrix(sparse.csr_matrix(nodes)[free][:, free])
            self._kept = step_s, matrix, LinearSolver(block, relative_tolerance=_NODE_TOLERANCE)
        return self._kept[1:]

