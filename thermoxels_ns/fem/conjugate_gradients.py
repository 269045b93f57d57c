"""Conjugate gradients with sweeps, multigrid or linear tetrahedra as preconditioner."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy import sparse
from threadpoolctl import threadpool_limits

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.p1_kernels import product_and_bound

Vector = npt.NDArray[np.float64]

PATIENCE = 1000
"""Iterations between sweeps within one solution before multigrid takes over where it stands.

Measured on lattices of 15,000 to 230,000 nodes: one multigrid iteration costs as much as 26 between sweeps, its set-up
as much as 300, and it needs about 20 to 24."""
PATIENCE_WHEN_REPEATED = 600  # The same for a matrix that is used again, when its set-up is paid once
_RECURSION_SLACK = 10.0
_ROUND_OFF = 1e-14
_SOLVES_SOMETHING = 0.5  # No round-off excuses a larger relative residual
_NEARLY = 0.99  # How far the loop's residual must fall below where it was expected to suffice, once that was wrong
_SMALLEST_PIVOT_OF_SWEEPS = 1e-4
"""Share of the diagonal below which a pivot is not used: wrong-signed couplings can make it vanish."""
_COARSEST = 300  # Nodes of the level of multigrid that is solved directly
_ROUND_OFF_OF_COARSEST = 1e-13
"""Share of its largest eigenvalue below which one of that level is round-off; its mode is left out."""


@dataclass(frozen=True)
class LinearSolution:
    """A solution x of A x = b, shape (n,), and how well it solves it; the status is a sentence."""

    x: Vector
    iterations: int
    residual: float  # ||b - A x|| / ||b|| computed from x itself, not from the recursion; 0 where b is 0
    converged: bool  # Whether the residual is within the tolerance, or as small as double precision can make it
    status: str


class Preconditioner(Protocol):
    """A symmetric positive definite S that resembles A.

    It is applied in two parts. A factor C changes the system that the loop solves to C^-1 A C^-T y = C^-1 b with x =
    C^-T y, and `apply` preconditions that: S = C S' C^T. `Sweeps` has the factor alone (S' = 1), all others `apply`
    alone (C = 1).
    """

    name: str  # What preconditions, for reports

    def residual(self, r: Vector) -> Vector:
        """Residual of the changed system, C^-1 r."""
        ...

    def norm(self, seen: Vector) -> float:
        """Norm of r from C^-1 r."""
        ...

    def image(self, direction: Vector) -> tuple[Vector, Vector]:
        """For a direction p: C^-T p, and the changed matrix times p, C^-1 A C^-T p."""
        ...

    def solution(self, moved: Vector) -> Vector:
        """Turn the sum of all `image`'s C^-T p into x."""
        ...

    def apply(self, seen: Vector) -> Vector:
        """S'^-1 times the changed system's residual."""
        ...


