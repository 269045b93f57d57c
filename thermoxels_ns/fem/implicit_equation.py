"""The implicit equation of a Runge-Kutta stage or a steady state, by Newton's method if there is radiation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.conjugate_gradients import LinearSolution
from thermoxels_ns.fem.forms import COLDEST_SLOPE_K
from thermoxels_ns.fem.system import HeatSystem, SystemSolver

Vector = npt.NDArray[np.float64]

_ESTIMATE_TOLERANCE = 1e-3  # Relative tolerance of the linear solver for error estimates
_NEWTON_TOLERANCE = 1e-6
"""Relative tolerance of the linear solver in a step of Newton's method: the next step corrects the rest."""
MAX_ITERATIONS = 60  # Newton steps before giving up

_SAFE = 0.1
"""Largest change in a Newton step, as a share of the absolute temperature, at which a full step is taken without a line
search: the slope of radiation, 4 sigma eps T^3, then changes by no more than a third."""
_SETTLED = 1e-5
"""Largest change in a Newton step, as a share of the absolute temperature, after which the method may end: the error
left is about the square of it. A small residual alone is no proof: of a body that cools from 1000 K to 3 K it falls to
1e-10 of the first one while the temperature is still wrong."""
_ENOUGH = 0.5
"""The line search ends where the slope of the energy along the step has fallen to this share of what it was at its
start, or has changed sign and is no larger than that."""
_MOST_SEARCHES = 200  # Bisections of the line search
_UNEXPLAINED = 1e-11  # Largest share of the stored heat that may be unaccounted for where nodes are fixed
_EPS = float(np.finfo(np.float64).eps)
ROUND_OFF = 8.0 * _EPS  # Round-off of a sum as a share of the sum of sizes


@dataclass(frozen=True)
class Residual:
    """Heat that is not balanced yet."""

    heat_w: Vector  # At each free node, [W]
    piece_heat_w: Vector  # Summed over each connected piece, without the round-off of what flows inside, [W]
    round_off_w: Vector  # What round-off may leave at each free node, [W]
    piece_round_off_w: Vector  # The same for each piece, [W]

    @property
    def is_round_off(self) -> bool:
        """Whether it is nothing but round-off, at every node and piece."""
        return _is_within(self.piece_heat_w, self.piece_round_off_w) and _is_within(self.heat_w, self.round_off_w)

    def is_small(self, heat_w: float, before: Residual) -> bool:
        """Whether nodes are within `heat_w` or round-off, and pieces are balanced or no longer get better."""
        nodes = _norm(self.heat_w) <= max(heat_w, _norm(self.round_off_w))
        piece_w = np.abs(self.piece_heat_w)
        balanced = (piece_w <= self.piece_round_off_w) | (piece_w > 0.5 * np.abs(before.piece_heat_w))
        return nodes and bool(np.all(balanced))


@dataclass(frozen=True)
class ImplicitSolution:
    """Temperatures that solve an implicit equation to tolerance, if it converged; the status is a sentence."""

    relative_k: Vector  # Relative to the system's reference, shape (n,), [K]
    change_k: Vector
    """T - T_0 as it was solved for, shape (n,), [K]: the difference of the temperatures has lost its last digits."""
    iterations: int
    newton_iterations: int
    converged: bool
    status: str


