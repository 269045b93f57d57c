"""Solver of the implicit equation of a Runge-Kutta stage or of a steady state, by Newton's method."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy import sparse
from scipy.optimize import root_scalar
from scipy.sparse.linalg import LinearOperator, cg
from threadpoolctl import ThreadpoolController

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.forms import COLDEST_SLOPE_K
from thermoxels_ns.fem.system import HeatSystem

Vector = FloatArray

MOST_UNBALANCED = 1e-3
"""Largest unbalanced heat of a converged solution, round-off included, as a share of the heat flow through the body. It
is a tenth of the uncertainty that the geometry of a reconstruction leaves."""
_BALANCED, _BALANCED_OVER_TOLERANCE = 1e-9, 1e3
"""Newton's method ends if the unbalanced share is at most the larger of the first and the second * linear tolerance."""
MAX_ITERATIONS, MOST_CORRECTIONS = 60, 6
"""Largest number of Newton steps before the solver gives up: the first with radiation, the second without."""
_NEWTON_TOLERANCE = 1e-6  # Relative tolerance of the linear solver in a Newton step; the next step corrects the rest
_SAFE = 0.1
"""Largest change in a Newton step, as a share of the absolute temperature, at which a full step is taken without a line
search: the slope of radiation, 4 sigma eps T^3, then changes by no more than a third."""
_SETTLED = 1e-5
"""Largest change in a Newton step, as a share of the absolute temperature, after which the method may end. The error
that is left is about the square of this share."""
_SHORT_OF_LEAST = 0.1  # Relative error of the step length that the line search finds
_ROUND_OFF = 8.0 * float(np.finfo(np.float64).eps)  # Round-off of a sum as a share of the sum of absolute values
PATIENCE = 1500
"""Largest number of iterations with the diagonal as preconditioner; multigrid then continues from the same x. Multigrid
is slow to set up, but its number of iterations hardly depends on the mesh size, flat cells or contrasts."""
PATIENCE_WHEN_REPEATED = 800  # Later solves begin with multigrid if a solve took more iterations than this
MOST_ITERATIONS = 300  # Largest number of iterations with multigrid, which takes 15 to 50 if it helps
LAST_ITERATIONS = 20_000
"""Largest number of iterations with the diagonal after multigrid failed, as on quadratic tetrahedra 100 times as long
as high."""
_PER_UNKNOWN = 10  # Largest number of these last iterations per unknown; without round-off one would be enough


@dataclass(frozen=True)
class LinearSolution:
    """The outcome of `LinearSolver.solve`."""

    x: Vector  # Solution of A x = b, shape (n,)
    iterations: int  # Iterations of conjugate gradients
    converged: bool  # True if the residual fell to the tolerance
    status: str  # Sentence on preconditioner and iterations


