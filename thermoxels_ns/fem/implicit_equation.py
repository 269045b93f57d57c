"""The implicit equation of a Runge-Kutta stage or a steady state, by Newton's method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg
from threadpoolctl import ThreadpoolController

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.forms import COLDEST_SLOPE_K
from thermoxels_ns.fem.system import NOTHING, HeatSystem

Vector = npt.NDArray[np.float64]

MOST_UNBALANCED = 1e-3
"""Share of the heat flow that may be unbalanced, round-off included, in an answer: a tenth of what the geometry of a
reconstruction leaves uncertain of it."""
_BALANCED, _BALANCED_OVER_TOLERANCE = 1e-9, 1e3
"""The share at which Newton's method ends; over the tolerance of the linear solver, if that is more."""
MAX_ITERATIONS, MOST_CORRECTIONS = 60, 6
"""Newton steps before giving up with radiation and without."""
_ESTIMATE_TOLERANCE = 1e-3  # Relative tolerance of the linear solver for error estimates
_NEWTON_TOLERANCE = 1e-6
"""The same in a step of Newton's method with radiation: the next step corrects the rest."""
_SAFE = 0.1
"""Largest change in a Newton step, as a share of the absolute temperature, at which a full step is taken without a line
search: the slope of radiation, 4 sigma eps T^3, then changes by no more than a third."""
_SETTLED = 1e-5
"""Largest change in a Newton step, as a share of the absolute temperature, after which the method may end: the error
left is about the square of it."""
_ENOUGH = 0.5
"""The line search ends where the slope of the energy along the step has fallen to this share of what it was at its
start, or has changed sign and is no larger than that."""
_MOST_SEARCHES = 200  # Bisections of the line search
_EPS = float(np.finfo(np.float64).eps)
_ROUND_OFF = 8.0 * _EPS  # Round-off of a sum as a share of the sum of sizes
PATIENCE = 1500
"""Iterations with the diagonal after which multigrid takes over where they stand: it is dear to set up, and its
iterations hardly grow with the mesh, with flat cells or with contrasts."""
PATIENCE_WHEN_REPEATED = 800  # The same for a matrix that is used again, when its set-up is paid once
MOST_ITERATIONS = 300  # With multigrid, which takes 15 to 50 where it helps
LAST_ITERATIONS = 20_000
"""Iterations with the diagonal at the end: multigrid stalls on quadratic tetrahedra 100 times as long as high, these do
not."""
_PER_UNKNOWN = 10  # The same per unknown: without round-off one would be enough
_BLOCK = 1 << 16  # Entries that are scaled at a time, to save memory


@dataclass(frozen=True)
class LinearSolution:
    """A solution x of A x = b, shape (n,); the status is a sentence."""

    x: Vector
    iterations: int
    converged: bool  # Whether the iterations came to the tolerance
    status: str


