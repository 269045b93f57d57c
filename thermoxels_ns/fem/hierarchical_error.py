"""The error of linear tetrahedra in a steady state, as what a bubble on every edge would roughly add."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.edge_exchange import EdgeExchange, EdgeSpace
from thermoxels_ns.fem.edge_operator import EdgeOperator
from thermoxels_ns.fem.hierarchical_error_in_time import Surplus
from thermoxels_ns.fem.matrix_parts import block_of
from thermoxels_ns.fem.solver_choice import LinearSolver
from thermoxels_ns.fem.steady import heat_of_groups_w
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

_SOLVER_TOLERANCE = 1e-2
"""Relative tolerance of the linear solver: of an error, two digits are enough."""
_SWEEPS = 2
"""How often bubbles and nodes take turns."""
_FOUND = 0.87
"""Share of the error that the estimate finds then. Measured at the worst node: 0.7 to 0.8 on spherical shells, 0.9 to 1
on building corners, 0.8 to 1 where given temperatures meet convection or radiation and at conductivities of 0.04 beside
50, 0.9 with sources, 0.7 where a given temperature or flux varies along the surface."""


def steady_surplus(system: HeatSystem, relative_k: Vector, time_s: float = 0.0) -> Surplus:
    """Estimate the error that the mesh makes in a steady state of linear tetrahedra.

    A bubble on every edge beside the linear functions makes quadratic tetrahedra of them. The bubbles' equations are
    nearly diagonal (Deuflhard, Leinen and Yserentant 1989): a step of steepest descent all but solves them, and the
    nodes follow by a rough solution with linear tetrahedra; both take two turns. No matrix of quadratic tetrahedra is
    made, which would take ten times the memory and five times as long.

    Args:
        system: The equations of linear tetrahedra.
        relative_k: Their solution, relative to the system's reference, shape (n,), [K].
        time_s: Time at which effects that change are taken, [s].

    Returns:
        One row.

    Raises:
        HeatError: The equations of the error could not be solved.
    """
    bubbles, follow = _Bubbles(system, relative_k, time_s), _Followers(system, relative_k, time_s)
    nodal_k = change_k = np.zeros(system.num_nodes)
    for sweep in range(_SWEEPS):
        if sweep:
            bubbles.take(change_k)
        bubbles.descend()
        change_k = follow.balance(bubbles.nodes_w)
        nodal_k = nodal_k + change_k
    added_w = bubbles.flows_w(nodal_k) - heat_of_groups_w(system, relative_k, time_s)
    return Surplus(nodal_k[None] / _FOUND, added_w[None] / _FOUND, system.groups)


class _Bubbles:
    """The equations of the bubbles at the temperatures of linear tetrahedra."""

    def __init__(self, system: HeatSystem, relative_k: Vector, time_s: float) -> None:
        problem = system.problem
        mesh = problem.mesh
        self._relative_k, self._time_s = relative_k, time_s
        self._num_nodes = len(mesh.points_m)
        edges = system.space.edges
        self._low, self._high = edges.smaller_nodes(), edges.other
        self._space = EdgeSpace(system.space.selection, edges)
        self._operator = EdgeOperator(problem, self._space.tet_edges, len(edges.other))
        self._exchange = EdgeExchange(problem, self._space, system.reference_c)
        self._everywhere_k = self._with_means(relative_k)
        self._slopes = self._exchange.slopes(self._everywhere_k, time_s)
        self._diagonal = self._operator.edge_diagonal() + self._exchange.diagonal(self._slopes)[self._num_nodes :]
        nodes_w, edges_w = self._split(self._exchange.heat(self._everywhere_k, time_s))
        # What nodes have in balance is conduction and what linear tetrahedra take for the exchange.
        self.nodes_w: Vector = nodes_w - system.exchanged_heat(relative_k, time_s)[0]
        """Heat that nodes lack of their balance, shape (n,), [W]."""
        self._edges_w = edges_w - self._operator.conducted_to_edges(relative_k)
        self._bubble, fixed = np.zeros(len(self._high)), self._exchange.fixed
        on_edges = fixed.nodes >= self._num_nodes
        self._given = fixed.nodes[on_edges] - self._num_nodes
        if len(self._given):
            # What given temperatures are above the means of the edges' ends.
            given_k = fixed.temperature_k(time_s) - self._everywhere_k[fixed.nodes]
            self._bubble[self._given] = given_k[on_edges]
            self._less(*self._taken(self._bubble))

    def descend(self) -> None:
        """Take a step of steepest descent, in units of the diagonal."""
        self._edges_w[self._given] = 0.0
        direction = self._edges_w / self._diagonal
        power = float(np.sum(direction * self._edges_w))
        if power > 0.0:
            nodes_w, edges_w = self._taken(direction)
            length = power / float(np.sum(direction * edges_w))
            self._bubble = self._bubble + length * direction
            self._less(length * nodes_w, length * edges_w)

    def take(self, change_k: Vector) -> None:
        """Take what a change that balanced the nodes takes from the edges."""
        edges_w = self._operator.conducted_to_edges(change_k)
        if self._slopes:
            edges_w += self._exchange.taken(self._slopes, self._with_means(change_k))[self._num_nodes :]
        self._less(self.nodes_w, edges_w)

    def flows_w(self, nodal_k: Vector) -> Vector:
        """Heat flow of each group with the bubbles and a change of the nodes, shape (g,), [W]."""
        exchange, fixed = self._exchange, self._exchange.fixed
        full_k = self._everywhere_k + self._with_means(nodal_k)
        full_k[self._num_nodes :] += self._bubble
        flows = exchange.group_heat_w(full_k, self._time_s)
        if len(fixed.nodes) == 0:
            return flows
        nodes_w, edges_w = self._operator.conducted(self._relative_k + nodal_k, self._bubble)
        kept_w = np.concatenate([nodes_w - 0.5 * self._at_ends(edges_w), edges_w])
        kept_w -= exchange.heat(full_k, self._time_s)
        return np.concatenate([flows, fixed.shares @ kept_w[fixed.nodes]])

    def _with_means(self, nodal: Vector) -> Vector:
        """Values of nodes and their means along edges, shape (n + e,)."""
        return np.concatenate([nodal, 0.5 * (nodal[self._low] + nodal[self._high])])

    def _less(self, nodes_w: Vector, edges_w: Vector) -> None:
        self.nodes_w, self._edges_w = self.nodes_w - nodes_w, self._edges_w - edges_w

    def _taken(self, bubble: Vector) -> tuple[Vector, Vector]:
        """Heat that bubbles take from nodes and edges, [W]."""
        nodes_w, edges_w = self._operator.conducted(np.zeros(self._num_nodes), bubble)
        if not self._slopes:
            return nodes_w, edges_w
        change_k = np.concatenate([np.zeros(self._num_nodes), bubble])
        lost_nodes_w, lost_edges_w = self._split(self._exchange.taken(self._slopes, change_k))
        return nodes_w + lost_nodes_w, edges_w + lost_edges_w

    def _split(self, full: Vector) -> tuple[Vector, Vector]:
        """Turn what acts on quadratic functions into what acts on linear ones and bubbles."""
        nodal, edge = full[: self._num_nodes], full[self._num_nodes :]
        return nodal + 0.5 * self._at_ends(edge), edge

    def _at_ends(self, edge: Vector) -> Vector:
        """Sums over the edges at each node, shape (n,)."""
        count = self._num_nodes
        return np.add(np.bincount(self._low, edge, count), np.bincount(self._high, edge, count), dtype=np.float64)


class _Followers:
    """The nodes, which balance with the matrix of linear tetrahedra."""

    def __init__(self, system: HeatSystem, relative_k: Vector, time_s: float) -> None:
        self._system, self._some_fixed = system, len(system.fixed.nodes) > 0
        matrix, free = system.matrix(time_s, np.inf), system.fixed.free
        if system.nonlinear:
            matrix = sparse.csr_matrix(matrix + system.radiation_slope(relative_k, time_s))
        if self._some_fixed:
            matrix = block_of(matrix, free)
        self._solver = LinearSolver(matrix, relative_tolerance=_SOLVER_TOLERANCE)

    def balance(self, nodes_w: Vector) -> Vector:
        """Find the change of the nodes that takes up some heat, shape (n,), [K]."""
        found = self._solver.solve(nodes_w[self._system.fixed.free] if self._some_fixed else nodes_w)
        if not found.converged:
            raise HeatError(f"The error of the mesh could not be estimated. {found.status} Check the mesh's quality.")
        if not self._some_fixed:
            return found.x
        nodal_k = np.zeros(self._system.num_nodes)
        nodal_k[self._system.fixed.free] = found.x
        return nodal_k