class ConjugateGradients:
    """Solver for A x = b with one matrix and many right-hand sides.

    One loop serves all preconditioners, which say what it sees as matrix and residual. The residual of x itself decides
    whether a solution is accepted. No sum goes through BLAS, whose order of summation depends on the number of threads.
    """

    def __init__(
        self,
        matrix: sparse.csr_matrix,
        preconditioner: Preconditioner | None = None,
        *,
        relative_tolerance: float = 1e-12,
        max_iterations: int = 10_000,
    ) -> None:
        """Check A, symmetric positive definite (`HeatError`); the preconditioner is `Sweeps` if None.

        Iterations end at ||b - A x|| <= relative_tolerance * ||b||.
        """
        diagonal = matrix.diagonal()
        if not (np.all(np.isfinite(matrix.data)) and np.all(diagonal > 0)):
            expected, bad = "finite entries and a diagonal above 0", np.count_nonzero(~np.isfinite(matrix.data))
            got = f"smallest diagonal entry {np.min(diagonal, initial=np.inf):.3g}, {bad} entries not finite"
            remedy = "Check the units of the mesh, the material and the time step."
            raise HeatError("matrix of the heat problem", expected=expected, got=got, remedy=remedy)
        self._matrix = matrix
        self._size = float(np.max(product_and_bound(matrix, np.ones(len(diagonal)))[1], initial=0.0))
        self._preconditioner = Sweeps(matrix) if preconditioner is None else preconditioner
        self._relative_tolerance, self._max_iterations = relative_tolerance, max_iterations

    @property
    def name(self) -> str:
        """What preconditions, for reports."""
        return self._preconditioner.name

    def solve(self, right_hand_side: Vector, start: Vector | None = None) -> LinearSolution:
        """Solve A x = b, b of shape (n,); a start, if it is better than 0, changes only the number of iterations."""
        # In units of its largest entry, so that the squares in the norms neither overflow nor vanish.
        scale = float(np.max(np.abs(right_hand_side), initial=0.0)) or 1.0
        b = right_hand_side / scale
        size = norm(b)
        tolerance, near = self._relative_tolerance * size, None
        if start is not None:
            left = b - self._matrix @ (start / scale)
            near = left if norm(left) < size else None
        x, count, stopped = self._iterate(b if near is None else near, tolerance)
        if start is not None and near is not None:
            x += start / scale
        # A breakdown may leave NaN, which becomes a status.
        error = norm(b - self._matrix @ x)
        residual = error / size if size > 0.0 else error
        converged = is_solved(error, tolerance, size, self._size * norm(x))
        if converged:
            outcome = f"converged in {count} iterations to"
        else:
            outcome = f"stopped after {count} iterations at" if stopped else "lost accuracy to round-off at"
        status = f"Conjugate gradients with {self.name} {outcome} a relative residual of {residual:.1e}."
        return LinearSolution(scale * x, count, residual, converged, status)

    def _iterate(self, r: Vector, tolerance: float) -> tuple[Vector, int, bool]:
        """Give the solution for a residual, the number of iterations, and whether they ended too early."""
        given, seen = self._preconditioner, self._preconditioner.residual(r)
        x, direction = np.zeros_like(r), np.zeros_like(r)
        before, square, count = math.inf, dot(seen, seen), 0
        true = norm(r)
        # The loop's residual is another one than that of A, which is looked at when it should be small enough.
        goal = tolerance * math.sqrt(square) / true if true > 0.0 else 0.0
        while True:
            if math.sqrt(square) <= goal:
                true = given.norm(seen)
                if true <= tolerance:
                    return given.solution(x), count, False
                goal = _NEARLY * math.sqrt(square) * tolerance / true
            if count == self._max_iterations:
                return given.solution(x), count, True
            z = given.apply(seen)
            now = square if z is seen else dot(seen, z)
            _turn(direction, z, now / before)
            step, image = given.image(direction)
            energy = dot(direction, image)
            if not energy > 0.0:
                return given.solution(x), count, True
            square = _advance(x, seen, step, image, now / energy)
            before, count = now, count + 1


class LinearSolver:
    """Solver for A x = b that is cheap to set up, until it has shown that it is slow: then multigrid takes over."""

    def __init__(self, matrix: sparse.csr_matrix, *, relative_tolerance: float = 1e-12) -> None:
        """Set up sweeps; matrix, tolerance and errors are those of `ConjugateGradients`."""
        self._matrix, self._relative_tolerance = matrix, relative_tolerance
        self._solver = ConjugateGradients(matrix, relative_tolerance=relative_tolerance, max_iterations=PATIENCE)
        self._swept, self._slow = True, False

    @property
    def name(self) -> str:
        """What preconditioned the last solution, for reports."""
        return self._solver.name

    def solve(self, right_hand_side: Vector) -> LinearSolution:
        """Solve A x = b."""
        start = None
        if self._swept and not self._slow:
            found = self._solver.solve(right_hand_side)
            self._slow = found.iterations > PATIENCE_WHEN_REPEATED
            # A breakdown after few iterations is not slowness, and no preconditioner mends it.
            if found.converged or found.iterations < PATIENCE:
                return found
            start = found.x if np.all(np.isfinite(found.x)) else None
        if self._swept:
            multigrid = Multigrid(self._matrix)
            self._solver = ConjugateGradients(
                self._matrix, multigrid, relative_tolerance=self._relative_tolerance, max_iterations=500
            )
            self._swept = False
        return self._solver.solve(right_hand_side, start)