class LinearSolver:
    """Solver for A x = b with one symmetric positive definite matrix and many right-hand sides.

    Iterations are those of D^-1/2 A D^-1/2, whose diagonal is 1, and end when its residual has fallen to a share of
    what it was: nodes count by the temperature that their heat would change, not by their size.
    """

    def __init__(self, matrix: sparse.csr_matrix, *, relative_tolerance: float = 1e-12) -> None:
        """Scale A; raises `HeatError` if entries are not finite or the diagonal is not above 0."""
        diagonal = matrix.diagonal()
        if not (np.all(np.isfinite(matrix.data)) and np.all(diagonal > 0)):
            expected, bad = "finite entries and a diagonal above 0", np.count_nonzero(~np.isfinite(matrix.data))
            got = f"smallest diagonal entry {np.min(diagonal, initial=np.inf):.3g}, {bad} entries not finite"
            remedy = "Check the units of the mesh, the material and the time step."
            raise HeatError("matrix of the heat problem", expected=expected, got=got, remedy=remedy)
        self._scale = 1.0 / np.sqrt(diagonal)
        scaled = np.repeat(self._scale, np.diff(matrix.indptr))
        scaled *= matrix.data
        for begin in range(0, len(scaled), _BLOCK):
            block = slice(begin, begin + _BLOCK)
            scaled[block] *= self._scale[matrix.indices[block]]
        self._scaled = sparse.csr_matrix((scaled, matrix.indices, matrix.indptr), shape=matrix.shape)
        self._relative_tolerance = relative_tolerance
        self._slow = False

    def solve(self, right_hand_side: Vector) -> LinearSolution:
        """Solve A x = b."""
        # In units of its largest entry, so that the squares in the norms neither overflow nor vanish.
        b = self._scale * right_hand_side
        unit = float(np.max(np.abs(b), initial=0.0)) or 1.0
        x, count, converged = np.zeros_like(b), 0, False
        # Sums by BLAS depend on the number of its threads.
        with _threads().limit(limits=1, user_api="blas"):
            if not self._slow:
                x, count, converged = self._iterate(b / unit, x, PATIENCE, None)
                self._slow = count > PATIENCE_WHEN_REPEATED
            how = "the diagonal"
            if not converged and np.all(np.isfinite(x)):
                x, more, converged = self._iterate(b / unit, x, MOST_ITERATIONS, self._multigrid)
                count, how = count + more, "multigrid"
            if not converged and np.all(np.isfinite(x)):
                x, more, converged = self._iterate(b / unit, x, min(LAST_ITERATIONS, _PER_UNKNOWN * len(b)), None)
                count += more
        outcome = f"converged in {count}" if converged else f"stopped after {count}"
        status = f"Conjugate gradients with {how} {outcome} iterations."
        return LinearSolution(unit * self._scale * x, count, converged, status)

    def _iterate(
        self, b: Vector, start: Vector, most: int, preconditioner: LinearOperator | None
    ) -> tuple[Vector, int, bool]:
        count = 0

        def step(_: Vector) -> None:
            nonlocal count
            count += 1

        x, missed = cg(
            self._scaled, b, start, rtol=self._relative_tolerance, maxiter=most, M=preconditioner, callback=step
        )
        return x, count, missed == 0

    @cached_property
    def _multigrid(self) -> LinearOperator:
        """Smoothed aggregation by pyamg for the scaled matrix, symmetric and without its random starts.

        Row sums stand for estimates of a spectral radius, and what is even in A is even over the scale here.
        """
        from pyamg import smoothed_aggregation_solver

        levels = smoothed_aggregation_solver(
            self._scaled,
            B=(1.0 / self._scale)[:, None],
            strength=("symmetric", {"theta": 0.05}),  # type: ignore[arg-type]  # flat cells couple across alone
            smooth=("jacobi", {"weighting": "local"}),
            presmoother=("gauss_seidel", {"sweep": "forward"}),
            postsmoother=("gauss_seidel", {"sweep": "backward"}),
            improve_candidates=None,
            max_coarse=300,
            coarse_solver="pinv",
        )
        return levels.aspreconditioner(cycle="V")


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()


@dataclass(frozen=True)
class Residual:
    """Heat that is not balanced at some temperatures."""

    heat_w: Vector  # At each node, 0 at fixed ones, shape (n,), [W]
    piece_w: Vector
    """In each piece without fixed nodes, without the round-off of what is conducted inside, shape (p,), [W]."""
    moved_w: Vector  # Sum of the sizes of what is exchanged and stored in each piece, shape (p,), [W]
    flows_w: float  # Heat that flows through the body or is stored in it, [W]
    round_off_w: float  # What floating point leaves of the sums of all nodes, [W]

    @cached_property
    def is_round_off(self) -> bool:
        """Whether it is nothing but round-off, at all nodes together and in every piece."""
        in_pieces = bool(np.all(np.abs(self.piece_w) <= _ROUND_OFF * self.moved_w))
        return in_pieces and self.unbalanced_w <= self.round_off_w

    @cached_property
    def unbalanced_w(self) -> float:
        """Sum of the sizes of what is not balanced at nodes, [W].

        No effect's heat flow is wrong by more, where the matrix has no entry above 0 off its diagonal: heat that is put
        in at a node leaves through all effects together.
        """
        return float(np.sum(np.abs(self.heat_w)))

    @cached_property
    def floating_w(self) -> float:
        """Sum of the sizes of what is not balanced in pieces without fixed nodes, [W]."""
        return float(np.sum(np.abs(self.piece_w)))

    @property
    def uncertain_w(self) -> float:
        """What is not balanced at nodes, with what round-off may hide, [W]."""
        return self.unbalanced_w + self.round_off_w


@dataclass(frozen=True)
class ImplicitSolution:
    """Temperatures that solve an implicit equation, if it converged; the status is a sentence."""

    relative_k: Vector  # Relative to the system's reference, shape (n,), [K]
    change_k: Vector
    """T - T_0 as it was solved for, shape (n,), [K]: the difference of the temperatures has lost its last digits."""
    unbalanced_w: float  # Heat that is unbalanced at all nodes, round-off included, [W]
    flows_w: float  # Heat that flows through the body or is stored in it, [W]
    iterations: int
    newton_iterations: int  # 0 without radiation
    converged: bool
    status: str