class ImplicitEquation:
    """Solver of M (T - T_0) / step = given + load - (K + R) T + radiation(T); step = inf: the steady state.

    A stage of a diagonally implicit Runge-Kutta scheme has this form; `given` is what earlier stages add. The unknown
    is the change T - T_0, which keeps round-off relative to the change. Where radiation is absent the matrix and its
    preconditioner are made once and serve every step of the same length.

    Conduction moves heat within a connected piece and never out of it, because the rows of K sum to 0. The sum of the
    equations over a piece without fixed nodes is therefore a balance of what it stores and exchanges, in which K does
    not appear. The mean change of each such piece is set by this balance instead of being left to the linear solver,
    and what round-off of K T puts into the right-hand side's own sum is taken out: where a piece is insulated or held
    by next to nothing and the step is long, the matrix is all but singular, and the mean would be lost.
    """

    def __init__(self, system: HeatSystem, time_s: float, step_s: float, *, relative_tolerance: float) -> None:
        """Assemble the matrix at a time, for a step of a length, [s]; infinite for a steady state."""
        self.system, self.step_s, self._relative_tolerance = system, step_s, relative_tolerance
        self._free = system.fixed.free if len(system.fixed.nodes) else None
        matrix = system.matrix(time_s, step_s)
        self.matrix: sparse.csr_matrix = self.free_block(matrix)
        """M / step + K + R between free nodes."""
        self.held_w_k: Vector = system.held_w_k(time_s, step_s)
        """Row sums of M / step + R, shape (n,), [W / K]."""
        self.floating: npt.NDArray[np.bool_] = ~system.pieces.touched(system.fixed.nodes)
        """Pieces without fixed nodes, shape (p,)."""
        self.floats = bool(self.floating.any())
        """Whether there are any."""
        self._rough_solver: SystemSolver | None = None

    def solve(
        self, start_k: Vector, time_s: float, given_w: Vector | None = None, given_to_pieces_w: Vector | None = None
    ) -> ImplicitSolution:
        """Find the temperatures at the end from T_0, shape (n,), [K].

        Earlier stages give `given_w`, shape (n,), and its sum over each piece without the round-off of conduction,
        shape (p,), [W].
        """
        balance = _Balance(self, start_k, time_s, given_w, given_to_pieces_w)
        first = balance.residual()
        if first.is_round_off:
            status = "The temperature is level: nothing flows."
            return ImplicitSolution(balance.base_k, balance.base_k - start_k, 0, 0, True, status)
        if self.system.nonlinear:
            found = newton(balance, len(first.heat_w), relative_tolerance=self._relative_tolerance)
            u, spent = found.u, found.linear_iterations
            rest = self._unexplained(found.residual, u) if found.converged else None
            if rest is not None:
                more, linear = balance.correction(u, rest)
                u, spent = u + more if linear.converged else u, spent + linear.iterations
            return balance.solution(u, spent, found.iterations, found.converged, found.status)
        change, linear = self.correction(self._own_solver, self.held_w_k, first)
        iterations = linear.iterations
        rest = None
        if linear.converged and self._may_be_unexplained:
            rest = self._unexplained(balance.residual(change), change)
        if rest is not None:
            more, again = self.correction(self._own_solver, self.held_w_k, rest)
            iterations += again.iterations
            change = change + more if again.converged else change
        return balance.solution(change, iterations, 0, linear.converged, linear.status)

    @property
    def _may_be_unexplained(self) -> bool:
        return self._free is not None and bool(np.isfinite(self.step_s))

    def _unexplained(self, rest: Residual, change: Vector) -> Residual | None:
        """What is left to balance after a step with fixed nodes, if it is much beside what is stored."""
        if not self._may_be_unexplained:
            return None
        stored_w = self.at_free(self.system.mass_product(self.everywhere(change))) / self.step_s
        much = abs(np.sum(rest.heat_w)) > _UNEXPLAINED * np.sum(np.abs(stored_w))
        return rest if much and not rest.is_round_off else None

    @cached_property
    def _own_solver(self) -> SystemSolver:
        return self.system.linear_solver(self.matrix, self._relative_tolerance)

    def damped(self, heat_w: Vector, piece_heat_w: Vector, relative_k: Vector, time_s: float) -> Vector:
        """Solve (M / step + K + R + slope of radiation) e = heat roughly, for error estimates; shape (n,), [K].

        `piece_heat_w` is the heat of each piece without the round-off of conduction; the slope is that at `relative_k`.
        """
        held_w_k = self.held_w_k
        if self.system.nonlinear:
            slope = self.system.radiation_slope(relative_k, time_s)
            matrix = sparse.csr_matrix(self.matrix + self.free_block(slope))
            held_w_k = held_w_k + slope @ np.ones(self.system.num_nodes)
            solver = self.system.linear_solver(matrix, _ESTIMATE_TOLERANCE)
        else:
            if self._rough_solver is None:
                self._rough_solver = self.system.linear_solver(self.matrix, _ESTIMATE_TOLERANCE)
            solver = self._rough_solver
        heat_w = self.at_free(heat_w)
        if not self.floats:
            return self.everywhere(solver.solve(heat_w).x)
        nothing = np.zeros_like(heat_w)
        balance = Residual(heat_w, np.where(self.floating, piece_heat_w, 0.0), nothing, np.zeros_like(piece_heat_w))
        return self.everywhere(self.correction(solver, held_w_k, balance)[0])

    def correction(self, solver: SystemSolver, held_w_k: Vector, residual: Residual) -> tuple[Vector, LinearSolution]:
        """Solve for a change of the free nodes; `held_w_k` are the matrix's row sums, exactly, shape (n,)."""
        if not self.floats:
            linear = solver.solve(residual.heat_w)
            return linear.x, linear
        pieces, full_w = self.system.pieces, self.everywhere(residual.heat_w)
        held = np.where(self.floating, pieces.sums(held_w_k), 1.0)
        # In multiples of the row sums, this shifts the solution by a constant in each piece.
        rest_w = self.at_free(pieces.without_sums(self.floating, full_w, held_w_k, held))
        if _is_within(rest_w, residual.round_off_w, ROUND_OFF, residual.heat_w):
            linear = LinearSolution(np.zeros_like(rest_w), 0, 0.0, True, "Each piece changes as a whole.")
        else:
            linear = solver.solve(rest_w)
        full_k = self.everywhere(linear.x)
        stored_w = pieces.sums(held_w_k * full_k)
        shift = np.where(self.floating, (residual.piece_heat_w - stored_w) / held, 0.0)
        return self.at_free(full_k + pieces.at_nodes(shift)), linear

    def at_free(self, nodal: Vector) -> Vector:
        """Values at the nodes that are not fixed."""
        return nodal if self._free is None else nodal[self._free]

    def free_block(self, matrix: sparse.csr_matrix) -> sparse.csr_matrix:
        """Rows and columns of the nodes that are not fixed."""
        return matrix if self._free is None else sparse.csr_matrix(matrix[self._free][:, self._free])

    def everywhere(self, free: Vector) -> Vector:
        """Put 0 at the fixed nodes."""
        if self._free is None:
            return free
        full = np.zeros(self.system.num_nodes)
        full[self._free] = free
        return full


