from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import cg, spsolve

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.linear_solver import ConjugateGradients


def laplacian(n: int) -> sparse.csr_matrix:
    return sparse.diags([-np.ones(n - 1), np.full(n, 2.0), -np.ones(n - 1)], [-1, 0, 1], format="csr")


def test_solves_to_the_tolerance() -> None:
    matrix = laplacian(200)
    exact = np.sin(np.arange(200.0))
    solution = ConjugateGradients(matrix).solve(matrix @ exact)
    assert solution.converged
    np.testing.assert_allclose(solution.x, exact, atol=1e-9)


def test_zero_right_hand_side() -> None:
    solution = ConjugateGradients(laplacian(5)).solve(np.zeros(5))
    assert solution.converged and not solution.x.any() and solution.residual == 0.0


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30])
def test_scale_does_not_matter(scale: float) -> None:
    solution = ConjugateGradients(laplacian(50)).solve(np.full(50, scale))
    expected = ConjugateGradients(laplacian(50)).solve(np.ones(50))
    assert solution.converged
    np.testing.assert_allclose(solution.x / scale, expected.x, rtol=1e-9)


def test_too_few_iterations_is_a_status() -> None:
    solution = ConjugateGradients(laplacian(200), max_iterations=3).solve(np.ones(200))
    assert not solution.converged
    assert "stopped after 3 iterations" in solution.status
    assert solution.residual > 1e-3


def test_true_residual_is_of_the_returned_x() -> None:
    matrix, b = laplacian(200), np.ones(200)
    solution = ConjugateGradients(matrix, max_iterations=40).solve(b)
    assert solution.residual == pytest.approx(np.linalg.norm(b - matrix @ solution.x) / np.linalg.norm(b))


def test_singular_system_without_solution_does_not_converge() -> None:
    ring = laplacian(20).tolil()
    ring[0, -1] = ring[-1, 0] = -1.0
    assert not ConjugateGradients(ring.tocsr(), max_iterations=200).solve(np.ones(20)).converged


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1.0])
def test_unusable_matrix_is_refused(bad: float) -> None:
    matrix = laplacian(4).tolil()
    matrix[2, 2] = bad
    with pytest.raises(HeatError, match="matrix of the heat problem"):
        ConjugateGradients(matrix.tocsr())


def weighted_graph(n: int = 400, seed: int = 0) -> sparse.csr_matrix:
    """Laplacian of a random graph with weights over six decades, plus a small mass: symmetric positive definite."""
    rng = np.random.default_rng(seed)
    low, high = rng.integers(0, n, (2, 4 * n))
    weight = 10.0 ** rng.uniform(-3.0, 3.0, 4 * n)
    links = sparse.coo_matrix((weight, (low, high)), shape=(n, n))
    links = (links + links.T).tolil()
    links.setdiag(0.0)
    total = np.asarray(links.sum(axis=1)).ravel()
    return sparse.csr_matrix(sparse.diags(total + 1e-2) - links)


def test_agrees_with_a_direct_solver() -> None:
    matrix = weighted_graph()
    b = np.random.default_rng(1).normal(size=400)
    solution = ConjugateGradients(matrix).solve(b)
    exact = spsolve(matrix.tocsc(), b)
    assert solution.converged and solution.residual < 1e-11
    np.testing.assert_allclose(solution.x, exact, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize("relative_tolerance", [1e-3, 1e-8, 1e-12])
def test_takes_the_iterations_of_plain_preconditioned_conjugate_gradients(relative_tolerance: float) -> None:
    """Against scipy's, which reads the whole matrix: same recursion, same stop."""
    matrix, b, count = weighted_graph(seed=2), np.random.default_rng(2).normal(size=400), 0

    def step(_: np.ndarray) -> None:
        nonlocal count
        count += 1

    jacobi = sparse.diags(1.0 / matrix.diagonal())
    cg(matrix, b, rtol=relative_tolerance, atol=0.0, M=jacobi, callback=step, maxiter=10_000)
    solution = ConjugateGradients(matrix, relative_tolerance=relative_tolerance).solve(b)
    assert abs(solution.iterations - count) <= 1
    assert solution.converged and solution.residual <= 10 * relative_tolerance


def test_order_and_type_of_the_entries_do_not_matter() -> None:
    matrix, b = weighted_graph(seed=3), np.random.default_rng(3).normal(size=400)
    expected = ConjugateGradients(matrix).solve(b)
    shuffled = matrix.copy()
    for row in range(400):
        part = slice(shuffled.indptr[row], shuffled.indptr[row + 1])
        shuffled.indices[part] = shuffled.indices[part][::-1].copy()
        shuffled.data[part] = shuffled.data[part][::-1].copy()
    shuffled.has_sorted_indices = False
    wide = matrix.copy()
    wide.indices, wide.indptr = wide.indices.astype(np.int64), wide.indptr.astype(np.int64)
    for same in (shuffled, wide):
        solution = ConjugateGradients(same).solve(b)
        assert solution.converged
        np.testing.assert_allclose(solution.x, expected.x, rtol=1e-7)


def test_solving_changes_neither_matrix_nor_right_hand_side() -> None:
    matrix, b = weighted_graph(seed=4), np.random.default_rng(4).normal(size=400)
    data, given = matrix.data.copy(), b.copy()
    solver = ConjugateGradients(matrix)
    first, second = solver.solve(b), solver.solve(b)
    np.testing.assert_array_equal(matrix.data, data)
    np.testing.assert_array_equal(b, given)
    np.testing.assert_array_equal(first.x, second.x)


def test_a_matrix_that_is_not_symmetric_does_not_pass_for_solved() -> None:
    """Iterations read the upper triangle; the residual is that of the whole matrix."""
    matrix = laplacian(50).tolil()
    matrix[10, 9] = -0.5
    solution = ConjugateGradients(matrix.tocsr()).solve(np.ones(50))
    assert not solution.converged
    assert "lost accuracy" in solution.status and solution.residual > 1e-4


def test_an_indefinite_matrix_is_a_status() -> None:
    matrix = sparse.csr_matrix(np.array([[1.0, 4.0], [4.0, 1.0]]))
    solution = ConjugateGradients(matrix).solve(np.array([1.0, -1.0]))
    assert not solution.converged
    assert "stopped after 0 iterations" in solution.status and np.all(np.isfinite(solution.x))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_right_hand_side_that_is_not_finite_is_a_status(bad: float) -> None:
    b = np.ones(20)
    b[3] = bad
    with np.errstate(invalid="ignore"):
        solution = ConjugateGradients(laplacian(20)).solve(b)
    assert not solution.converged and solution.status
