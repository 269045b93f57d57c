from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, STEEL, box_mesh, planes
from thermoxels_ns.fem.problem import HeatProblem, Varying
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.effects import (
    AbsorbedSolar,
    Convection,
    FixedTemperature,
    GroundContact,
    HeatFlux,
    InternalHeat,
    Radiation,
)
from thermoxels_ns.mesh.tetrahedra import TetMesh

HESSIAN = np.array([[2.0, 0.5, -1.0], [0.5, -3.0, 0.25], [-1.0, 0.25, 1.5]])
SLOPE = np.array([1.0, -2.0, 0.5])


def quadratic(points: np.ndarray) -> np.ndarray:
    return 3.0 + points @ SLOPE + 0.5 * np.einsum("ki,ij,kj->k", points, HESSIAN, points)


def test_a_quadratic_temperature_is_exact() -> None:
    """div(k grad q) + s = 0, with q itself given on the surface."""
    regions = {"left": lambda p: p[..., 0] < 0.5, "right": lambda p: p[..., 0] > 0.5}
    mesh, k = box_mesh(*(planes(0, 0.5, 1, step=0.25) for _ in range(3)), regions=regions), 50.0
    # Inner nodes off the lattice, so that no angle is right.
    inside = np.all((mesh.points_m > 1e-9) & (mesh.points_m < 1 - 1e-9), axis=1) & (mesh.points_m[:, 0] != 0.5)
    mesh.points_m[inside] += np.random.default_rng(1).uniform(-0.05, 0.05, (inside.sum(), 3))
    given = Varying(lambda places, t: quadratic(places.points_m), in_time=False)
    fixed = (FixedTemperature(("*",), given), InternalHeat(("*",), -k * np.trace(HESSIAN)))
    solution = solve_steady(HeatProblem(mesh, {"left": STEEL, "right": STEEL}, effects=fixed), order=2)
    found = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    np.testing.assert_allclose(found, quadratic(Space(Selection(mesh), order=2).points_m), atol=1e-9)
    assert solution.energy_residual < 1e-10


ALL = (
    Convection(("x0", "y0"), Varying(lambda places, time_s: 5.0 + places.points_m[:, 2], in_time=False), 30.0),
    GroundContact(("z0",), 2.5, 10.0),
    Radiation(("x1", "z1"), 0.9, -20.0),
    AbsorbedSolar(("z1",), 0.6, 500.0),
    HeatFlux(("y1",), -30.0),
    InternalHeat(("*",), 200.0),
)


@pytest.fixture
def box() -> TetMesh:
    axes = (np.linspace(0, 0.4, 5), np.linspace(0, 0.3, 4), np.linspace(0, 0.2, 3))
    return box_mesh(*axes, temperature_c=lambda p: 20.0 + 30.0 * np.sin(9.0 * p @ [1.0, 2.0, 3.0]))


@pytest.mark.parametrize("order", [1, 2])
def test_heat_of_the_nodes_is_heat_of_the_patches(box, order) -> None:
    """What the equations feed to all nodes is what the report says of all patches, to round-off."""
    system = HeatSystem(HeatProblem(box, CONCRETE, effects=ALL), order=order)
    relative = system.start_k
    heat = system.net_heat(relative, 0.0)
    flows = system.by_group(system.part_heat_w(relative, 0.0))
    assert len(flows) == len(system.groups) == 8
    assert heat.sum() == pytest.approx(flows.sum(), abs=1e-12 * np.abs(heat).sum())
    assert np.abs(heat - np.roll(heat, 1)).max() > 1e-3


@pytest.mark.parametrize("order", [1, 2])
def test_the_slope_of_radiation_is_its_derivative(box, order) -> None:
    system = HeatSystem(HeatProblem(box, CONCRETE, effects=ALL), order=order)
    relative = system.start_k
    direction = np.random.default_rng(0).uniform(-1.0, 1.0, len(relative))
    change = system.radiation_load(relative + 1e-3 * direction, 0.0) - system.radiation_load(
        relative - 1e-3 * direction, 0.0
    )
    slope = -system.radiation_slope(relative, 0.0) @ direction
    np.testing.assert_allclose(change / 2e-3, slope, atol=1e-8 * np.abs(slope).max())
    assert np.abs(slope).max() > 1e-3


def test_exchange_over_the_triangles_is_exact(box) -> None:
    """integral(h T u) for linear T and u on the side x1, by hand; at the nodes it is not, but for a constant."""
    problem = HeatProblem(box, CONCRETE, effects=(Convection(("x1",), 6.0, 20.0),))
    exact = 6.0 * (0.3**2 / 2) * (0.2 + 0.2**2 / 2)
    for order, error in ((1, 0.05), (2, 1e-12)):
        system = HeatSystem(problem, order=order)
        x, t, z = system.space.points_m.T
        convection = system.convection_matrix(0.0)
        assert (1.0 + z) @ convection @ t == pytest.approx(exact, rel=error)
        assert convection.sum() == pytest.approx(6.0 * 0.06, rel=1e-12)
        assert order == 2 or convection.nnz == np.count_nonzero(x == 0.4)


def test_radiation_over_the_triangles_is_exact_for_linear_temperatures(box) -> None:
    """integral(T^4) of T = 300 + 100 y over the side x1 has degree 4, which the six points integrate."""
    start = 300.0 - 273.15 + 100.0 * box.points_m[:, 1]
    problem = HeatProblem(
        replace(box, temperature_c=start), CONCRETE, effects=(Radiation(("x1",), 1.0, -273.15, 1e-8),)
    )
    system = HeatSystem(problem, order=2)
    heat = system.by_group(system.part_heat_w(system.start_k, 0.0))[0]
    assert heat == pytest.approx(-1e-8 * 0.2 * (330.0**5 - 300.0**5) / 500.0, rel=1e-12)
