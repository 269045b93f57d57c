"""Initial guess of a linear solve from earlier solutions with the same matrix."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel

Vector = npt.NDArray[np.float64]

_KEPT = 3
"""Solutions that are kept: on smooth fields three of them leave a residual of 1e-3 to 1e-5, which saves a third of the
iterations to 1e-12, and a fourth one saves no more."""
_WORTH_IT = 16
"""Iterations from which on a guess pays: to find one costs as much as four of them."""
_DEPENDENT = 1e-10
"""Share of the largest singular value below which combinations count as the same."""


class InitialGuess:
    """The last solutions x_i of A x_i = b_i, scaled to a largest entry of 1.

    The change of one time step resembles those of the steps before it. Among all combinations of the last solutions the
    one is taken that is nearest to the new solution in the norm of the matrix (Fischer, Computer Methods in Applied
    Mechanics and Engineering 163, 1998); since A x_i = b_i is known, no product with the matrix is needed to find it.

    >>> guess = InitialGuess()
    >>> guess.for_right_hand_side(np.array([2.0, 6.0])) is None
    True
    >>> guess.keep(np.array([1.0, 3.0]), np.array([1.0, 1.0]))
    >>> guess.for_right_hand_side(np.array([2.0, 6.0])).tolist()
    [2.0, 2.0]
    """

    def __init__(self) -> None:
        """Begin with none."""
        self._solutions = np.zeros((0, 0))
        self._products = np.zeros((_KEPT, _KEPT))
        self._kept = 0
        self._oldest = 0

    def keep(self, right_hand_side: Vector, solution: Vector, iterations: int = _WORTH_IT) -> None:
        """Add a solution in place of the oldest one; forget all if guesses do not pay.

        Args:
            right_hand_side: b_i, shape (n,).
            solution: x_i, shape (n,).
            iterations: How many it took.
        """
        if iterations < _WORTH_IT:
            self._kept = self._oldest = 0
            self._solutions = np.zeros((0, 0))
            return
        size = float(np.max(np.abs(solution), initial=0.0))
        if not (size > 0.0 and np.isfinite(size)):
            return
        if self._solutions.shape[1] != len(solution):
            self._solutions = np.zeros((_KEPT, len(solution)))
            self._products[:] = 0.0
        place = self._oldest
        np.divide(solution, size, out=self._solutions[place])
        # x_j . A x_i = x_j . b_i; of those that are not there yet it is 0.
        products = _products(self._solutions, right_hand_side) / size
        self._products[place], self._products[:, place] = products, products
        self._oldest, self._kept = (place + 1) % _KEPT, min(self._kept + 1, _KEPT)

    def for_right_hand_side(self, right_hand_side: Vector) -> Vector | None:
        """Combine the solutions for a new right-hand side, shape (n,); None if there are none to combine."""
        if not self._kept:
            return None
        wanted = _products(self._solutions, right_hand_side)
        size = float(np.max(np.abs(wanted)))
        if not (size > 0.0 and np.isfinite(size) and np.isfinite(self._products).all()):
            return None
        shares = np.linalg.lstsq(self._products, wanted / size, rcond=_DEPENDENT)[0]
        return _combined(self._solutions, size * shares)


# Loops instead of BLAS, whose sums depend on the number of its threads.
@kernel(fastmath={"reassoc", "contract"})
def _products(vectors, other):
    products = np.zeros(len(vectors))
    for k in range(len(vectors)):
        total = 0.0
        for i in range(len(other)):
            total += vectors[k, i] * other[i]
        products[k] = total
    return products


@kernel
def _combined(vectors, shares):
    total = np.empty(vectors.shape[1])
    for i in range(len(total)):
        entry = 0.0
        for k in range(len(shares)):
            entry += shares[k] * vectors[k, i]
        total[i] = entry
    return total