class Sweeps:
    """An incomplete Cholesky factor that differs from the matrix by its diagonal D only.

        A ~ (D + L) D^-1 (D + L^T),    D_i = A_ii - sum over j < i of A_ij^2 / D_j

    (Meijerink and van der Vorst, Mathematics of Computation 31, 1977, on a lattice; Pommerell's D-ILU on any matrix).
    With D scaled to ones, one backward and one forward sweep apply both it and the matrix (Eisenstat, SIAM Journal on
    Scientific and Statistical Computing 2, 1981): with t = (1 + L^T)^-1 p,

        (1 + L)^-1 A t = t + (1 + L)^-1 (p - (2 - diag A) t).

    It takes a third of the iterations of the diagonal preconditioner, also where conductivities differ by 1e6.
    """

    name = "incomplete factor"

    def __init__(self, matrix: sparse.csr_matrix) -> None:
        """Set up the factor; memory for half of the matrix."""
        self._scale = np.sqrt(matrix.diagonal())
        first = np.zeros_like(matrix.indptr)
        _count_above(matrix.indptr, matrix.indices, first)
        other, values = np.empty(first[-1], matrix.indices.dtype), np.empty(first[-1])
        _take_above(matrix.indptr, matrix.indices, matrix.data, 1.0 / self._scale, first, other, values)
        root = np.ones_like(self._scale)
        _pivot_roots(first, other, values, root)
        self._scale *= root
        self._surplus, beside = np.empty_like(root), np.zeros_like(root)
        count = _divide_and_part(first, other, values, root, self._surplus, beside)
        self._factor = first, other[:count], values[:count], beside
        self._step, self._image = np.empty_like(root), np.empty_like(root)

    def residual(self, r: Vector) -> Vector:
        """(1 + L)^-1 of the scaled residual."""
        seen = r / self._scale
        _sweep_forward(*self._factor, np.zeros_like(seen), seen)
        return seen

    def norm(self, seen: Vector) -> float:
        """Norm of the residual itself."""
        return _norm_below(*self._factor, self._scale, seen, np.zeros_like(seen))

    def image(self, direction: Vector) -> tuple[Vector, Vector]:
        """Both sweeps; the arrays are used again the next time."""
        _sweep_back(*self._factor, self._surplus, direction, self._step, self._image)
        _sweep_forward(*self._factor, self._step, self._image)
        return self._step, self._image

    def solution(self, moved: Vector) -> Vector:
        """Scaled."""
        return moved / self._scale

    def apply(self, seen: Vector) -> Vector:
        """Nothing is left: the factor is in the matrix that the loop sees."""
        return seen


class _Plain:
    """A preconditioner that the loop applies to A itself."""

    def __init__(self, matrix: sparse.csr_matrix) -> None:
        self._matrix = matrix

    def residual(self, r: Vector) -> Vector:
        """The residual as it is, in an array of its own."""
        return r.copy()

    def norm(self, seen: Vector) -> float:
        """Its norm."""
        return norm(seen)

    def image(self, direction: Vector) -> tuple[Vector, Vector]:
        """The vector itself, and A times it."""
        return direction, self._matrix @ direction

    def solution(self, moved: Vector) -> Vector:
        """As it is."""
        return moved