class _Balance:
    """The residual of an implicit equation as a function of the change of the free nodes."""

    def __init__(
        self,
        equation: ImplicitEquation,
        start_k: Vector,
        time_s: float,
        given_w: Vector | None,
        given_to_pieces_w: Vector | None,
    ) -> None:
        system = equation.system
        self._equation, self._time_s = equation, time_s
        self._given_w, self._given_to_pieces_w = given_w, given_to_pieces_w
        self.base_k, self._start_k = start_k, start_k
        if len(system.fixed.nodes):
            self.base_k = start_k.copy()
            self.base_k[system.fixed.nodes] = system.fixed.temperature_k(time_s)
            if np.isfinite(equation.step_s):
                moved_w = system.mass_product(self.base_k - start_k) / equation.step_s
                self._given_w = -moved_w if given_w is None else given_w - moved_w

    def solution(
        self, u: Vector, iterations: int, newton_iterations: int, converged: bool, status: str
    ) -> ImplicitSolution:
        """Temperatures after a change of the free nodes, with how it was found."""
        change_k = self._equation.everywhere(u)
        end_k = self.base_k + change_k
        fixed = self._equation.system.fixed.nodes
        if len(fixed):
            change_k[fixed] = self.base_k[fixed] - self._start_k[fixed]
        return ImplicitSolution(end_k, change_k, iterations, newton_iterations, converged, status)

    def residual(self, u: Vector | None = None) -> Residual:
        """Heat that is not balanced at a change of the temperature; None: at no change."""
        equation, system, pieces = self._equation, self._equation.system, self._equation.system.pieces
        now_k = self.base_k if u is None else self.base_k + equation.everywhere(u)
        conducted_w, bound_w = system.conducted_heat(now_k)
        heat_w = np.negative(conducted_w, out=conducted_w)
        piece_w, piece_bound_w = np.zeros(pieces.count), np.zeros(pieces.count)
        if system.exchanges:
            exchanged_w, exchanged_bound_w = system.exchanged_heat(now_k, self._time_s)
            heat_w += exchanged_w
            bound_w += exchanged_bound_w
            piece_w, piece_bound_w = pieces.sums(exchanged_w), pieces.sums(exchanged_bound_w)
        if self._given_to_pieces_w is not None:
            piece_w += self._given_to_pieces_w
            piece_bound_w += np.abs(self._given_to_pieces_w)
        if self._given_w is not None:
            heat_w += self._given_w
            bound_w += np.abs(self._given_w)
        if u is not None and np.isfinite(equation.step_s):
            stored_w = system.mass_product(equation.everywhere(u)) / equation.step_s
            heat_w -= stored_w
            bound_w += np.abs(stored_w)
            piece_w -= pieces.sums(stored_w)
            piece_bound_w += pieces.sums(np.abs(stored_w))
        return Residual(
            equation.at_free(heat_w),
            np.where(equation.floating, piece_w, 0.0),
            equation.at_free(np.multiply(bound_w, ROUND_OFF, out=bound_w)),
            ROUND_OFF * piece_bound_w,
        )

    def correction(self, u: Vector, residual: Residual) -> tuple[Vector, LinearSolution]:
        """Newton's direction."""
        equation, system = self._equation, self._equation.system
        slope = system.radiation_slope(self._now(u), self._time_s)
        held_w_k = equation.held_w_k + slope @ np.ones(system.num_nodes)
        matrix = sparse.csr_matrix(equation.matrix + equation.free_block(slope))
        return equation.correction(system.linear_solver(matrix, _NEWTON_TOLERANCE), held_w_k, residual)

    def is_short(self, u: Vector, direction: Vector, share: float) -> bool:
        """Whether no absolute temperature changes by more than a share of it."""
        kelvin = self._equation.at_free(self._now(u)) + self._equation.system.reference_c + ZERO_CELSIUS_K
        return bool(np.all(np.abs(direction) <= share * np.maximum(np.abs(kelvin), COLDEST_SLOPE_K)))

    def is_lost(self, u: Vector, direction: Vector) -> bool:
        """Whether a direction changes no temperature by more than round-off."""
        size = np.abs(self._equation.at_free(self.base_k)) + np.abs(u)
        return bool(np.all(np.abs(direction) <= _EPS * size))

    def rise(self, u: Vector, direction: Vector) -> Callable[[float], float]:
        """Slope of the energy along a direction: minus the power of the residual."""
        linear_w = self.residual(u).heat_w - self._radiated(u)
        constant = float(np.sum(direction * linear_w))
        curvature = float(np.sum(direction * (self._equation.matrix @ direction)))

        def along(length: float) -> float:
            radiated_w = self._radiated(u + length * direction)
            return length * curvature - constant - float(np.sum(direction * radiated_w))

        return along

    def _radiated(self, u: Vector) -> Vector:
        return self._equation.at_free(self._equation.system.radiation_load(self._now(u), self._time_s))

    def _now(self, u: Vector) -> Vector:
        return self.base_k + self._equation.everywhere(u)


