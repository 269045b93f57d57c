"""Which linear solver: the one that is cheap to set up, until it has shown that it is slow."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.fem.linear_solver import ConjugateGradients, LinearSolution
from thermoxels_ns.fem.multigrid import MultigridConjugateGradients
from thermoxels_ns.fem.sweep_preconditioner import SweptConjugateGradients, suits_sweeps

Vector = npt.NDArray[np.float64]

PATIENCE = 1000
"""Iterations within one solution before multigrid takes over where it stands.

Measured on lattices of 15,000 to 230,000 nodes: one multigrid iteration costs as much as 30 with the diagonal or 26
between sweeps, its set-up as much as 300, and it needs about 20 to 24. It is the faster one for a single solution that
takes more than 900 to 1000 of the others."""
PATIENCE_WHEN_REPEATED = 600
"""The same for a matrix that is used again, when its set-up is paid once."""


class LinearSolver:
    """Solver for A x = b, one matrix and many right-hand sides, that picks its preconditioner by what it measures."""

    def __init__(self, matrix: sparse.csr_matrix, *, relative_tolerance: float = 1e-12) -> None:
        """Set up sweeps where the numbering of the nodes suits them, and the diagonal preconditioner elsewhere.

        Args:
            matrix: A, symmetric positive definite, shape (n, n).
            relative_tolerance: Stop when ||b - A x|| <= relative_tolerance * ||b||.

        Raises:
            HeatError: If an entry is not finite or a diagonal entry is not above 0.
        """
        self._matrix = matrix
        self._relative_tolerance = relative_tolerance
        self._swept = suits_sweeps(matrix)
        kind = SweptConjugateGradients if self._swept else ConjugateGradients
        self._plain = kind(matrix, relative_tolerance=relative_tolerance, max_iterations=PATIENCE)
        self._multigrid: MultigridConjugateGradients | None = None
        self._slow = False

    @property
    def name(self) -> str:
        """What preconditions the last solution, for reports."""
        if self._multigrid is not None:
            return "multigrid"
        return "incomplete factor" if self._swept else "diagonal"

    def solve(self, right_hand_side: Vector, start: Vector | None = None) -> LinearSolution:
        """Solve A x = b.

        Args:
            right_hand_side: b, shape (n,).
            start: Where to start from, shape (n,); None: from 0. It changes the number of iterations only.
        """
        if self._multigrid is None and not self._slow:
            plain = self._plain.solve(right_hand_side, start)
            self._slow = plain.iterations > PATIENCE_WHEN_REPEATED
            # A breakdown after few iterations is not slowness, and no preconditioner mends it.
            if plain.converged or plain.iterations < PATIENCE:
                return plain
            start = plain.x if np.all(np.isfinite(plain.x)) else None
        if self._multigrid is None:
            self._multigrid = MultigridConjugateGradients(self._matrix, relative_tolerance=self._relative_tolerance)
        return self._multigrid.solve(right_hand_side, start)
