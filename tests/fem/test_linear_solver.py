import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve
from threadpoolctl import threadpool_limits

from tests.support.heat_bodies import CONCRETE, STEEL
from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem import implicit_equation as linear_solver
from thermoxels_ns.fem.implicit_equation import LinearSolver
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.effects import Convection, FixedTemperature, InternalHeat


def laplacian(n: int) -> sparse.csr_matrix:
    return sparse.diags([-np.ones(n - 1), np.full(n, 2.0), -np.ones(n - 1)], [-1, 0, 1], format="csr")


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


@pytest.mark.parametrize("patience", [1, linear_solver.PATIENCE])
def test_agrees_with_a_direct_solver(monkeypatch, patience) -> None:
    monkeypatch.setattr(linear_solver, "PATIENCE", patience)
    matrix = weighted_graph()
    b = np.random.default_rng(1).normal(size=400)
    solution = LinearSolver(matrix).solve(b)
    exact = spsolve(matrix.tocsc(), b)
    assert solution.converged and ("multigrid" in solution.status) == (patience == 1)
    np.testing.assert_allclose(solution.x, exact, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30])
def test_scale_does_not_matter(scale: float) -> None:
    solution = LinearSolver(laplacian(50)).solve(np.full(50, scale))
    expected = LinearSolver(laplacian(50)).solve(np.ones(50))
    assert solution.converged
    np.testing.assert_allclose(solution.x / scale, expected.x, rtol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1.0])
def test_unusable_matrix_is_refused(bad: float) -> None:
    matrix = laplacian(4).tolil()
    matrix[2, 2] = bad
    with pytest.raises(HeatError, match="matrix of the heat problem"):
        LinearSolver(matrix.tocsr())


def test_too_few_iterations_are_a_status(monkeypatch) -> None:
    monkeypatch.setattr(linear_solver, "PATIENCE", 3)
    monkeypatch.setattr(linear_solver, "MOST_ITERATIONS", 1)
    monkeypatch.setattr(linear_solver, "LAST_ITERATIONS", 2)
    solution = LinearSolver(weighted_graph()).solve(np.random.default_rng(2).normal(size=400))
    assert not solution.converged and "stopped after 6 iterations" in solution.status


@pytest.mark.parametrize("patience", [1, linear_solver.PATIENCE])
def test_the_same_bits_with_any_number_of_threads(monkeypatch, patience) -> None:
    """A cube of 21^3 nodes, above the size from which BLAS shares a sum among threads."""
    monkeypatch.setattr(linear_solver, "PATIENCE", patience)
    x = planes(0.0, 1.0, step=0.05)
    air = Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -5.0)
    system = HeatSystem(HeatProblem(box_mesh(x, x, x), CONCRETE, effects=air))
    matrix, heat_w = system.matrix(0.0, np.inf), system.net_heat(system.start_k, 0.0)
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            found.append(LinearSolver(matrix).solve(heat_w))
    assert found[0].converged and found[0].iterations == found[1].iterations
    assert patience > 1 or found[0].iterations <= 30
    np.testing.assert_array_equal(found[0].x, found[1].x)


def test_a_mesh_whose_corners_are_all_fixed() -> None:
    """The middles of the inner edges are all that is solved for."""
    mesh = box_mesh([0, 1], [0, 1], [0, 1])
    effects = (FixedTemperature(("*",), 0.0), InternalHeat(("*",), 60.0))
    solution = solve_steady(HeatProblem(mesh, STEEL, effects=effects), order=2)
    assert solution.edge_temperature_c.max() > 0.0 and np.abs(solution.temperature_c).max() == 0.0
    assert solution.effects[0].heat_w[0] == pytest.approx(-60.0, rel=1e-9)
