import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import cg, spsolve
from threadpoolctl import threadpool_limits

from tests.support.heat_bodies import CONCRETE, STEEL
from tests.support.heat_meshes import box_mesh, planes
from tests.support.shell_mesh import shell_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.conjugate_gradients import ConjugateGradients, LinearSolution, LinearSolver, Multigrid, TwoLevel
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.effects import Convection, FixedTemperature, InternalHeat

KERSHAW = np.array([[3.0, -2.0, 0.0, 2.0], [-2.0, 3.0, -2.0, 0.0], [0.0, -2.0, 3.0, -2.0], [2.0, 0.0, -2.0, 3.0]])
"""Positive definite (Kershaw, Journal of Computational Physics 26, 1978), but its last pivot is not."""


def laplacian(n: int) -> sparse.csr_matrix:
    return sparse.diags([-np.ones(n - 1), np.full(n, 2.0), -np.ones(n - 1)], [-1, 0, 1], format="csr")


def lattice(side: int, fourier: float, weight: np.ndarray | float = 1.0) -> sparse.csr_matrix:
    """I / fourier + K of side^3 nodes; a link conducts as the harmonic mean of its ends' weights."""
    conducts = np.broadcast_to(np.asarray(weight, float).reshape(-1), (side**3,))
    number = np.arange(side**3).reshape(side, side, side)
    pairs = [
        (number[:-1].ravel(), number[1:].ravel()),
        (number[:, :-1].ravel(), number[:, 1:].ravel()),
        (number[:, :, :-1].ravel(), number[:, :, 1:].ravel()),
    ]
    low, high = (np.concatenate([pair[end] for pair in pairs]) for end in (0, 1))
    flow = 2.0 / (1.0 / conducts[low] + 1.0 / conducts[high])
    links = sparse.coo_matrix((flow, (low, high)), shape=(side**3, side**3))
    links = sparse.csr_matrix(links + links.T)
    return sparse.csr_matrix(sparse.diags(np.asarray(links.sum(axis=1)).ravel() + 1.0 / fourier) - links)


def right_hand_side(matrix: sparse.csr_matrix, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=len(matrix.indptr) - 1)


def true_residual(matrix: sparse.csr_matrix, b: np.ndarray, x: np.ndarray) -> float:
    return float(np.linalg.norm(b - matrix @ x) / np.linalg.norm(b))


def diagonal_iterations(matrix: sparse.csr_matrix, b: np.ndarray, tolerance: float = 1e-12) -> int:
    """Iterations of scipy's conjugate gradients with the diagonal as preconditioner."""
    count = 0

    def step(_: np.ndarray) -> None:
        nonlocal count
        count += 1

    cg(matrix, b, rtol=tolerance, atol=0.0, M=sparse.diags(1.0 / matrix.diagonal()), callback=step, maxiter=10_000)
    return count


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30])
def test_scale_does_not_matter(scale: float) -> None:
    solution = ConjugateGradients(laplacian(50)).solve(np.full(50, scale))
    expected = ConjugateGradients(laplacian(50)).solve(np.ones(50))
    assert solution.converged
    np.testing.assert_allclose(solution.x / scale, expected.x, rtol=1e-9)


def test_too_few_iterations_is_a_status() -> None:
    matrix = lattice(10, 1e3)
    b = right_hand_side(matrix)
    solution = ConjugateGradients(matrix, max_iterations=3).solve(b)
    assert not solution.converged
    assert "stopped after 3 iterations" in solution.status
    assert solution.residual == pytest.approx(true_residual(matrix, b, solution.x)) and solution.residual > 1e-3


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


@pytest.mark.parametrize("side", [8, 16, 24])
def test_long_steps_take_less_than_half_of_the_iterations(side: int) -> None:
    matrix = lattice(side, 0.02 * side**2)
    b = right_hand_side(matrix)
    swept, plain = ConjugateGradients(matrix).solve(b), diagonal_iterations(matrix, b)
    assert swept.converged
    assert swept.iterations < 0.45 * plain, (swept.iterations, plain)


