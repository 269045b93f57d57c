"""Conjugate gradients preconditioned by algebraic multigrid (smoothed aggregation, by pyamg)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.linear_solver import LinearSolution, is_solved

Vector = npt.NDArray[np.float64]

_COARSEST = 300
"""Nodes of the level that is solved directly."""
_SMALLEST_PIVOT = 1e-13
"""Share of the diagonal below which a pivot of that level is round-off; what it stands for is left out."""


class MultigridConjugateGradients:
    """Solver for A x = b whose number of iterations hardly grows with the mesh; dear to set up.

    Plain aggregation without a strength threshold, one forward Gauss-Seidel sweep before and one backward sweep after
    the coarse correction: symmetric, as conjugate gradients need it.

    Prolongations are smoothed by row sums instead of estimates of a spectral radius, and the last level is factored
    here: pyamg's own ways start from random vectors and add up in BLAS, whose sums depend on the number of its threads.
    Both take the same number of iterations.
    """

    def __init__(
        self, matrix: sparse.csr_matrix, *, relative_tolerance: float = 1e-12, max_iterations: int = 500
    ) -> None:
        """Set up the levels.

        Args:
            matrix: A, symmetric positive definite, shape (n, n).
            relative_tolerance: Stop when ||b - A x|| <= relative_tolerance * ||b||.
            max_iterations: Give up after this many iterations.
        """
        from pyamg import smoothed_aggregation_solver

        levels = smoothed_aggregation_solver(
            matrix,
            smooth=("jacobi", {"weighting": "local"}),
            presmoother=("gauss_seidel", {"sweep": "forward"}),
            postsmoother=("gauss_seidel", {"sweep": "backward"}),
            improve_candidates=None,
            max_coarse=_COARSEST,
            coarse_solver=_DirectSolver(),
        )
        self._matrix = matrix
        self._norm = float(np.max(np.asarray(abs(matrix).sum(axis=1))))
        self._precondition = levels.aspreconditioner(cycle="V").matvec
        self._relative_tolerance = relative_tolerance
        self._max_iterations = max_iterations

    def solve(self, right_hand_side: Vector, start: Vector | None = None) -> LinearSolution:
        """Solve A x = b; the residual of x itself decides, as in `ConjugateGradients`.

        Args:
            right_hand_side: b, shape (n,).
            start: Where to start from, shape (n,); None: from 0. It changes the number of iterations only.
        """
        scale = float(np.max(np.abs(right_hand_side))) or 1.0
        b = right_hand_side / scale
        x = np.zeros_like(b) if start is None else start / scale
        size = _norm(b)
        tolerance = self._relative_tolerance * size
        count = self._iterate(b, x, tolerance)
        error = _norm(b - self._matrix @ x)
        residual = error / size if size > 0.0 else error
        converged = is_solved(error, tolerance, size, self._norm * _norm(x))
        name = "Conjugate gradients with multigrid"
        if converged:
            status = f"{name} converged in {count} iterations to a relative residual of {residual:.1e}."
        else:
            status = f"{name} stopped after {count} iterations at a relative residual of {residual:.1e}."
        return LinearSolution(scale * x, count, residual, converged, status)

    def _iterate(self, b: Vector, x: Vector, tolerance: float) -> int:
        """Move x until the recursion's residual is within the tolerance; returns the number of iterations."""
        r = b - self._matrix @ x
        direction, before = np.zeros_like(b), 1.0
        for count in range(self._max_iterations):
            if _norm(r) <= tolerance:
                return count
            z = self._precondition(r)
            now = _dot(r, z)
            direction = z + (now / before) * direction
            image = self._matrix @ direction
            energy = _dot(direction, image)
            if not energy > 0.0:
                return count
            x += (now / energy) * direction
            r -= (now / energy) * image
            before = now
        return self._max_iterations


class _DirectSolver:
    """Solver of the last level, whose matrix is always the same; its factor is made when it is first asked."""

    def __init__(self) -> None:
        self._factor: npt.NDArray[np.float64] | None = None

    def __call__(self, matrix: sparse.csr_matrix, right_hand_side: Vector) -> Vector:
        if self._factor is None:
            self._factor = np.ascontiguousarray(matrix.toarray(), np.float64)
            _factorise(self._factor)
        x = np.array(right_hand_side, np.float64).ravel()
        _solve(self._factor, x)
        return x.reshape(np.shape(right_hand_side))


@kernel
def _factorise(matrix):
    """Turn the lower triangle into that of its Cholesky factor; a row whose pivot vanishes has an infinite one."""
    for i in range(len(matrix)):
        smallest = _SMALLEST_PIVOT * matrix[i, i]
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if j < i:
                matrix[i, j] = rest / matrix[j, j]
            else:
                matrix[i, i] = math.sqrt(rest) if rest > smallest else np.inf


@kernel
def _solve(factor, x):
    """Forward and backward substitution in place."""
    for i in range(len(x)):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for back in range(len(x)):
        i = len(x) - 1 - back
        x[i] /= factor[i, i]
        for k in range(i):
            x[k] -= factor[i, k] * x[i]


def _dot(a: Vector, b: Vector) -> float:
    # Not by BLAS, whose sum depends on the number of its threads.
    return float(np.sum(a * b))


def _norm(vector: Vector) -> float:
    return float(np.sqrt(_dot(vector, vector)))
