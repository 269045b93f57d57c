from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from tests.support.heat_meshes import box_mesh
from tests.support.shell_mesh import shell_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.fem.solver_choice import LinearSolver
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.two_level import TwoLevelConjugateGradients
from thermoxels_ns.heat.effects import Convection, FixedTemperature, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material

STEEL = Material("steel", 50.0, 7800.0, 450.0)


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


@pytest.mark.parametrize("contrast", [1e-6, 1e6])
def test_conductivity_contrast_radiation_and_fixed_sides(contrast) -> None:
    axis = np.linspace(0, 1, 7)
    rod = {"block": lambda p: p[..., 0] > -1, "rod": lambda p: np.hypot(p[..., 1] - 0.5, p[..., 2] - 0.5) < 0.2}
    mesh = box_mesh(axis, axis, axis, regions=rod)
    materials = {"block": Material("a", 1.0, 1000.0, 1000.0), "rod": Material("b", contrast, 1000.0, 1000.0)}
    effects = (Convection(("x0",), 10.0, 20.0), FixedTemperature(("x1",), 0.0), Radiation(("z1",), 0.9, 10.0))
    solution = solve_steady(HeatProblem(mesh, materials, effects=effects), order=2)
    assert solution.converged and solution.energy_residual < 1e-9


def test_a_mesh_whose_corners_are_all_fixed() -> None:
    """Nothing is left of the coarse level; the middles of the inner edges are solved for by the diagonal alone."""
    mesh = box_mesh([0, 1], [0, 1], [0, 1])
    effects = (FixedTemperature(("*",), 0.0), InternalHeat(("*",), 60.0))
    solution = solve_steady(HeatProblem(mesh, STEEL, effects=effects), order=2)
    assert solution.edge_temperature_c.max() > 0.0 and np.abs(solution.temperature_c).max() == 0.0
    assert solution.effects[0].heat_w[0] == pytest.approx(-60.0, rel=1e-9)


def test_small_and_large_numbers() -> None:
    system, matrix, b = matrix_and_load(shell(0))
    ordinary = system.linear_solver(matrix, 1e-10).solve(b)
    for factor in (2.0**-500, 2.0**500):
        scaled = system.linear_solver(matrix, 1e-10).solve(factor * b)
        np.testing.assert_array_equal(scaled.x, factor * ordinary.x)
    assert np.all(system.linear_solver(matrix, 1e-10).solve(0.0 * b).x == 0.0)


def test_failures_are_said() -> None:
    system, matrix, b = matrix_and_load(shell(0))
    prolongation = sparse.csr_matrix(system.space.prolongation())  # type: ignore[attr-defined]
    few = TwoLevelConjugateGradients(matrix, prolongation, max_iterations=2).solve(b)
    assert not few.converged and "stopped after 2 iterations" in few.status
    bad = matrix.copy()
    bad.data[0] = np.nan
    with pytest.raises(HeatError, match="matrix of the heat problem: expected finite entries"):
        TwoLevelConjugateGradients(bad, prolongation)
    with pytest.raises(HeatError, match="diagonal above 0"):
        TwoLevelConjugateGradients(sparse.csr_matrix(-matrix), prolongation)


def test_linear_tetrahedra_keep_their_solver() -> None:
    problem = replace(shell(0))
    system = HeatSystem(problem)
    assert isinstance(system.linear_solver(system.matrix(0.0, np.inf), 1e-10), LinearSolver)
