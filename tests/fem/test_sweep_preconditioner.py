"""Sweeps solve what the diagonal solves, in a third of the iterations, wherever they are used."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from tests.support.heat_meshes import box_mesh, planes
from tests.support.stuffed_shapes import SHAPES, stiffness
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.linear_solver import ConjugateGradients
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solver_choice import LinearSolver
from thermoxels_ns.fem.sweep_preconditioner import SweptConjugateGradients, suits_sweeps
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.stuffing.isosurface import stuff

KERSHAW = np.array([[3.0, -2.0, 0.0, 2.0], [-2.0, 3.0, -2.0, 0.0], [0.0, -2.0, 3.0, -2.0], [2.0, 0.0, -2.0, 3.0]])
"""Positive definite (Kershaw, Journal of Computational Physics 26, 1978), but its last pivot is not."""


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


@pytest.mark.parametrize("fourier", [1e-3, 1.0, 1e3])
def test_the_solution_is_that_of_the_diagonal_and_of_a_direct_solver(fourier: float) -> None:
    matrix = lattice(7, fourier)
    b = right_hand_side(matrix)
    swept, plain = SweptConjugateGradients(matrix).solve(b), ConjugateGradients(matrix).solve(b)
    exact = spsolve(matrix.tocsc(), b)
    assert swept.converged and swept.residual < 2e-12
    np.testing.assert_allclose(swept.x, plain.x, atol=1e-9 * np.abs(exact).max())
    np.testing.assert_allclose(swept.x, exact, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("side", [8, 16, 24])
def test_long_steps_take_less_than_half_of_the_iterations(side: int) -> None:
    matrix = lattice(side, 0.02 * side**2)
    b = right_hand_side(matrix)
    swept, plain = SweptConjugateGradients(matrix).solve(b), ConjugateGradients(matrix).solve(b)
    assert swept.converged and plain.converged
    assert swept.iterations < 0.45 * plain.iterations, (swept.iterations, plain.iterations)


def test_steps_that_suit_the_mesh_take_as_many_iterations_on_any_of_them() -> None:
    counts = []
    for side in (16, 24, 32):
        matrix = lattice(side, 1.0)
        counts.append(SweptConjugateGradients(matrix).solve(right_hand_side(matrix)).iterations)
    assert max(counts) <= 1.2 * min(counts), counts


def test_of_a_chain_the_factor_is_complete() -> None:
    chain = sparse.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(2000, 2000), format="csr")
    exact = np.cos(0.01 * np.arange(2000.0))
    solution = SweptConjugateGradients(chain).solve(chain @ exact)
    assert solution.converged and solution.iterations <= 2 and "between sweeps" in solution.status
    np.testing.assert_allclose(solution.x, exact, atol=1e-7)


@pytest.mark.parametrize("pattern", ["halves", "checks", "random"])
@pytest.mark.parametrize("fourier", [1.0, 1e6])
def test_conductivities_that_differ_by_a_million(pattern: str, fourier: float) -> None:
    side = 14
    i, j, k = np.indices((side, side, side))
    kinds = {"halves": i < 7, "checks": (i // 3 + j // 3 + k // 3) % 2 == 0, "random": None}
    good = np.random.default_rng(3).random((side,) * 3) < 0.5 if kinds[pattern] is None else kinds[pattern]
    matrix = lattice(side, fourier, np.where(good, 1e3, 1e-3))
    b = matrix @ right_hand_side(matrix)
    swept, plain = SweptConjugateGradients(matrix).solve(b), ConjugateGradients(matrix).solve(b)
    assert swept.converged and swept.residual < 1e-11
    assert swept.iterations < 0.6 * plain.iterations, (swept.iterations, plain.iterations)


def test_a_pivot_that_is_not_positive_does_no_harm() -> None:
    matrix, b = sparse.csr_matrix(KERSHAW), np.array([1.0, -2.0, 3.0, 0.5])
    solution = SweptConjugateGradients(matrix).solve(b)
    assert np.linalg.eigvalsh(KERSHAW).min() > 0.0
    assert solution.converged
    np.testing.assert_allclose(solution.x, np.linalg.solve(KERSHAW, b), rtol=1e-9)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-8, 1e-12])
def test_it_is_the_residual_of_the_matrix_that_stops(tolerance: float) -> None:
    """Sizes of the nodes differ by 1e3: the residual of the sweeps has another norm."""
    scale = sparse.diags(10.0 ** np.random.default_rng(1).uniform(-1.5, 1.5, 12**3))
    matrix = sparse.csr_matrix(scale @ lattice(12, 50.0) @ scale)
    b = right_hand_side(matrix)
    solution = SweptConjugateGradients(matrix, relative_tolerance=tolerance).solve(b)
    before = SweptConjugateGradients(matrix, max_iterations=solution.iterations - 1, relative_tolerance=tolerance)
    assert solution.converged and true_residual(matrix, b, solution.x) <= 1.1 * tolerance
    assert before.solve(b).residual > 0.3 * tolerance


def test_a_start_shortens_it_and_the_solution_itself_ends_it() -> None:
    matrix = lattice(12, 50.0)
    b = right_hand_side(matrix)
    solver = SweptConjugateGradients(matrix, relative_tolerance=1e-10)
    first = solver.solve(b)
    near = solver.solve(b, first.x * (1.0 + 1e-6 * np.sin(np.arange(12.0**3))))
    assert near.converged and 0 < near.iterations < 0.7 * first.iterations
    assert solver.solve(b, SweptConjugateGradients(matrix).solve(b).x).iterations == 0


def test_nothing_to_solve_too_few_iterations_and_scale() -> None:
    matrix = lattice(10, 1e3)
    b = right_hand_side(matrix)
    assert not SweptConjugateGradients(matrix).solve(np.zeros(1000)).x.any()
    few = SweptConjugateGradients(matrix, max_iterations=3).solve(b)
    assert not few.converged and "stopped after 3 iterations" in few.status
    assert few.residual == pytest.approx(true_residual(matrix, b, few.x))
    tiny, whole = SweptConjugateGradients(matrix).solve(1e-300 * b), SweptConjugateGradients(matrix).solve(b)
    np.testing.assert_allclose(tiny.x / 1e-300, whole.x, rtol=1e-9)


def test_order_and_type_of_the_entries_do_not_matter_and_nothing_given_changes() -> None:
    matrix = lattice(9, 20.0)
    b = right_hand_side(matrix)
    data, given = matrix.data.copy(), b.copy()
    solver = SweptConjugateGradients(matrix)
    expected = solver.solve(b)
    np.testing.assert_array_equal(solver.solve(b).x, expected.x)
    np.testing.assert_array_equal(matrix.data, data)
    np.testing.assert_array_equal(b, given)
    wide, turned = matrix.copy(), matrix.copy()
    wide.indices, wide.indptr = wide.indices.astype(np.int64), wide.indptr.astype(np.int64)
    for row in range(9**3):
        part = slice(turned.indptr[row], turned.indptr[row + 1])
        turned.indices[part], turned.data[part] = turned.indices[part][::-1].copy(), turned.data[part][::-1].copy()
    turned.has_sorted_indices = False
    for same in (wide, turned):
        np.testing.assert_allclose(SweptConjugateGradients(same).solve(b).x, expected.x, rtol=1e-9, atol=1e-10)


def test_what_cannot_be_solved_is_an_error_or_a_status() -> None:
    bad = lattice(5, 1.0)
    bad.data[7] = np.nan
    with pytest.raises(HeatError, match="matrix of the heat problem"):
        SweptConjugateGradients(bad)
    indefinite = SweptConjugateGradients(sparse.csr_matrix(np.array([[1.0, 4.0], [4.0, 1.0]])))
    assert not indefinite.solve(np.array([1.0, -1.0])).converged
    b = np.ones(125)
    b[3] = np.nan
    with np.errstate(invalid="ignore"):
        solution = SweptConjugateGradients(lattice(5, 1.0)).solve(b)
    assert not solution.converged and solution.status


def test_sweeps_are_for_lattices() -> None:
    def cube() -> sparse.csr_matrix:
        mesh = box_mesh(*(planes(0.0, 0.8, step=0.1) for _ in range(3)))
        return HeatSystem(HeatProblem(mesh, Material("concrete", 1.7, 2200.0, 880.0))).matrix(0.0, 600.0)

    matrix = cube()
    shuffle = np.random.default_rng(0).permutation(len(matrix.indptr) - 1)
    solid = stuff(SHAPES["slab at 30 degrees"].level(8))
    conforming = sparse.csr_matrix(stiffness(solid.points, solid.tets))
    assert suits_sweeps(matrix) and LinearSolver(matrix).name == "incomplete factor"
    for other in (matrix[shuffle][:, shuffle], conforming + sparse.eye(conforming.shape[0])):
        assert not suits_sweeps(sparse.csr_matrix(other))
        assert LinearSolver(sparse.csr_matrix(other)).name == "diagonal"
    assert not suits_sweeps(sparse.csr_matrix([[1.0]])) and not suits_sweeps(sparse.csr_matrix((0, 0)))


def test_pieces_that_are_all_but_singular_and_nodes_that_are_fixed() -> None:
    """Two insulated cubes, 1e9 times as long a step as heat needs; then the same with a layer of nodes taken out."""
    cube = lattice(8, 1e9)
    pair = sparse.csr_matrix(sparse.block_diag([cube, cube]))
    exact = right_hand_side(pair)
    exact[:512] -= exact[:512].mean()
    exact[512:] -= exact[512:].mean()
    solution = SweptConjugateGradients(pair).solve(pair @ exact)
    assert suits_sweeps(pair) and solution.converged
    for piece in (slice(0, 512), slice(512, 1024)):
        error = solution.x[piece] - exact[piece]
        np.testing.assert_allclose(error - error.mean(), 0.0, atol=1e-9)
    free = np.flatnonzero(np.arange(1024) % 512 >= 64)
    held = sparse.csr_matrix(pair[free][:, free])
    b = right_hand_side(held)
    assert suits_sweeps(held)
    np.testing.assert_allclose(SweptConjugateGradients(held).solve(b).x, spsolve(held.tocsc(), b), atol=1e-8)
