"""The implicit equation of a Runge-Kutta stage or a steady state, by Newton's method if there is radiation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.conjugate_gradients import LinearSolution
from thermoxels_ns.fem.forms import COLDEST_SLOPE_K
from thermoxels_ns.fem.p1_kernels import add_sizes, exact_sum, size_of, weighted_size_of
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
MOST_REFINEMENTS = 6  # Corrections of a solution from its own residual before giving up
_UNBALANCED = 1e-6  # Share of the heat flow that may be left unbalanced, if the linear solver's tolerance allows it
_UNBALANCED_OVER_TOLERANCE = 1e3  # The same over the linear solver's tolerance
_LEVEL = 1e-9  # Differences below this share of the absolute temperature let no heat flow to speak of
_UNEXPLAINED = 1e-11  # Largest share of the stored heat that may be unaccounted for where nodes are fixed
_EPS = float(np.finfo(np.float64).eps)
ROUND_OFF = 8.0 * _EPS  # Round-off of a sum as a share of the sum of sizes


_Correction: TypeAlias = "Callable[[Residual], tuple[Vector, LinearSolution]]"


@dataclass(frozen=True)
class Residual:
    """Heat that is not balanced yet."""

    heat_w: Vector  # At each free node, [W]
    piece_heat_w: Vector  # Summed over each connected piece, without the round-off of what flows inside, [W]
    round_off_w: Vector  # What round-off may leave at each free node, [W]
    piece_round_off_w: Vector  # The same for each piece, [W]
    flows_w: float  # Heat that flows through the body or is stored in it, [W]; at no change not known
    stored_w: float  # Sum of the sizes of what free nodes store, [W]

    @cached_property
    def unbalanced_w(self) -> float:
        """Sum of the sizes of what is not balanced at nodes, [W]."""
        return float(size_of(self.heat_w))

    @cached_property
    def uncertain_w(self) -> float:
        """The same with what round-off may hide, [W]."""
        return self.unbalanced_w + float(np.sum(self.round_off_w))

    def is_balanced(self, share: float) -> bool:
        """Whether no more than a share of the heat flow, or round-off, is left unbalanced."""
        return self.unbalanced_w <= max(share * self.flows_w, float(np.sum(self.round_off_w)))

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
    rest_k: Vector | None
    """Digits of the temperatures below their round-off, shape (n,), [K]; None: not known where no heat is exchanged."""
    uncertain_w: float  # Bound of what is unbalanced at all nodes, [W]
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
            status, nothing = "The temperature is level: nothing flows.", np.zeros_like(first.heat_w)
            outcome = _Outcome(nothing, None, float(np.sum(first.round_off_w)), 0, True, status)
            return balance.solution(outcome, 0)
        if self.system.nonlinear:
            found = newton(balance, len(first.heat_w), relative_tolerance=self._relative_tolerance)
            spent, status = found.linear_iterations, found.status
            if not found.converged:
                return balance.solution(_Outcome(found.u, None, np.inf, spent, False, status), found.iterations)
            linearised: _Correction = lambda rest: balance.correction(found.u, rest)  # noqa: E731
            outcome = self._refined(balance, found.u, found.residual, linearised, spent, status)
            return balance.solution(outcome, found.iterations)
        change, linear = self.correction(self._own_solver, self.held_w_k, first)
        uncertain_w = self._uncertain_w(first, change, linear)
        if not linear.converged:
            return balance.solution(_Outcome(change, None, np.inf, linear.iterations, False, linear.status), 0)
        if np.isfinite(uncertain_w):
            return balance.solution(_Outcome(change, None, uncertain_w, linear.iterations, True, linear.status), 0)

        again: _Correction = lambda rest: self.correction(self._own_solver, self.held_w_k, rest)  # noqa: E731
        rest, spent = balance.residual(change), linear.iterations
        return balance.solution(self._refined(balance, change, rest, again, spent, linear.status), 0)

    def _uncertain_w(self, first: Residual, change: Vector, linear: LinearSolution) -> float:
        """Bound of what a step without fixed nodes leaves unbalanced, [W]; inf if that is worth to be looked at."""
        if self._free is not None or np.isinf(self.step_s):
            return np.inf
        # What the solver left, and what the round-off of the matrix's diagonal hides from it.
        left_w = np.sqrt(len(change)) * linear.residual * _norm(first.heat_w)
        hidden_w = _EPS * weighted_size_of(self.diagonal_w_k, change)
        uncertain_w = left_w + 4.0 * hidden_w + float(np.sum(first.round_off_w))
        stored_w = weighted_size_of(self.system.nodal_mass_j_k, change) / self.step_s
        return uncertain_w if uncertain_w <= self._share * stored_w else np.inf

    def _refined(
        self,
        balance: _Balance,
        u: Vector,
        rest: Residual,
        correction: _Correction,
        iterations: int,
        status: str,
    ) -> _Outcome:
        """Correct a solution by what its residual, from differences, leaves unbalanced, until that is small.

        Temperatures are sums of two numbers meanwhile (iterative refinement with a residual of higher precision:
        Higham, Accuracy and Stability of Numerical Algorithms, chapter 12).
        """
        count = 0
        if rest.uncertain_w <= self._share * rest.flows_w and not self._is_unexplained(rest):
            return _Outcome(u, None, rest.uncertain_w, iterations, True, status)
        now = exact_sum(balance.base_k, self.everywhere(u))
        rest = balance.residual(u, now)
        while count < MOST_REFINEMENTS:
            if rest.is_balanced(self._share) and (count > 0 or not self._is_unexplained(rest)):
                break
            if count > 0 and balance.is_still(now[0]):
                break
            more, linear = correction(rest)
            iterations += linear.iterations
            total, lost = exact_sum(now[0], self.everywhere(more))
            then = exact_sum(total, lost + now[1])
            after = balance.residual(u + more, then)
            count += 1
            if not after.unbalanced_w < rest.unbalanced_w:
                break
            u, now, rest = u + more, then, after
        converged = rest.is_balanced(self._share) or balance.is_still(now[0])
        share = rest.unbalanced_w / rest.flows_w if rest.flows_w > 0.0 else 0.0
        if converged and count > 0:
            status += f" {count} corrections left {rest.unbalanced_w:.1e} W unbalanced, a share of {share:.0e}."
        elif not converged:
            status = (
                f"{rest.unbalanced_w:.1e} W of {rest.flows_w:.1e} W are not balanced after {count} corrections: cells "
                "are too flat, or conductivities or coefficients of convection too far apart, for the digits of "
                "floating point."
            )
        return _Outcome(u, now[1], rest.uncertain_w, iterations, converged, status)

    @cached_property
    def _share(self) -> float:
        return max(_UNBALANCED, _UNBALANCED_OVER_TOLERANCE * self._relative_tolerance)

    @cached_property
    def twice_diagonal_w_k(self) -> Vector:
        """Twice `diagonal_w_k`."""
        return 2.0 * self.diagonal_w_k

    @cached_property
    def diagonal_w_k(self) -> Vector:
        """Diagonal of M / step + K + R, 0 at fixed nodes, shape (n,), [W / K]."""
        return self.everywhere(self.matrix.diagonal())

    def _is_unexplained(self, rest: Residual) -> bool:
        """Whether what a step with fixed nodes leaves to balance is much beside what is stored."""
        if self._free is None or np.isinf(self.step_s):
            return False
        return abs(float(np.sum(rest.heat_w))) > _UNEXPLAINED * rest.stored_w and not rest.is_round_off

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
        pieces_w, none = np.where(self.floating, piece_heat_w, 0.0), np.zeros_like(piece_heat_w)
        balance = Residual(heat_w, pieces_w, nothing, none, 0.0, 0.0)
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


@dataclass(frozen=True)
class _Outcome:
    """A change of the free nodes, shape (m,), [K], and how it was found; fields as in `ImplicitSolution`."""

    u: Vector
    rest_k: Vector | None  # None: what the sum of start and change loses
    uncertain_w: float
    iterations: int
    converged: bool
    status: str


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

    def solution(self, found: _Outcome, newton_iterations: int) -> ImplicitSolution:
        """Temperatures after a change of the free nodes, with how it was found."""
        change_k = self._equation.everywhere(found.u)
        end_k, rest_k, system = self.base_k + change_k, found.rest_k, self._equation.system
        if rest_k is None and system.groups:
            rest_k = exact_sum(self.base_k, change_k)[1]
        fixed = system.fixed.nodes
        if len(fixed):
            change_k[fixed] = self.base_k[fixed] - self._start_k[fixed]
        how = found.uncertain_w, found.iterations, newton_iterations, found.converged, found.status
        return ImplicitSolution(end_k, change_k, rest_k, *how)

    def is_still(self, relative_k: Vector) -> bool:
        """Whether each piece is level, and nothing makes heat flow."""
        system = self._equation.system
        level_k = system.level_k(relative_k)
        apart_k = float(np.max(np.abs(relative_k - level_k)))
        absolute_k = float(np.max(np.abs(level_k))) + abs(system.reference_c + ZERO_CELSIUS_K)
        return apart_k <= _LEVEL * absolute_k and system.is_still(relative_k, self._time_s)

    def residual(self, u: Vector | None = None, now: tuple[Vector, Vector] | None = None) -> Residual:
        """Heat that is not balanced at a change of the temperature; None: at no change.

        `now` are the temperatures after it, with the digits below their round-off; None: they are rounded.
        """
        equation, system, pieces = self._equation, self._equation.system, self._equation.system.pieces
        now_k, rest_k = (self._now(u), None) if now is None else now
        conducted_w, bound_w = system.conducted_heat(now_k, rest_k)
        flows_w, stored_sum_w = float(np.sum(np.abs(conducted_w[system.fixed.nodes]))), 0.0
        heat_w = np.negative(conducted_w, out=conducted_w)
        piece_w, piece_bound_w = np.zeros(pieces.count), np.zeros(pieces.count)
        if system.exchanges:
            exchanged_w, exchanged_bound_w = system.exchanged_heat(now_k, self._time_s, rest_k)
            flows_w += 0.0 if u is None else float(size_of(exchanged_w))
            heat_w += exchanged_w
            bound_w += exchanged_bound_w
            piece_w, piece_bound_w = pieces.sums(exchanged_w), pieces.sums(exchanged_bound_w)
        if u is not None and now is None:
            # That of the temperatures themselves.
            add_sizes(bound_w, equation.twice_diagonal_w_k, now_k)
        if self._given_to_pieces_w is not None:
            piece_w += self._given_to_pieces_w
            piece_bound_w += np.abs(self._given_to_pieces_w)
        if self._given_w is not None:
            heat_w += self._given_w
            bound_w += np.abs(self._given_w)
        if u is not None and np.isfinite(equation.step_s):
            stored_w = system.mass_product(equation.everywhere(u)) / equation.step_s
            stored_sum_w = float(size_of(stored_w))
            heat_w -= stored_w
            bound_w += np.abs(stored_w)
            piece_w -= pieces.sums(stored_w)
            piece_bound_w += pieces.sums(np.abs(stored_w))
        return Residual(
            equation.at_free(heat_w),
            np.where(equation.floating, piece_w, 0.0),
            equation.at_free(np.multiply(bound_w, ROUND_OFF, out=bound_w)),
            ROUND_OFF * piece_bound_w,
            0.5 * (flows_w + stored_sum_w),
            stored_sum_w,
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

    def _now(self, u: Vector | None) -> Vector:
        return self.base_k if u is None else self.base_k + self._equation.everywhere(u)


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