@dataclass(frozen=True)
class _NewtonSolution:
    """A solution u, shape (m,), what it leaves, and how many Newton steps and linear iterations it took."""

    u: Vector
    residual: Residual
    iterations: int
    linear_iterations: int
    converged: bool  # Whether the residual is within the tolerance or as small as round-off, or the next step would be
    status: str


def newton(balance: _Balance, num_unknowns: int, *, relative_tolerance: float) -> _NewtonSolution:
    """Find where the residual vanishes, or is at most a share of the first one, from u = 0.

    Radiation grows with the temperature and its slope is symmetric, so the solution is the one minimum of a convex
    energy. Newton's direction always leads down, and how far to go is a search for the zero of one increasing function
    along it: no damping factor is guessed, and the method converges from any start.
    """
    u = np.zeros(num_unknowns)
    residual = balance.residual(u)
    first = _norm(residual.heat_w)
    spent, reason, count = 0, f"stopped after {MAX_ITERATIONS} steps", 0
    settled, before = False, residual
    while not (settled and residual.is_small(relative_tolerance * first, before)):
        if count == MAX_ITERATIONS or not np.isfinite(_norm(residual.heat_w)):
            share = _norm(residual.heat_w) / first if first > 0.0 else np.inf
            status = f"Newton's method {reason}, at a relative residual of {share:.1e}."
            return _NewtonSolution(u, residual, count, spent, False, status)
        direction, linear = balance.correction(u, residual)
        spent += linear.iterations
        if not linear.converged:
            status = f"Newton's method stopped in step {count + 1}: {linear.status}"
            return _NewtonSolution(u, residual, count, spent, False, status)
        settled, lost = balance.is_short(u, direction, _SETTLED), balance.is_lost(u, direction)
        u = u + _length(balance, u, direction) * direction
        before, residual = residual, balance.residual(u)
        count += 1
        if settled and lost:
            # What is left of the residual is round-off that its bound does not know of, such as that of what was given.
            break
    return _NewtonSolution(u, residual, count, spent, True, f"Newton's method converged in {count} steps.")


def _length(balance: _Balance, u: Vector, direction: Vector) -> float:
    """Find how much of a direction to go: all of it, or about to where the energy along it is least."""
    if balance.is_short(u, direction, _SAFE):
        return 1.0
    rise = balance.rise(u, direction)
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


def _norm(vector: Vector) -> float:
    return float(np.sqrt(np.sum(np.square(vector))))


def _is_within(values: Vector, bounds: Vector, slack: float = 0.0, sizes: Vector | None = None) -> bool:
    """Whether |values| <= bounds + slack * |sizes| everywhere.

    >>> _is_within(np.array([1.0, -2.0]), np.array([1.0, 2.0])), _is_within(np.array([np.nan]), np.array([1.0]))
    (True, False)
    """
    return bool(np.all(np.abs(values) <= (bounds if sizes is None else bounds + slack * np.abs(sizes))))
