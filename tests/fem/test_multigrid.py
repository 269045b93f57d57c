"""Multigrid: the same bits whatever the threads, a bad level is no end, and nothing unsolved passes for solved."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from threadpoolctl import threadpool_limits

from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.fem.linear_solver import ConjugateGradients
from thermoxels_ns.fem.multigrid import MultigridConjugateGradients, _DirectSolver
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.two_level import TwoLevelConjugateGradients
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.heat.materials import Material


@pytest.fixture(scope="module")
def cube() -> tuple[sparse.csr_matrix, np.ndarray]:
    """A cube of 21^3 nodes, above the size from which BLAS shares a sum among threads."""
    x = planes(0.0, 1.0, step=0.05)
    air = Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -5.0)
    system = HeatSystem(HeatProblem(box_mesh(x, x, x), Material("concrete", 1.7, 2200.0, 880.0), effects=air))
    return system.matrix(0.0, np.inf), system.load(0.0)


def test_the_number_of_threads_changes_no_bit(cube) -> None:
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            found.append(MultigridConjugateGradients(cube[0], relative_tolerance=1e-10).solve(cube[1]))
    assert found[0].converged and found[0].iterations == found[1].iterations
    np.testing.assert_array_equal(found[0].x, found[1].x)


def test_nobody_s_random_numbers_are_drawn(cube) -> None:
    np.random.seed(3)
    expected = np.random.random()
    np.random.seed(3)
    MultigridConjugateGradients(cube[0]).solve(cube[1])
    assert np.random.random() == expected


def test_few_iterations_to_the_solution_of_the_diagonal_alone(cube) -> None:
    solution = MultigridConjugateGradients(cube[0]).solve(cube[1])
    assert solution.converged and solution.iterations <= 20
    np.testing.assert_allclose(solution.x, ConjugateGradients(cube[0]).solve(cube[1]).x, rtol=1e-9)


def test_the_last_level_is_solved_directly() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(40, 40))
    matrix, exact = root @ root.T + 0.1 * np.eye(40), rng.normal(size=(40, 1))
    found = _DirectSolver()(sparse.csr_matrix(matrix), matrix @ exact)
    np.testing.assert_allclose(found, exact, rtol=1e-8)


def test_a_last_level_without_exchange_leaves_its_level_at_zero() -> None:
    """A line of nodes that nothing holds: the last pivot is round-off."""
    matrix = _line(30)
    matrix[0, 0] = matrix[-1, -1] = 1.0
    heat = np.sin(np.arange(30.0))
    heat -= heat.mean()
    found = _DirectSolver()(matrix.tocsr(), heat)
    assert found[-1] == 0.0
    np.testing.assert_allclose(matrix @ found, heat, atol=1e-12)


def test_a_pivot_of_round_off_counts_as_none() -> None:
    """What is left of 1 + 4e-16 after 1 is taken away is no number to divide by."""
    matrix = sparse.csr_matrix(np.array([[1.0, 1.0], [1.0, 1.0 + 4e-16]]))
    assert _DirectSolver()(matrix, np.array([1.0, 2.0])).tolist() == [1.0, 0.0]


@pytest.mark.parametrize("heat", [1e-200, 1.0, 1e200])
def test_the_size_of_the_heat_does_not_matter(cube, heat) -> None:
    """Sums of squares neither vanish nor overflow."""
    plain = MultigridConjugateGradients(cube[0]).solve(cube[1])
    found = MultigridConjugateGradients(cube[0]).solve(heat * cube[1])
    assert found.converged and found.iterations == plain.iterations
    np.testing.assert_allclose(found.x, heat * plain.x, rtol=1e-9)


def test_a_good_start_saves_iterations(cube) -> None:
    solver = MultigridConjugateGradients(cube[0])
    cold = solver.solve(cube[1])
    assert solver.solve(cube[1], cold.x).iterations == 0 < cold.iterations
    near = solver.solve(cube[1], cold.x * (1.0 + 1e-6))
    assert near.iterations < cold.iterations
    np.testing.assert_allclose(near.x, cold.x, rtol=1e-9)


@pytest.mark.parametrize("spoiled", [-1.0, np.nan])
def test_what_is_not_positive_definite_ends_at_once(cube, spoiled) -> None:
    """Conjugate gradients know no way down there; iterations up to the limit would bring nothing."""
    solver = MultigridConjugateGradients(cube[0])
    solver._matrix = spoiled * cube[0]
    found = solver.solve(cube[1])
    assert not found.converged and found.iterations == 0


def _line(count: int) -> sparse.lil_matrix:
    matrix = 2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    return sparse.lil_matrix(matrix)


@pytest.mark.parametrize("solver", ["diagonal", "multigrid", "two levels"])
def test_a_matrix_that_is_all_but_singular_does_not_pass_for_solved(solver) -> None:
    """Its solution is 1e18 everywhere, whose residual is small beside |A| |x| and as large as b itself."""
    count = 400
    line = _line(count)
    line[0, 0] = line[-1, -1] = 1.0
    matrix = sparse.csr_matrix(line + 1e-18 * sparse.identity(count))
    if solver == "two levels":
        halves = sparse.csr_matrix(np.repeat(np.eye(count // 2), 2, axis=0))
        found = TwoLevelConjugateGradients(matrix, halves).solve(np.ones(count))
    else:
        kind = MultigridConjugateGradients if solver == "multigrid" else ConjugateGradients
        found = kind(matrix).solve(np.ones(count))
    assert found.converged == (found.residual < 0.5), found.status
    assert not found.converged