class ImplicitEquation:
    """Solver of M (T - T_0) / step = given + load - (K + R) T + radiation(T); step = inf: the steady state.

    A stage of a diagonally implicit Runge-Kutta scheme has this form; `given` is what earlier stages add. The unknown
    is the change T - T_0, which keeps round-off relative to the change. Where radiation is absent the matrix and its
    preconditioner are made once and serve every step of the same length.

    Conduction moves heat within a connected piece and never out of it: what a piece without fixed nodes stores and
    exchanges sets its mean change. In long steps of insulated pieces the matrix is all but singular, and the linear
    solver would lose that mean; so it is set apart from it.
    """

    def __init__(self, system: HeatSystem, time_s: float, step_s: float, *, relative_tolerance: float) -> None:
        """Assemble the matrix at a time, for a step of a length, [s]; infinite for a steady state."""
        self.system, self.step_s, self._relative_tolerance = system, step_s, relative_tolerance
        self._free = system.fixed.free if len(system.fixed.nodes) else None
        convection = system.convection_matrix(time_s)
        self.row_sums_w_k: Vector = np.zeros(system.num_nodes)
        """Row sums of M / step + R, shape (n,), [W / K]: of the matrix too, because those of K are 0, but exact."""
        if convection is not None:
            self.row_sums_w_k += convection @ np.ones(system.num_nodes)
        self.sizes_w_k: Vector = system.stiffness.diagonal() + self.row_sums_w_k
        """Diagonal of K + R, about, whose round-off counts, shape (n,), [W / K]."""
        if np.isfinite(step_s):
            self.row_sums_w_k += system.nodal_mass_j_k / step_s
        self.matrix: sparse.csr_matrix = self._free_block(system.matrix(time_s, step_s))
        """M / step + K + R between free nodes."""
        self.floating: npt.NDArray[np.bool_] = ~system.pieces.touched(system.fixed.nodes)
        """Pieces without fixed nodes, shape (p,)."""
        self._rough_solver: LinearSolver | None = None

    def solve(self, start_k: Vector, time_s: float, given_w: Vector | None = None) -> ImplicitSolution:
        """Find the temperatures at the end from T_0, shape (n,), [K]; earlier stages give `given_w`, shape (n,), [W].

        Radiation grows with the temperature and its slope is symmetric, so the solution is the one minimum of a convex
        energy. Newton's direction always leads down, and how far to go is a search for the zero of one increasing
        function along it: no damping factor is guessed, and the method converges from any start. Without radiation its
        first step is the solution, and further ones correct what the linear solver left.
        """
        balance, fixed, nonlinear = _Balance(self, start_k, time_s, given_w), self.system.fixed, self.system.nonlinear
        change_k = np.zeros(self.system.num_nodes)
        if len(fixed.nodes):
            change_k[fixed.nodes] = fixed.temperature_k(time_s) - start_k[fixed.nodes]
        rest = balance.residual(change_k)
        if rest.is_round_off:
            status = "The temperature is level: nothing flows."
            return balance.solution(change_k, rest, 0, 0, status, True)
        balanced = max(_BALANCED, _BALANCED_OVER_TOLERANCE * self._relative_tolerance)
        settled, count, spent, status = False, 0, 0, ""
        most = MAX_ITERATIONS if nonlinear else MOST_CORRECTIONS
        while count < most and np.isfinite(rest.unbalanced_w):
            direction, linear = self._newton_direction(balance, change_k, rest)
            spent, count = spent + linear.iterations, count + 1
            length = _length(balance, change_k, direction) if nonlinear else 1.0
            settled = not nonlinear or balance.is_short(change_k, direction, _SETTLED)
            then_k = change_k + length * direction
            then = balance.residual(then_k)
            better = then.unbalanced_w < 0.5 * rest.unbalanced_w or then.floating_w < 0.5 * rest.floating_w
            if better or not settled or then.unbalanced_w < rest.unbalanced_w:
                change_k, rest = then_k, then
            status = linear.status
            done = settled and (rest.unbalanced_w <= balanced * rest.flows_w or rest.is_round_off or not better)
            if done or not (linear.converged or better):
                break
        if nonlinear:
            status = f"Newton's method {'ended' if settled else 'stopped'} after {count} steps. {status}"
        return balance.solution(change_k, rest, spent, count if nonlinear else 0, status, settled)

    def damped(self, heat_w: Vector, piece_w: Vector, relative_k: Vector, time_s: float) -> Vector:
        """Solve (M / step + K + R + slope of radiation) e = heat roughly, for error estimates; shape (n,), [K].

        `piece_w` is the heat of each piece without the round-off of conduction; the slope is that at `relative_k`.
        """
        row_sums_w_k = self.row_sums_w_k
        if self.system.nonlinear:
            slope = self.system.radiation_slope(relative_k, time_s)
            solver = LinearSolver(self.matrix + self._free_block(slope), relative_tolerance=_ESTIMATE_TOLERANCE)
            row_sums_w_k = row_sums_w_k + slope @ np.ones(self.system.num_nodes)
        else:
            if self._rough_solver is None:
                self._rough_solver = LinearSolver(self.matrix, relative_tolerance=_ESTIMATE_TOLERANCE)
            solver = self._rough_solver
        return self._correction(solver, row_sums_w_k, heat_w, piece_w)[0]

    def _newton_direction(self, balance: _Balance, change_k: Vector, rest: Residual) -> tuple[Vector, LinearSolution]:
        if not self.system.nonlinear:
            return self._correction(self._own_solver, self.row_sums_w_k, rest.heat_w, rest.piece_w)
        slope = balance.radiation_slope(change_k)
        row_sums_w_k = self.row_sums_w_k + slope @ np.ones(self.system.num_nodes)
        solver = LinearSolver(self.matrix + self._free_block(slope), relative_tolerance=_NEWTON_TOLERANCE)
        return self._correction(solver, row_sums_w_k, rest.heat_w, rest.piece_w)

    @cached_property
    def _own_solver(self) -> LinearSolver:
        return LinearSolver(self.matrix, relative_tolerance=self._relative_tolerance)

    def _correction(
        self, solver: LinearSolver, row_sums_w_k: Vector, heat_w: Vector, piece_w: Vector
    ) -> tuple[Vector, LinearSolution]:
        """Solve for a change, shape (n,), [K], that takes up heat; arguments as in `Residual`."""
        if not self.floating.any():
            linear = solver.solve(self.at_free(heat_w))
            return self._everywhere(linear.x), linear
        pieces = self.system.pieces
        held_w_k = np.where(self.floating, pieces.sums(row_sums_w_k), 1.0)

        def share(left_w: Vector) -> Vector:
            return pieces.at_nodes(np.where(self.floating, left_w / held_w_k, 0.0))

        # In multiples of the row sums, this shifts the solution by a constant in each piece.
        rest_w = heat_w - share(pieces.sums(heat_w)) * row_sums_w_k
        if np.sum(np.abs(rest_w)) <= _ROUND_OFF * np.sum(np.abs(heat_w)):
            rest_w = np.zeros_like(rest_w)
        linear = solver.solve(self.at_free(rest_w))
        change_k = self._everywhere(linear.x)
        return change_k + share(piece_w - pieces.sums(row_sums_w_k * change_k)), linear

    def at_free(self, nodal: Vector) -> Vector:
        """Values at the nodes that are not fixed."""
        return nodal if self._free is None else nodal[self._free]

    def _free_block(self, matrix: sparse.csr_matrix) -> sparse.csr_matrix:
        """Rows and columns of the nodes that are not fixed."""
        return matrix if self._free is None else sparse.csr_matrix(matrix[self._free][:, self._free])

    def _everywhere(self, free: Vector) -> Vector:
        """Put 0 at the fixed nodes."""
        if self._free is None:
            return free
        full = np.zeros(self.system.num_nodes)
        full[self._free] = free
        return full