class LinearSolver:
    """Solver for A x = b with one symmetric positive definite matrix A and many right-hand sides b.

    Conjugate gradients solve the system of D^-1/2 A D^-1/2 with the diagonal D of A, until the residual's norm is at
    most `relative_tolerance` times the norm of D^-1/2 b. Without this scaling large cells would outweigh small ones.
    """

    def __init__(self, matrix: sparse.csr_matrix, *, relative_tolerance: float = 1e-12) -> None:
        """Scale `matrix`, A; raise `HeatError` if an entry is not finite or a diagonal entry is not above 0."""
        diagonal = matrix.diagonal()
        if not (np.all(np.isfinite(matrix.data)) and np.all(diagonal > 0)):
            expected, bad = "finite entries and a diagonal above 0", np.count_nonzero(~np.isfinite(matrix.data))
            got = f"smallest diagonal entry {np.min(diagonal, initial=np.inf):.3g}, {bad} entries not finite"
            remedy = "Check the units of the mesh, the material and the time step."
            raise HeatError("matrix of the heat problem", expected=expected, got=got, remedy=remedy)
        self._scale = 1.0 / np.sqrt(diagonal)
        scaled = matrix.data * np.repeat(self._scale, np.diff(matrix.indptr))
        scaled *= self._scale[matrix.indices]
        self._scaled = sparse.csr_matrix((scaled, matrix.indices, matrix.indptr), shape=matrix.shape)
        self._relative_tolerance = relative_tolerance
        self._slow = False

    def solve(self, right_hand_side: Vector) -> LinearSolution:
        """Solve A x = b for b of shape (n,); after a failure, `LinearSolution.converged` is False."""
        # b is divided by its largest entry, so that the squares in the norms neither overflow nor vanish.
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
        """Smoothed-aggregation multigrid (pyamg) for the scaled matrix, a symmetric and deterministic preconditioner.
        Row sums ("local") replace a random estimate of the spectral radius. The near-null space B is a constant x."""
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
    """Residual of an implicit equation at trial temperatures: heat that flows in minus heat that is stored."""

    heat_w: Vector  # Residual at each node, 0 at fixed nodes, shape (n,), [W]
    whole_w: float  # Residual of the whole body, summed without conduction, [W]; 0 if there are fixed nodes
    flows_w: float  # Heat that flows through the body or is stored in it, [W]
    round_off_w: float  # Expected round-off of the sum over all free nodes, [W]

    @cached_property
    def unbalanced_w(self) -> float:
        """Sum over the nodes of the residual's absolute value, [W].

        If no off-diagonal entry of the matrix is positive, this sum bounds the error of each effect's heat flow,
        because heat put in at a node leaves through all effects together.
        """
        return float(np.sum(np.abs(self.heat_w)))

    @property
    def is_round_off(self) -> bool:
        """True if both `unbalanced_w` and `whole_w` are no more than round-off."""
        return max(self.unbalanced_w, abs(self.whole_w)) <= self.round_off_w


@dataclass(frozen=True)
class ImplicitSolution:
    """The outcome of `ImplicitEquation.solve`; the temperatures solve the equation only if `converged` is True."""

    relative_k: Vector  # Temperatures T, relative to `HeatSystem.reference_c`, shape (n,), [K]
    change_k: Vector
    """The unknown T - T_0 itself, shape (n,), [K]; a subtraction of temperatures would lose its last digits."""
    unbalanced_w: float  # `Residual.unbalanced_w` plus round-off, [W]
    flows_w: float  # Heat that flows through the body or is stored in it, [W]
    iterations: int  # Iterations of the linear solver
    newton_iterations: int  # Steps of Newton's method; 0 without radiation
    converged: bool  # True if the iterations ended and the heat balances
    status: str  # Sentence on how the iterations ended


