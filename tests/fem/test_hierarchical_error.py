"""The estimate of the error of linear tetrahedra in a steady state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.support.building_corner import building_corner
from tests.support.heat_meshes import box_mesh, planes
from tests.support.shell_mesh import shell_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.edge_exchange import EdgeExchange, EdgeSpace
from thermoxels_ns.fem.edge_operator import EdgeOperator
from thermoxels_ns.fem.hierarchical_error import steady_surplus
from thermoxels_ns.fem.linear_start import linear_start
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.sparsity import mesh_edges
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.effects import Convection, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material

CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)
WITHIN = 1.6
"""Factor that an estimate of the largest error may be off by on these problems."""


def cube(parts: int, *effects, material=CONCRETE) -> HeatProblem:
    axis = np.linspace(0.0, 0.4, parts + 1)
    return HeatProblem(box_mesh(axis, axis, axis, temperature_c=300.0), material, effects=effects)


def contrast() -> HeatProblem:
    axis = np.linspace(0.0, 0.4, 9)
    regions: dict = {"foam": lambda c: np.ones(c.shape[:-1], bool), "steel": lambda c: (c[..., :2] < 0.2).all(axis=-1)}
    mesh = box_mesh(axis, axis, axis, regions=regions)
    made_of = {"foam": Material("foam", 0.04, 30.0, 1000.0), "steel": Material("steel", 50.0, 7800.0, 460.0)}
    return HeatProblem(mesh, made_of, effects=(Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, 0.0)))


WAVES = Varying(lambda places, time_s: 20.0 + 10.0 * np.sin(9.0 * places.points_m[:, 1]))
PROBLEMS: dict[str, Callable[[], HeatProblem]] = {
    "building corner": lambda: building_corner(lambda *knots: planes(*knots, step=0.2)),
    "shell": lambda: HeatProblem(
        shell_mesh(0.5, 0.6, 8, 2, eighth=True),
        CONCRETE,
        effects=(Convection(("inside",), 7.69, 20.0), Convection(("outside",), 25.0, -10.0)),
    ),
    "radiation": lambda: cube(6, FixedTemperature(("x0",), 600.0), Radiation(("x1", "y?"), 0.9, 20.0)),
    "given beside air": lambda: cube(6, FixedTemperature(("z0",), 30.0), Convection(("x1", "y?"), 25.0, -10.0)),
    "source": lambda: cube(6, Convection(("x0",), 8.0, 20.0), InternalHeat(("solid",), 500.0)),
    "given waves": lambda: cube(6, FixedTemperature(("x0",), WAVES), HeatFlux(("y1",), 200.0)),
    "conductivities": contrast,
}


def estimated(problem: HeatProblem, relative_tolerance: float = 1e-9):
    solution = solve_steady(problem, relative_tolerance=relative_tolerance)
    system = HeatSystem(problem)
    return solution, steady_surplus(system, solution.temperature_c - system.reference_c)


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_largest_error_is_estimated(name) -> None:
    problem = PROBLEMS[name]()
    solution, surplus = estimated(problem)
    finer = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=None)
    exact = solve_steady(finer, order=2, relative_tolerance=1e-8)
    true = exact.temperature_c[: len(solution.temperature_c)] - solution.temperature_c
    ratio = float(np.abs(surplus.temperature_k).max() / np.abs(true).max())
    assert 1 / WITHIN < ratio < WITHIN, ratio
    along = float(surplus.temperature_k[0] @ true / np.linalg.norm(surplus.temperature_k) / np.linalg.norm(true))
    assert along > 0.7, "the estimate knows where and of which sign the error is"


@pytest.mark.parametrize("name", ["building corner", "shell", "given beside air", "conductivities"])
def test_errors_of_heat_flows_are_estimated(name) -> None:
    problem = PROBLEMS[name]()
    solution, surplus = estimated(problem)
    finer = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=None)
    exact = solve_steady(finer, order=2, relative_tolerance=1e-8)
    for before, after in zip(solution.effects, exact.effects):
        mine = [w for (effect, _), w in zip(surplus.groups, surplus.group_heat_w[0]) if effect == before.effect]
        assert 1 / WITHIN < sum(mine) / float(after.heat_w[0] - before.heat_w[0]) < WITHIN, before.effect


def test_what_is_linear_has_no_error() -> None:
    """A wall between two airs: linear tetrahedra are exact, whatever their number."""
    problem = cube(3, Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -10.0))
    _, surplus = estimated(problem, 1e-12)
    assert np.abs(surplus.temperature_k).max() < 1e-7 and np.abs(surplus.group_heat_w).max() < 1e-6
    fixed = cube(3, FixedTemperature(("x0",), 20.0), FixedTemperature(("x1",), -10.0))
    _, surplus = estimated(fixed, 1e-12)
    assert np.abs(surplus.temperature_k).max() < 1e-7 and np.abs(surplus.group_heat_w).max() < 1e-6


def test_products_are_those_of_the_matrix_of_quadratic_tetrahedra() -> None:
    problem = PROBLEMS["conductivities"]()
    mesh = problem.mesh
    edges, num_nodes = mesh_edges(mesh.tets, len(mesh.points_m)), len(mesh.points_m)
    space = EdgeSpace(Selection(mesh), edges)
    operator = EdgeOperator(problem, space.tet_edges, len(edges.other))
    rng = np.random.default_rng(0)
    nodal, bubble = rng.normal(size=num_nodes), rng.normal(size=len(edges.other))
    stiffness, change = space.stiffness(problem.conductivity_w_mk), space.prolongation()
    full = change @ nodal
    full[num_nodes:] += bubble
    heat = stiffness @ full
    at_nodes, at_edges = operator.conducted(nodal, bubble)
    np.testing.assert_allclose(at_edges, heat[num_nodes:], atol=1e-10 * np.abs(heat).max())
    np.testing.assert_allclose(at_nodes, change.T @ heat, atol=1e-10 * np.abs(heat).max())
    only_nodes = stiffness @ (change @ nodal)
    np.testing.assert_allclose(
        operator.conducted_to_edges(nodal), only_nodes[num_nodes:], atol=1e-10 * np.abs(heat).max()
    )
    np.testing.assert_allclose(operator.edge_diagonal(), stiffness.diagonal()[num_nodes:], rtol=1e-10)


def test_exchange_is_that_of_the_quadratic_system() -> None:
    effects = (
        *(FixedTemperature(("x0",), WAVES), Radiation(("x1", "y0"), 0.9, 20.0), Convection(("y?",), 9.0, 5.0)),
        *(HeatFlux(("z0",), 30.0), InternalHeat(("solid",), 500.0)),
    )
    problem = cube(2, *effects)
    system = HeatSystem(problem, lumped=False, order=2)
    space = EdgeSpace(Selection(problem.mesh), mesh_edges(problem.mesh.tets, len(problem.mesh.points_m)))
    exchange = EdgeExchange(problem, space, system.reference_c)
    relative_k = np.random.default_rng(1).normal(scale=50.0, size=space.num_nodes)
    expected = system.exchanged_heat(relative_k, 0.0)[0]
    np.testing.assert_allclose(exchange.heat(relative_k, 0.0), expected, atol=1e-9 * np.abs(expected).max())
    slopes, matrix = exchange.slopes(relative_k, 0.0), system.radiation_slope(relative_k, 0.0)
    matrix = matrix + system.exchange_matrix(0.0)
    change = np.random.default_rng(2).normal(size=space.num_nodes)
    np.testing.assert_allclose(exchange.taken(slopes, change), matrix @ change, atol=1e-9)
    np.testing.assert_allclose(exchange.diagonal(slopes), matrix.diagonal(), atol=1e-12)
    assert np.array_equal(exchange.fixed.nodes, system.fixed.nodes)


def test_linear_start_is_the_steady_state() -> None:
    problem = PROBLEMS["radiation"]()
    start, plain = linear_start(problem, time_s=0.0, relative_tolerance=1e-10), solve_steady(problem)
    np.testing.assert_allclose(start.solution.temperature_c, plain.temperature_c, atol=1e-6)
    assert [h.effect for h in start.solution.effects] == [h.effect for h in plain.effects]
    assert start.error.temperature_k > 0.0 and start.solution.newton_iterations > 0
    with pytest.raises(HeatError, match="steady heat problem: expected convection"):
        linear_start(cube(2, HeatFlux(("x0",), 1.0)), time_s=0.0, relative_tolerance=1e-8)