class Multigrid(_Plain):
    """Smoothed aggregation by pyamg: iterations hardly grow with the mesh; dear to set up.

    It is symmetric. Random starts and BLAS, whose sums depend on the number of its threads, are avoided: row sums stand
    for estimates of a spectral radius, and the last level is solved here.
    """

    name = "multigrid"

    def __init__(self, matrix: sparse.csr_matrix) -> None:
        from pyamg import smoothed_aggregation_solver

        super().__init__(matrix)
        levels = smoothed_aggregation_solver(
            matrix,
            smooth=("jacobi", {"weighting": "local"}),
            presmoother=("gauss_seidel", {"sweep": "forward"}),
            postsmoother=("gauss_seidel", {"sweep": "backward"}),
            improve_candidates=None,
            max_coarse=_COARSEST,
            coarse_solver=_CoarsestLevel(),
        )
        self._cycle = levels.aspreconditioner(cycle="V").matvec

    def apply(self, seen: Vector) -> Vector:
        """One V cycle."""
        return self._cycle(seen)


class TwoLevel(_Plain):
    """For quadratic tetrahedra: the diagonal plus linear tetrahedra on the same mesh, P (P^T A P)^-1 P^T.

    An additive Schwarz method (Dryja and Widlund 1987; Xu, SIAM Review 34, 1992) whose number of iterations does not
    grow with the mesh. One multigrid cycle stands for the inverse of the coarse level.
    """

    name = "linear tetrahedra"

    def __init__(self, matrix: sparse.csr_matrix, prolongation: sparse.csr_matrix) -> None:
        """Set up the coarse level; `prolongation` is P, shape (n, m)."""
        super().__init__(matrix)
        self._diagonal = matrix.diagonal()
        self._prolongation, self._restriction = prolongation, sparse.csr_matrix(prolongation.T)
        coarse = sparse.csr_matrix(self._restriction @ (matrix @ prolongation))
        self._coarse = Multigrid(coarse) if len(coarse.indptr) > 1 else None

    def apply(self, seen: Vector) -> Vector:
        """Add up both levels."""
        z = seen / self._diagonal
        if self._coarse is not None:
            z += self._prolongation @ self._coarse.apply(self._restriction @ seen)
        return z


class _CoarsestLevel:
    """Solver of the last level by its pseudo-inverse, which is made when it is first asked for."""

    def __init__(self) -> None:
        self._inverse: Vector | None = None

    def __call__(self, matrix: sparse.csr_matrix, right_hand_side: Vector) -> Vector:
        inverse = self._inverse
        if inverse is None:
            with threadpool_limits(1, "blas"):
                inverse = np.linalg.pinv(matrix.toarray(), rcond=_ROUND_OFF_OF_COARSEST, hermitian=True)
            self._inverse = inverse
        return np.einsum("ij,j->i", inverse, np.ravel(right_hand_side)).reshape(np.shape(right_hand_side))


def is_solved(error: float, tolerance: float, right_hand_side: float, matrix_times_solution: float) -> bool:
    """Whether a residual ||b - A x|| of x itself is good enough; `matrix_times_solution` is ||A|| ||x||.

    It must be within ten times the tolerance, because the residual of a recursion drifts away from it, or its backward
    error must be at the level of round-off. Of a matrix that is all but singular, a huge x has a small backward error
    and need not solve anything: half of b must be explained too.

    >>> is_solved(5e-12, 1e-12, 1.0, 1.0), is_solved(1e-3, 1e-12, 1.0, 1e12), is_solved(0.9, 1e-12, 1.0, 1e15)
    (True, True, False)
    """
    exact_enough = error <= _RECURSION_SLACK * tolerance
    round_off = error <= _ROUND_OFF * (matrix_times_solution + right_hand_side)
    accepted = exact_enough or (round_off and error < _SOLVES_SOMETHING * right_hand_side)
    return math.isfinite(matrix_times_solution) and accepted


def norm(vector: Vector) -> float:
    """Euclidean norm."""
    return math.sqrt(dot(vector, vector))


# Sums may be regrouped: four at a time, they need not wait for each other.
@kernel(fastmath={"reassoc", "contract"})
def dot(first, second):
    """Inner product."""
    total = 0.0
    for i in range(len(first)):
        total += first[i] * second[i]
    return total


