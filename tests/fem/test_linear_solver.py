from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from thermoxels_ns.errors import HeatError
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
