"""Linear systems by scipy's conjugate gradients, with the diagonal or pyamg's multigrid as preconditioner."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg
from threadpoolctl import ThreadpoolController

from thermoxels_ns.core.errors import HeatError

Vector = npt.NDArray[np.float64]

PATIENCE = 1500
"""Iterations with the diagonal after which multigrid takes over where they stand: it is dear to set up, and its
iterations hardly grow with the mesh, with flat cells or with contrasts."""
PATIENCE_WHEN_REPEATED = 800  # The same for a matrix that is used again, when its set-up is paid once
MOST_ITERATIONS = 500  # With multigrid
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
