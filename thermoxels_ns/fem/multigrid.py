"""Conjugate gradients preconditioned by algebraic multigrid (smoothed aggregation, by pyamg)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.fem.linear_solver import LinearSolution

Vector = npt.NDArray[np.float64]

_RECURSION_SLACK = 10.0
_ROUND_OFF = 1e-14
_COARSEST = 300
"""Nodes of the level that is solved directly."""


class MultigridConjugateGradients:
    """Solver for A x = b whose number of iterations hardly grows with the mesh; dear to set up.

    Plain aggregation without a strength threshold, one forward Gauss-Seidel sweep before and one backward sweep after
    the coarse correction: symmetric, as conjugate gradients need it.
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

        with _same_numbers():
            levels = smoothed_aggregation_solver(
                matrix,
                presmoother=("gauss_seidel", {"sweep": "forward"}),
                postsmoother=("gauss_seidel", {"sweep": "backward"}),
                improve_candidates=None,
                max_coarse=_COARSEST,
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
        close = error <= max(_RECURSION_SLACK * tolerance, _ROUND_OFF * (self._norm * _norm(x) + size))
        converged = bool(np.all(np.isfinite(x))) and close
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


@contextmanager
def _same_numbers() -> Iterator[None]:
    """Let pyamg, which estimates norms from random vectors, draw the same ones every time, and nobody else notice."""
    before = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(before)


def _dot(a: Vector, b: Vector) -> float:
    # Not by BLAS, whose sum depends on the number of its threads.
    return float(np.sum(a * b))


def _norm(vector: Vector) -> float:
    return float(np.sqrt(_dot(vector, vector)))