@pytest.mark.parametrize("pattern", ["halves", "checks", "random"])
@pytest.mark.parametrize("fourier", [1.0, 1e6])
def test_conductivities_that_differ_by_a_million(pattern: str, fourier: float) -> None:
    side = 14
    i, j, k = np.indices((side, side, side))
    kinds = {"halves": i < 7, "checks": (i // 3 + j // 3 + k // 3) % 2 == 0, "random": None}
    good = np.random.default_rng(3).random((side,) * 3) < 0.5 if kinds[pattern] is None else kinds[pattern]
    matrix = lattice(side, fourier, np.where(good, 1e3, 1e-3))
    b = matrix @ right_hand_side(matrix)
    swept, plain = ConjugateGradients(matrix).solve(b), diagonal_iterations(matrix, b)
    assert swept.converged and swept.residual < 1e-11
    assert swept.iterations < 0.6 * plain, (swept.iterations, plain)


def test_a_pivot_that_is_not_positive_does_no_harm() -> None:
    matrix, b = sparse.csr_matrix(KERSHAW), np.array([1.0, -2.0, 3.0, 0.5])
    solution = ConjugateGradients(matrix).solve(b)
    assert np.linalg.eigvalsh(KERSHAW).min() > 0.0
    assert solution.converged
    np.testing.assert_allclose(solution.x, np.linalg.solve(KERSHAW, b), rtol=1e-9)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-8, 1e-12])
def test_it_is_the_residual_of_the_matrix_that_stops(tolerance: float) -> None:
    """Sizes of the nodes differ by 1e3: the residual of the sweeps has another norm."""
    scale = sparse.diags(10.0 ** np.random.default_rng(1).uniform(-1.5, 1.5, 12**3))
    matrix = sparse.csr_matrix(scale @ lattice(12, 50.0) @ scale)
    b = right_hand_side(matrix)
    solution = ConjugateGradients(matrix, relative_tolerance=tolerance).solve(b)
    before = ConjugateGradients(matrix, max_iterations=solution.iterations - 1, relative_tolerance=tolerance)
    assert solution.converged and true_residual(matrix, b, solution.x) <= 1.1 * tolerance
    assert before.solve(b).residual > 0.3 * tolerance


def test_a_start_shortens_it_and_the_solution_itself_ends_it() -> None:
    matrix = lattice(12, 50.0)
    b = right_hand_side(matrix)
    solver = ConjugateGradients(matrix, relative_tolerance=1e-10)
    first = solver.solve(b)
    near = solver.solve(b, first.x * (1.0 + 1e-6 * np.sin(np.arange(12.0**3))))
    assert near.converged and 0 < near.iterations < 0.7 * first.iterations
    assert solver.solve(b, ConjugateGradients(matrix).solve(b).x).iterations == 0


def test_pieces_that_are_all_but_singular_and_nodes_that_are_fixed() -> None:
    """Two insulated cubes, 1e9 times as long a step as heat needs; then the same with a layer of nodes taken out."""
    cube = lattice(8, 1e9)
    pair = sparse.csr_matrix(sparse.block_diag([cube, cube]))
    exact = right_hand_side(pair)
    exact[:512] -= exact[:512].mean()
    exact[512:] -= exact[512:].mean()
    solution = ConjugateGradients(pair).solve(pair @ exact)
    assert solution.converged
    for piece in (slice(0, 512), slice(512, 1024)):
        error = solution.x[piece] - exact[piece]
        np.testing.assert_allclose(error - error.mean(), 0.0, atol=1e-9)
    free = np.flatnonzero(np.arange(1024) % 512 >= 64)
    held = sparse.csr_matrix(pair[free][:, free])
    b = right_hand_side(held)
    np.testing.assert_allclose(ConjugateGradients(held).solve(b).x, spsolve(held.tocsc(), b), atol=1e-8)


@pytest.fixture(scope="module")
def cube() -> tuple[sparse.csr_matrix, np.ndarray]:
    """A cube of 21^3 nodes, above the size from which BLAS shares a sum among threads."""
    x = planes(0.0, 1.0, step=0.05)
    air = Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -5.0)
    system = HeatSystem(HeatProblem(box_mesh(x, x, x), CONCRETE, effects=air))
    return system.matrix(0.0, np.inf), system.load(0.0)


