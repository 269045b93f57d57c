"""Conjugate gradients for symmetric positive definite matrices, with a check of the true residual."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import cg

from thermoxels_ns.errors import HeatError, explain

_RECURSION_SLACK = 10.0
_ROUND_OFF = 1e-14


@dataclass(frozen=True)
class LinearSolution:
    """A solution of A x = b and how well it solves it."""

    x: npt.NDArray[np.float64]
    """The solution, shape (n,)."""
    iterations: int
    """Iterations it took."""
    residual: float
    """||b - A x|| / ||b|| computed from x itself, not from the recursion; 0 where b is 0."""
    converged: bool
    """Whether the residual is within the tolerance, or as small as double precision can make it."""
    status: str
    """The outcome as a sentence."""


class ConjugateGradients:
    """Solver for A x = b with one matrix and many right-hand sides; preconditioned by the diagonal (Jacobi)."""

    def __init__(
        self,
        matrix: sparse.csr_matrix,
        *,
        relative_tolerance: float = 1e-12,
        max_iterations: int = 10_000,
    ) -> None:
        """Set up the preconditioner.

        Args:
            matrix: A, symmetric positive definite, shape (n, n).
            relative_tolerance: Stop when ||b - A x|| <= relative_tolerance * ||b||.
            max_iterations: Give up after this many iterations.

        Raises:
            HeatError: If an entry is not finite or a diagonal entry is not above 0.
        """
        diagonal = matrix.diagonal()
        if not (np.all(np.isfinite(matrix.data)) and np.all(diagonal > 0)):
            raise HeatError(
                explain(
                    "matrix of the heat problem",
                    expected="finite entries and a diagonal above 0",
                    got=f"smallest diagonal entry {np.min(diagonal, initial=np.inf):.3g}, "
                    f"{np.count_nonzero(~np.isfinite(matrix.data))} entries not finite",
                    remedy="Check the units of the mesh, the material and the time step.",
                )
            )
        self._matrix = matrix
        self._norm = float(np.max(np.asarray(abs(matrix).sum(axis=1))))
        self._jacobi = sparse.csr_matrix(sparse.diags(np.reciprocal(diagonal)))
        self._relative_tolerance = relative_tolerance
        self._max_iterations = max_iterations

    def solve(self, right_hand_side: npt.NDArray[np.float64]) -> LinearSolution:
        """Solve A x = b, starting from 0.

        CG stops by the residual of its recursion, which can drift away from b - A x. The true residual decides:
        it must be within ten times the tolerance, or the backward error ||b - A x|| / (||A|| ||x|| + ||b||) must
        be at the level of round-off (1e-14).
        """
        count = 0

        def step(_: npt.NDArray) -> None:
            nonlocal count
            count += 1

        # In units of its largest entry, so that the squares in the norms neither overflow nor vanish.
        scale = float(np.max(np.abs(right_hand_side))) or 1.0
        b = right_hand_side / scale
        # A breakdown divides by zero and leaves NaN, which the check below turns into a status.
        with np.errstate(divide="ignore", invalid="ignore"):
            x, stopped = cg(
                self._matrix,
                b,
                rtol=self._relative_tolerance,
                atol=0.0,
                maxiter=self._max_iterations,
                M=self._jacobi,
                callback=step,
            )
        size = float(np.linalg.norm(b))
        error = float(np.linalg.norm(b - self._matrix @ x))
        residual = error / size if size > 0 else error
        exact_enough = error <= _RECURSION_SLACK * self._relative_tolerance * size
        round_off = error <= _ROUND_OFF * (self._norm * float(np.linalg.norm(x)) + size)
        converged = bool(np.all(np.isfinite(x))) and (exact_enough or round_off)
        if converged:
            status = f"Converged in {count} iterations to a relative residual of {residual:.1e}."
        else:
            reason = f"stopped after {count} iterations" if stopped else "lost accuracy to round-off"
            status = f"Conjugate gradients {reason} at a relative residual of {residual:.1e}."
        return LinearSolution(scale * x, count, residual, converged, status)
