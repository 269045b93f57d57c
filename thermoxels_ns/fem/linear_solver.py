"""Conjugate gradients for symmetric positive definite matrices, with a check of the true residual."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import sparse

from thermoxels_ns.errors import HeatError, explain
from thermoxels_ns.fem.sparsity import product_and_bound

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
        self._norm = float(np.max(product_and_bound(matrix, np.ones(len(diagonal)))[1]))
        self._diagonal = diagonal
        self._upper = _upper_triangle(matrix)
        self._relative_tolerance = relative_tolerance
        self._max_iterations = max_iterations

    def solve(self, right_hand_side: npt.NDArray[np.float64]) -> LinearSolution:
        """Solve A x = b, starting from 0.

        CG stops by the residual of its recursion, which can drift away from b - A x. The true residual decides:
        it must be within ten times the tolerance, or the backward error ||b - A x|| / (||A|| ||x|| + ||b||) must
        be at the level of round-off (1e-14).
        """
        # In units of its largest entry, so that the squares in the norms neither overflow nor vanish.
        scale = float(np.max(np.abs(right_hand_side))) or 1.0
        b = right_hand_side / scale
        size = _norm(b)
        tolerance = self._relative_tolerance * size
        # A breakdown may leave NaN, which the check below turns into a status.
        x, direction = np.zeros_like(b), np.zeros_like(b)
        count, stopped = _iterate(
            *self._upper, self._diagonal, x, b.copy(), direction, np.empty_like(b), tolerance, self._max_iterations
        )
        error = _norm(b - self._matrix @ x)
        residual = error / size if size > 0 else error
        exact_enough = error <= _RECURSION_SLACK * tolerance
        round_off = error <= _ROUND_OFF * (self._norm * _norm(x) + size)
        converged = bool(np.all(np.isfinite(x))) and (exact_enough or round_off)
        if converged:
            status = f"Converged in {count} iterations to a relative residual of {residual:.1e}."
        else:
            reason = f"stopped after {count} iterations" if stopped else "lost accuracy to round-off"
            status = f"Conjugate gradients {reason} at a relative residual of {residual:.1e}."
        return LinearSolution(scale * x, count, residual, converged, status)


def _norm(vector: npt.NDArray[np.float64]) -> float:
    # Not by BLAS, whose sum depends on the number of its threads.
    return float(np.sqrt(np.sum(np.square(vector))))


def _upper_triangle(matrix: sparse.csr_matrix) -> tuple[npt.NDArray, npt.NDArray, npt.NDArray[np.float64]]:
    """Where each row begins, columns and values of the entries above the diagonal."""
    rows = np.repeat(np.arange(len(matrix.indptr) - 1, dtype=matrix.indices.dtype), np.diff(matrix.indptr))
    above = matrix.indices > rows
    first = np.concatenate([[0], np.cumsum(above)])[matrix.indptr].astype(matrix.indptr.dtype)
    return first, matrix.indices[above], matrix.data[above]


# Arrays are made outside: that takes a third off the time to compile.
@njit(nogil=True, cache=True, error_model="numpy")
def _iterate(first, other, values, diagonal, x, r, direction, image, tolerance, max_iterations):
    """Conjugate gradients from x = 0, r = b. Products read half of the matrix: memory is what they wait for.

    Unsigned indices spare the test for negative ones.

    Returns:
        The number of iterations, and whether they ended before the recursion's residual r was within the tolerance:
        there were too few, or a breakdown.
    """
    n = len(x)
    keep = rz = rr = 0.0
    for i in range(n):
        rr += r[i] * r[i]
        rz += r[i] * r[i] / diagonal[i]
    for count in range(max_iterations):
        if math.sqrt(rr) <= tolerance:
            return count, False
        for i in range(n):
            direction[i] = r[i] / diagonal[i] + keep * direction[i]
            image[i] = diagonal[i] * direction[i]
        energy = 0.0
        for i in range(n):
            total = 0.0
            for k in range(np.uint64(first[i]), np.uint64(first[i + 1])):
                j = np.uint64(other[k])
                total += values[k] * direction[j]
                image[j] += values[k] * direction[i]
            image[i] += total
            energy += direction[i] * image[i]
        if not energy > 0.0:
            return count, True
        along, before = rz / energy, rz
        rz = rr = 0.0
        for i in range(n):
            x[i] += along * direction[i]
            r[i] -= along * image[i]
            rr += r[i] * r[i]
            rz += r[i] * r[i] / diagonal[i]
        keep = rz / before
    return max_iterations, math.sqrt(rr) > tolerance