class ImplicitEquation:
    """Solver of M (T - T_0) / step = given + load - (K + R) T + radiation(T); step = inf: the steady state.

    M is the mass, K the stiffness and R the convection matrix. The load includes convection's h T_ambient. A stage of a
    diagonally implicit Runge-Kutta scheme has this form; `given` is then the heat from earlier stages. The unknown is
    T - T_0, so that round-off is relative to the change. Without radiation one matrix serves all steps of one length.

    Conduction moves no heat out of a body. If a body has no fixed nodes, its mean change thus follows from the heat
    that it stores and exchanges. In long steps of insulated bodies the matrix is nearly singular and the linear solver
    loses this mean, so the mean is corrected afterwards.
    """

    def __init__(self, system: HeatSystem, time_s: float, step_s: float, *, relative_tolerance: float) -> None:
        """Assemble M / step + K + R at `time_s` for steps of length `step_s`, [s]; inf stands for the steady state."""
        self._system, self._step_s, self._relative_tolerance = system, step_s, relative_tolerance
        self._time_s = time_s
        convection = system.convection_matrix(time_s)
        self._row_sums_w_k: Vector = np.zeros(system.num_nodes)
        """Row sums of the matrix, shape (n,), [W / K]; summed over M / step + R alone, as the row sums of K are 0."""
        if convection is not None:
            self._row_sums_w_k += convection @ np.ones(system.num_nodes)
        self._sizes_w_k: Vector = system.stiffness.diagonal() + self._row_sums_w_k
        """Diagonal of K plus row sums of R, shape (n,), [W / K]; round-off is estimated from it."""
        if np.isfinite(step_s):
            self._row_sums_w_k += system.nodal_mass_j_k / step_s
        self._solvers: dict[float, LinearSolver] = {}

    @cached_property
    def _matrix(self) -> sparse.csr_matrix:
        """The rows and columns of M / step + K + R that belong to free nodes, [W / K]."""
        return self._free_block(self._system.matrix(self._time_s, self._step_s))

    def solve(
        self, start_k: Vector, time_s: float, given_w: Vector | None = None, found_k: Vector | None = None
    ) -> ImplicitSolution:
        """Solve for T at `time_s`, given T_0 = `start_k`, (n,), [K], relative to `HeatSystem.reference_c`.

        If `found_k` (n,) is given, it is T, found elsewhere, and only the heat balance is checked.

        `given_w`, (n,), [W], is the heat of earlier stages; None is 0. Emitted heat increases with the temperature and
        has a symmetric Jacobian, so the solution is the minimum of a convex energy. Newton's direction is a descent
        direction, and a line search finds the step length as the zero of an increasing function. The method therefore
        converges from any start without a damping factor. Without radiation the first step is the solution, and further
        steps correct the error of the linear solver.
        """
        fixed, nonlinear, change_k = self._system.fixed, self._system.nonlinear, np.zeros(self._system.num_nodes)
        if len(fixed.nodes):
            change_k[fixed.nodes] = fixed.temperature_k(time_s) - start_k[fixed.nodes]
        if found_k is not None:
            change_k = found_k - start_k
        rest = self._residual(start_k, change_k, time_s, given_w)
        count, spent, settled = 0, 0, rest.is_round_off or found_k is not None
        status = "The temperature is level: nothing flows." if rest.is_round_off else ""
        balanced = max(_BALANCED, _BALANCED_OVER_TOLERANCE * self._relative_tolerance)
        most = 0 if settled else MAX_ITERATIONS if nonlinear else MOST_CORRECTIONS
        tolerance = _NEWTON_TOLERANCE if nonlinear else self._relative_tolerance
        while count < most and np.isfinite(rest.unbalanced_w):
            now_k = start_k + change_k
            direction, linear = self.correction(rest.heat_w, rest.whole_w, now_k, time_s, tolerance)
            spent, count, status = spent + linear.iterations, count + 1, linear.status
            length = self._length(now_k, direction, rest.heat_w, time_s) if nonlinear else 1.0
            settled = not nonlinear or self._is_short(now_k, direction, _SETTLED)
            then_k = change_k + length * direction
            then = self._residual(start_k, then_k, time_s, given_w)
            better = then.unbalanced_w < 0.5 * rest.unbalanced_w or abs(then.whole_w) < 0.5 * abs(rest.whole_w)
            if better or not settled or then.unbalanced_w < rest.unbalanced_w:
                change_k, rest = then_k, then
            done = settled and (rest.unbalanced_w <= balanced * rest.flows_w or rest.is_round_off or not better)
            if done or not (linear.converged or better):
                break
        if nonlinear and most:
            status = f"Newton's method {'ended' if settled else 'stopped'} after {count} steps. {status}"
        now_k, uncertain_w, flows_w = start_k + change_k, rest.unbalanced_w + rest.round_off_w, rest.flows_w
        if not uncertain_w <= MOST_UNBALANCED * flows_w:
            # The sum over nodes misses heat that one effect brings to a node and another effect takes from this node.
            groups_w = self._system.by_group(self._system.part_heat_w(now_k, time_s))
            flows_w = max(flows_w, 0.5 * float(np.sum(np.abs(groups_w))))
        balances = rest.is_round_off or uncertain_w <= MOST_UNBALANCED * flows_w or self._system.is_still(now_k, time_s)
        if settled and not balances:
            status += (
                f" {uncertain_w:.1e} W of {flows_w:.1e} W are not balanced: cells are too flat, or conductivities or "
                "coefficients of convection too far apart, for the digits of floating point."
            )
        newton = count if nonlinear else 0
        return ImplicitSolution(
            now_k, change_k, uncertain_w, flows_w, spent, newton, converged=settled and balances, status=status
        )

    def correction(
        self, heat_w: Vector, whole_w: float, relative_k: Vector, time_s: float, tolerance: float
    ) -> tuple[Vector, LinearSolution]:
        """Return the Newton step e, (n,), [K]: (M / step + K + R + radiation's slope at `relative_k`) e = `heat_w`.

        `whole_w`, [W], is the sum of `heat_w` (n,) computed without conduction. `tolerance` is relative.
        """
        row_sums_w_k = self._row_sums_w_k
        if self._system.nonlinear:
            slope = self._system.radiation_slope(relative_k, time_s)
            row_sums_w_k = row_sums_w_k + slope @ np.ones(self._system.num_nodes)
            solver = LinearSolver(self._matrix + self._free_block(slope), relative_tolerance=tolerance)
        else:
            if tolerance not in self._solvers:
                self._solvers[tolerance] = LinearSolver(self._matrix, relative_tolerance=tolerance)
            solver = self._solvers[tolerance]
        linear = solver.solve(self._at_free(heat_w))
        change_k = np.zeros(self._system.num_nodes)  # fixed nodes do not change
        change_k[self._system.fixed.free] = linear.x
        if not len(self._system.fixed.nodes):
            change_k += (whole_w - np.sum(row_sums_w_k * change_k)) / np.sum(row_sums_w_k)
        return change_k, linear

    def _at_free(self, nodal: Vector) -> Vector:
        fixed = self._system.fixed
        return nodal[fixed.free] if len(fixed.nodes) else nodal

    def _free_block(self, matrix: sparse.csr_matrix) -> sparse.csr_matrix:
        fixed = self._system.fixed
        return sparse.csr_matrix(matrix[fixed.free][:, fixed.free]) if len(fixed.nodes) else matrix

    def _residual(self, start_k: Vector, change_k: Vector, time_s: float, given_w: Vector | None) -> Residual:
        """Return the residual at the temperatures `start_k` + `change_k`, (n,), [K]; `given_w` as in `solve`."""
        system, now_k = self._system, start_k + change_k
        conducted_w, parts_w = system.conducted_heat(now_k), system.exchange_parts(now_k, time_s)
        if np.isfinite(self._step_s):
            parts_w.append(-system.nodal_mass_j_k * change_k / self._step_s)
        nothing_w, fixed = np.zeros(system.num_nodes), system.fixed.nodes
        kept_w, moved_w = sum(parts_w, nothing_w), sum(map(np.abs, parts_w), nothing_w)
        flows_w = float(np.sum(moved_w) + np.sum(np.abs(kept_w[fixed] - conducted_w[fixed])))
        if given_w is not None:
            kept_w, moved_w = kept_w + given_w, moved_w + np.abs(given_w)
        heat_w = kept_w - conducted_w
        heat_w[fixed] = 0.0
        sizes_w = self._sizes_w_k * np.abs(now_k - now_k.mean())
        round_off_w = _ROUND_OFF * float(np.sum(self._at_free(sizes_w + moved_w)))
        return Residual(heat_w, 0.0 if len(fixed) else float(np.sum(kept_w)), 0.5 * flows_w, round_off_w)

    def _is_short(self, now_k: Vector, direction: Vector, share: float) -> bool:
        """Return whether `direction` changes no absolute temperature by more than `share` of it."""
        kelvin = now_k + self._system.reference_c + ZERO_CELSIUS_K
        return bool(np.all(np.abs(direction) <= share * np.maximum(np.abs(kelvin), COLDEST_SLOPE_K)))

    def _length(self, now_k: Vector, direction: Vector, heat_w: Vector, time_s: float) -> float:
        """Return the step length along a Newton direction: 1, or about the length in [0, 1] of least energy. `heat_w`
        (n,) is the residual at `now_k` (n,), the temperatures before the step."""
        if self._is_short(now_k, direction, _SAFE):
            return 1.0
        free = self._at_free(direction)
        radiated_w = self._system.radiation_load(now_k, time_s)
        constant, curvature = np.sum(direction * (heat_w - radiated_w)), np.sum(free * (self._matrix @ free))

        def rise(length: float) -> float:
            """Return the derivative of the energy at this length: minus the sum of residual times direction."""
            then_w = self._system.radiation_load(now_k + length * direction, time_s)
            return float(length * curvature - constant - np.sum(direction * then_w))

        if rise(0.0) >= 0.0 or rise(1.0) <= 0.0:
            return 1.0
        least = float(np.finfo(np.float64).tiny)
        return root_scalar(
            rise, bracket=(0.0, 1.0), method="brentq", xtol=least, rtol=_SHORT_OF_LEAST, maxiter=1100
        ).root
