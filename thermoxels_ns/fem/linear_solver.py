"""Conjugate gradients for symmetric positive definite matrices, with a check of the true residual."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.sparsity import product_and_bound

Vector = npt.NDArray[np.float64]

_RECURSION_SLACK = 10.0
_ROUND_OFF = 1e-14
_SOLVES_SOMETHING = 0.5
"""No round-off excuses a larger relative residual."""


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


def is_solved(error: float, tolerance: float, right_hand_side: float, matrix_times_solution: float) -> bool:
    """Whether a residual is good enough, for all that iterate.

    It must be within ten times the tolerance, because the residual of a recursion drifts away from b - A x, or its
    backward error ||b - A x|| / (||A|| ||x|| + ||b||) must be at the level of round-off (1e-14). Of a matrix that is
    all but singular, a huge x has a small backward error and need not solve anything: half of b must be explained too.

    Args:
        error: ||b - A x||, from x itself.
        tolerance: What was asked for.
        right_hand_side: ||b||.
        matrix_times_solution: ||A|| ||x||.

    >>> is_solved(5e-12, 1e-12, 1.0, 1.0), is_solved(1e-3, 1e-12, 1.0, 1e12), is_solved(0.9, 1e-12, 1.0, 1e15)
    (True, True, False)
    """
    exact_enough = error <= _RECURSION_SLACK * tolerance
    round_off = error <= _ROUND_OFF * (matrix_times_solution + right_hand_side)
    return math.isfinite(matrix_times_solution) and (
        exact_enough or (round_off and error < _SOLVES_SOMETHING * right_hand_side)
    )


class ConjugateGradients:
    """Solver for A x = b with one matrix and many right-hand sides; preconditioned by the diagonal (Jacobi)."""

    _manner = ""
    """How it iterates, for the status."""

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
                "matrix of the heat problem",
                expected="finite entries and a diagonal above 0",
                got=f"smallest diagonal entry {np.min(diagonal, initial=np.inf):.3g}, "
                f"{np.count_nonzero(~np.isfinite(matrix.data))} entries not finite",
                remedy="Check the units of the mesh, the material and the time step.",
            )
        self._matrix = matrix
        self._norm = float(np.max(product_and_bound(matrix, np.ones(len(diagonal)))[1], initial=0.0))
        self._size = np.sqrt(diagonal)
        """Square roots of the diagonal of the preconditioner, shape (n,): iterations see it as ones."""
        self._upper = _scaled_upper_triangle(matrix, self._size)
        self._relative_tolerance = relative_tolerance
        self._max_iterations = max_iterations

    def solve(
        self, right_hand_side: npt.NDArray[np.float64], start: npt.NDArray[np.float64] | None = None
    ) -> LinearSolution:
        """Solve A x = b.

        CG stops by the residual of its recursion; that of x itself decides, see `is_solved`.

        Args:
            right_hand_side: b, shape (n,).
            start: Where to start from, shape (n,); None: from 0. It changes the number of iterations only.
        """
        # In units of its largest entry, so that the squares in the norms neither overflow nor vanish.
        scale = _largest(right_hand_side) or 1.0
        whole = (self._matrix.indptr, self._matrix.indices, self._matrix.data)
        x, r = np.zeros_like(right_hand_side), np.empty_like(right_hand_side)
        # A breakdown may leave NaN, which the check below turns into a status.
        size, _ = _residual(*whole, right_hand_side, scale, x, r, False)
        if start is not None:
            np.divide(start, scale, out=x)
            if not _residual(*whole, right_hand_side, scale, x, r, True)[0] < size:
                x[:] = 0.0
                _residual(*whole, right_hand_side, scale, x, r, False)
            x *= self._size
        r /= self._size
        tolerance = self._relative_tolerance * size
        count, stopped = self._iterate(x, r, tolerance)
        x /= self._size
        error, length = _residual(*whole, right_hand_side, scale, x, r, True)
        residual = error / size if size > 0 else error
        converged = is_solved(error, tolerance, size, self._norm * length)
        if converged:
            status = f"Converged in {count} iterations{self._manner} to a relative residual of {residual:.1e}."
        else:
            reason = f"stopped after {count} iterations" if stopped else "lost accuracy to round-off"
            status = f"Conjugate gradients {reason} at a relative residual of {residual:.1e}."
        x *= scale
        return LinearSolution(x, count, residual, converged, status)

    def _iterate(self, x: Vector, r: Vector, tolerance: float) -> tuple[int, bool]:
        """Move x, in multiples of 1 / size, until the norm of size * r is within the tolerance.

        Args:
            x: Solution to move, shape (n,).
            r: Residual at it, divided by the sizes, shape (n,); overwritten.
            tolerance: Norm of the residual to reach.

        Returns:
            The number of iterations, and whether they ended before the tolerance was reached.
        """
        direction, image = np.zeros_like(r), np.zeros_like(r)
        return _iterate(*self._upper, self._size, x, r, direction, image, tolerance, self._max_iterations)


def _scaled_upper_triangle(
    matrix: sparse.csr_matrix, size: npt.NDArray[np.float64]
) -> tuple[npt.NDArray, npt.NDArray, npt.NDArray[np.float64]]:
    """Where each row begins, columns and values of the entries above the diagonal of the matrix with ones on it."""
    first = np.zeros_like(matrix.indptr)
    _count_above(matrix.indptr, matrix.indices, first)
    other, values = np.empty(first[-1], matrix.indices.dtype), np.empty(first[-1])
    _take_above(matrix.indptr, matrix.indices, matrix.data, 1.0 / size, first, other, values)
    return first, other, values


@kernel
def _largest(vector):
    largest = 0.0
    for value in vector:
        if not abs(value) <= largest:
            largest = abs(value)
            if largest != largest:
                break
    return largest


@kernel(fastmath={"reassoc", "contract"})
def _residual(indptr, indices, data, b, scale, x, r, moved):
    """Sets r = b / scale - A x, of x = 0 unless it was moved; returns the norms of r and x."""
    rr = xx = 0.0
    for row in range(len(b)):
        left = b[row] / scale
        if moved:
            for k in range(np.uint64(indptr[row]), np.uint64(indptr[row + 1])):
                left -= data[k] * x[np.uint64(indices[k])]
            xx += x[row] * x[row]
        r[row] = left
        rr += left * left
    return math.sqrt(rr), math.sqrt(xx)


@kernel
def _count_above(indptr, indices, first):
    for row in range(len(indptr) - 1):
        count = 0
        for k in range(indptr[row], indptr[row + 1]):
            count += indices[k] > row
        first[row + 1] = first[row] + count


@kernel
def _take_above(indptr, indices, data, scale, first, other, values):
    for row in range(len(indptr) - 1):
        place = first[row]
        for k in range(indptr[row], indptr[row + 1]):
            if indices[k] > row:
                other[place] = indices[k]
                values[place] = data[k] * scale[row] * scale[indices[k]]
                place += 1


# Sums may be regrouped: four at a time, they need not wait for each other. Arrays are made outside, which takes a third
# off the time to compile.
@kernel(fastmath={"reassoc", "contract"})
def _iterate(first, other, values, size, x, r, direction, image, tolerance, max_iterations):
    """Conjugate gradients for a matrix with ones on its diagonal, which need no preconditioner.

    Memory is what they wait for: products read half of the matrix, x moves along with the direction before it, and
    `image` is left at 0 where it is read. Unsigned indices spare the test for negative ones.

    Args:
        first: Where each row begins in `other` and `values`, shape (n + 1,).
        other: Columns above the diagonal.
        values: Their values.
        size: Square roots of the diagonal that the matrix had; the norm that stops is that of size * r.
        x: Solution to move.
        r: Residual at it; overwritten.
        direction: Zeros; overwritten.
        image: Zeros; overwritten.
        tolerance: Norm of the residual to reach.
        max_iterations: Most iterations.

    Returns:
        The number of iterations, and whether they ended before the recursion's residual was within the tolerance:
        there were too few, or a breakdown.
    """
    n = len(x)
    rr = error = 0.0
    for i in range(n):
        rr += r[i] * r[i]
        error += size[i] * r[i] * (size[i] * r[i])
    along = keep = 0.0
    count, short = 0, math.sqrt(error) <= tolerance
    while not short and count < max_iterations:
        for i in range(n):
            before = direction[i]
            x[i] += along * before
            direction[i] = r[i] + keep * before
        along = energy = 0.0
        for i in range(n):
            own = direction[i]
            total = own + image[i]
            for k in range(np.uint64(first[i]), np.uint64(first[i + 1])):
                j = np.uint64(other[k])
                total += values[k] * direction[j]
                image[j] += values[k] * own
            image[i] = total
            energy += own * total
        if not energy > 0.0:
            return count, True
        along, last = rr / energy, rr
        rr = error = 0.0
        for i in range(n):
            left = r[i] - along * image[i]
            r[i], image[i] = left, 0.0
            rr += left * left
            error += size[i] * left * (size[i] * left)
        keep = rr / last
        count += 1
        short = math.sqrt(error) <= tolerance
    for i in range(n):
        x[i] += along * direction[i]
    return count, not short