def by_multigrid(matrix: sparse.csr_matrix, b: np.ndarray) -> LinearSolution:
    return ConjugateGradients(matrix, Multigrid(matrix), max_iterations=500).solve(b)


def test_few_iterations_to_the_solution_of_the_diagonal_alone_with_any_number_of_threads(cube) -> None:
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            found.append(by_multigrid(cube[0], cube[1]))
    assert found[0].converged and found[0].iterations == found[1].iterations <= 20
    np.testing.assert_array_equal(found[0].x, found[1].x)
    np.testing.assert_allclose(found[0].x, ConjugateGradients(cube[0]).solve(cube[1]).x, rtol=1e-9)


def _line(count: int) -> sparse.lil_matrix:
    matrix = 2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    return sparse.lil_matrix(matrix)


@pytest.mark.parametrize("solver", ["sweeps", "multigrid", "two levels"])
def test_a_matrix_that_is_all_but_singular_does_not_pass_for_solved(solver) -> None:
    """Its solution is 1e18 everywhere, whose residual is small beside |A| |x| and as large as b itself."""

    def plain(matrix: sparse.csr_matrix, b: np.ndarray) -> LinearSolution:
        return ConjugateGradients(matrix).solve(b)

    count = 400
    line = _line(count)
    line[0, 0] = line[-1, -1] = 1.0
    matrix = sparse.csr_matrix(line + 1e-18 * sparse.identity(count))
    if solver == "two levels":
        halves = sparse.csr_matrix(np.repeat(np.eye(count // 2), 2, axis=0))
        found = ConjugateGradients(matrix, TwoLevel(matrix, halves)).solve(np.ones(count))
    else:
        found = (by_multigrid if solver == "multigrid" else plain)(matrix, np.ones(count))
    assert found.converged == (found.residual < 0.5), found.status
    assert not found.converged


def shell(refinements: int) -> HeatProblem:
    mesh = shell_mesh(0.5, 0.6, 4, 1, eighth=True)
    for _ in range(refinements):
        mesh = refine_mesh(mesh)
    return HeatProblem(mesh, STEEL, effects=(Convection(("inside",), 8.0, 20.0), Convection(("outside",), 25.0, -10.0)))


def matrix_and_load(problem: HeatProblem) -> tuple[HeatSystem, sparse.csr_matrix, np.ndarray]:
    system = HeatSystem(problem, lumped=False, order=2)
    free = system.fixed.free
    matrix = sparse.csr_matrix(system.matrix(0.0, np.inf)[free][:, free])
    return system, matrix, np.random.default_rng(5).normal(size=len(free))


def test_the_solution_is_that_of_the_diagonal_alone() -> None:
    system, matrix, b = matrix_and_load(shell(1))
    found = system.linear_solver(matrix, 1e-12).solve(b)
    plain = LinearSolver(matrix, relative_tolerance=1e-12).solve(b)
    assert found.converged and found.residual < 1e-11
    np.testing.assert_allclose(found.x, plain.x, atol=1e-9 * np.abs(plain.x).max())
    assert found.iterations < 0.5 * plain.iterations


def test_iterations_do_not_grow_with_the_mesh() -> None:
    counts = []
    for refinements in (0, 1, 2):
        system, matrix, b = matrix_and_load(shell(refinements))
        counts.append(system.linear_solver(matrix, 1e-8).solve(b).iterations)
    assert max(counts) < 40 and counts[2] < 1.3 * counts[1], counts


def test_a_mesh_whose_corners_are_all_fixed() -> None:
    """Nothing is left of the coarse level; the middles of the inner edges are solved for by the diagonal alone."""
    mesh = box_mesh([0, 1], [0, 1], [0, 1])
    effects = (FixedTemperature(("*",), 0.0), InternalHeat(("*",), 60.0))
    solution = solve_steady(HeatProblem(mesh, STEEL, effects=effects), order=2)
    assert solution.edge_temperature_c.max() > 0.0 and np.abs(solution.temperature_c).max() == 0.0
    assert solution.effects[0].heat_w[0] == pytest.approx(-60.0, rel=1e-9)