class _Balance:
    """The residual of an implicit equation as a function of the change of all temperatures."""

    def __init__(self, equation: ImplicitEquation, start_k: Vector, time_s: float, given_w: Vector | None) -> None:
        self._equation, self._start_k, self._time_s, self._given_w = equation, start_k, time_s, given_w

    def residual(self, change_k: Vector) -> Residual:
        """Heat that is not balanced after a change of the temperatures, shape (n,), [K]."""
        equation, system, now_k = self._equation, self._equation.system, self._start_k + change_k
        pieces, conducted_w = system.pieces, system.conducted_heat(now_k)
        kept_w, moved_w = np.zeros(system.num_nodes), np.zeros(system.num_nodes)
        if system.exchanges:
            for part_w in system.exchange_parts(now_k, self._time_s):
                kept_w, moved_w = kept_w + part_w, moved_w + np.abs(part_w)
        if np.isfinite(equation.step_s):
            stored_w = system.nodal_mass_j_k * change_k / equation.step_s
            kept_w, moved_w = kept_w - stored_w, moved_w + np.abs(stored_w)
        fixed = system.fixed.nodes
        flows_w = float(np.sum(moved_w) + np.sum(np.abs(kept_w[fixed] - conducted_w[fixed])))
        if self._given_w is not None:
            kept_w, moved_w = kept_w + self._given_w, moved_w + np.abs(self._given_w)
        heat_w = kept_w - conducted_w
        heat_w[fixed] = 0.0
        sizes_w = equation.sizes_w_k * np.abs(pieces.without_means(now_k))
        round_off_w = _ROUND_OFF * float(np.sum(equation.at_free(sizes_w + moved_w)))
        piece_w = np.where(equation.floating, pieces.sums(kept_w), 0.0)
        moved_w = pieces.sums(moved_w)
        return Residual(heat_w, piece_w, moved_w, 0.5 * flows_w, round_off_w)

    def solution(
        self, change_k: Vector, rest: Residual, iterations: int, newton_iterations: int, status: str, settled: bool
    ) -> ImplicitSolution:
        """Judge what was found by what it leaves unbalanced."""
        now_k = self._start_k + change_k
        flows_w = rest.flows_w
        if not rest.uncertain_w <= MOST_UNBALANCED * flows_w:
            # What two effects bring to and take from the same node is not in the sum over nodes.
            groups_w = self._equation.system.group_heat_w(now_k, self._time_s)
            flows_w = max(flows_w, 0.5 * float(np.sum(np.abs(groups_w))))
        balanced = rest.is_round_off or rest.uncertain_w <= MOST_UNBALANCED * flows_w
        converged = settled and (balanced or self._is_still(now_k, rest))
        if settled and not converged:
            status += (
                f" {rest.uncertain_w:.1e} W of {flows_w:.1e} W are not balanced: cells are too flat, or "
                "conductivities or coefficients of convection too far apart, for the digits of floating point."
            )
        how = rest.uncertain_w, flows_w, iterations, newton_iterations, converged, status
        return ImplicitSolution(now_k, change_k, *how)

    def _is_still(self, now_k: Vector, rest: Residual) -> bool:
        """Whether next to nothing flows: all temperatures are equal, or each piece is level and balanced as a whole."""
        equation, system, pieces = self._equation, self._equation.system, self._equation.system.pieces
        if system.is_still(now_k, self._time_s):
            return True
        equal_k = NOTHING * (float(np.abs(now_k).max()) + abs(system.reference_c + ZERO_CELSIUS_K))
        level = bool(np.all(np.abs(pieces.without_means(now_k)) <= equal_k))
        balanced = equation.floating & (np.abs(rest.piece_w) <= MOST_UNBALANCED * rest.moved_w)
        return level and bool(np.all(balanced | (rest.moved_w <= equal_k * pieces.sums(equation.row_sums_w_k))))

    def radiation_slope(self, change_k: Vector) -> sparse.csr_matrix:
        """Minus the derivative of the heat radiated into the body, shape (n, n), [W / K]."""
        return self._equation.system.radiation_slope(self._start_k + change_k, self._time_s)

    def is_short(self, change_k: Vector, direction: Vector, share: float) -> bool:
        """Whether no absolute temperature changes by more than a share of it."""
        kelvin = self._start_k + change_k + self._equation.system.reference_c + ZERO_CELSIUS_K
        return bool(np.all(np.abs(direction) <= share * np.maximum(np.abs(kelvin), COLDEST_SLOPE_K)))

    def rise(self, change_k: Vector, direction: Vector) -> Callable[[float], float]:
        """Slope of the energy along a direction: minus the power of the residual."""
        equation, free = self._equation, self._equation.at_free(direction)
        linear_w = self.residual(change_k).heat_w - self._radiated(change_k)
        constant = float(np.sum(direction * linear_w))
        curvature = float(np.sum(free * (equation.matrix @ free)))

        def along(length: float) -> float:
            radiated_w = self._radiated(change_k + length * direction)
            return length * curvature - constant - float(np.sum(direction * radiated_w))

        return along

    def _radiated(self, change_k: Vector) -> Vector:
        return self._equation.system.radiation_load(self._start_k + change_k, self._time_s)


def _length(balance: _Balance, change_k: Vector, direction: Vector) -> float:
    """Find how much of a direction to go: all of it, or about to where the energy along it is least."""
    if balance.is_short(change_k, direction, _SAFE):
        return 1.0
    rise = balance.rise(change_k, direction)
    start = rise(0.0)
    if start >= 0.0 or rise(1.0) <= _ENOUGH * -start:
        return 1.0
    left, right = 0.0, 1.0
    for _ in range(_MOST_SEARCHES):
        # The zero may lie many powers of ten below 1: a cold body that sees a hot one has next to no slope.
        middle = 0.25 * right if left == 0.0 else 0.5 * (left + right)
        value = rise(middle)
        if abs(value) <= _ENOUGH * -start:
            return middle
        left, right = (middle, right) if value < 0.0 else (left, middle)
    return right