@kernel(fastmath={"contract"})
def _turn(direction, z, keep):
    for i in range(len(z)):
        direction[i] = z[i] + keep * direction[i]


@kernel(fastmath={"reassoc", "contract"})
def _advance(x, r, step, image, along):
    """Move x and r; returns the square of r."""
    total = 0.0
    for i in range(len(x)):
        x[i] += along * step[i]
        left = r[i] - along * image[i]
        r[i] = left
        total += left * left
    return total


@kernel
def _count_above(indptr, indices, first):
    for row in range(len(indptr) - 1):
        count = 0
        for k in range(indptr[row], indptr[row + 1]):
            count += indices[k] > row
        first[row + 1] = first[row] + count


@kernel
def _take_above(indptr, indices, data, scale, first, other, values):
    """Entries above the diagonal of the matrix with ones on it."""
    for row in range(len(indptr) - 1):
        place = first[row]
        for k in range(indptr[row], indptr[row + 1]):
            if indices[k] > row:
                other[place] = indices[k]
                values[place] = data[k] * scale[row] * scale[indices[k]]
                place += 1


@kernel
def _pivot_roots(first, other, values, root):
    """Square roots of D of a matrix with ones on its diagonal; they come as ones."""
    for i in range(len(root)):
        if not root[i] > _SMALLEST_PIVOT_OF_SWEEPS:
            root[i] = 1.0
        for k in range(first[i], first[i + 1]):
            root[other[k]] -= values[k] * values[k] / root[i]
        root[i] = math.sqrt(root[i])


@kernel
def _divide_and_part(first, other, values, root, surplus, beside):
    """Divide by the roots, so that D is 1; put couplings to the next node into `beside`, move the others together."""
    place = begin = 0
    for i in range(len(root)):
        surplus[i] = 2.0 - 1.0 / (root[i] * root[i])
        end = first[i + 1]
        for k in range(begin, end):
            value = values[k] / (root[i] * root[other[k]])
            if other[k] == i + 1:
                beside[i] = value
            else:
                other[place], values[place] = other[k], value
                place += 1
        begin, first[i + 1] = end, place
    return place


# In sweeps the share of the node before is added last and comes from a register, because a sweep waits for it: where
# nodes are numbered line by line, its value need not go through memory. Unsigned indices spare the test for negatives.
@kernel(fastmath={"contract"})
def _sweep_back(first, other, values, beside, surplus, direction, step, image):
    """Sets step = (1 + L^T)^-1 direction and image = direction - surplus * step."""
    n = np.uint64(len(direction))
    behind = 0.0
    for back in range(n):
        i = n - np.uint64(1) - back
        own = direction[i]
        for k in range(np.uint64(first[i]), np.uint64(first[i + 1])):
            own -= values[k] * step[np.uint64(other[k])]
        behind = own - beside[i] * behind
        step[i] = behind
        image[i] = direction[i] - surplus[i] * behind


@kernel(fastmath={"contract"})
def _sweep_forward(first, other, values, beside, added, x):
    """Sets x = (1 + L)^-1 x + added."""
    ahead = 0.0
    for i in range(np.uint64(len(x))):
        own = x[i] - ahead
        x[i] = own + added[i]
        for k in range(np.uint64(first[i]), np.uint64(first[i + 1])):
            x[np.uint64(other[k])] -= values[k] * own
        ahead = beside[i] * own


@kernel
def _norm_below(first, other, values, beside, scale, r, work):
    """Norm of scale * (1 + L) r; `work` comes as zeros."""
    total = ahead = 0.0
    for i in range(np.uint64(len(r))):
        part = scale[i] * (r[i] + work[i] + ahead)
        total += part * part
        for k in range(np.uint64(first[i]), np.uint64(first[i + 1])):
            work[np.uint64(other[k])] += values[k] * r[i]
        ahead = beside[i] * r[i]
    return math.sqrt(total)
