from dataclasses import replace

import numpy as np
import pytest
from skfem import FacetBasis, LinearForm, MeshTet

from tests.support.heat_bodies import STEEL
from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.fem.forms import FluxForm, heat_transfer
from thermoxels_ns.fem.problem import HeatProblem, Term
from thermoxels_ns.fem.quantities import Bounded, Bounds, Varying
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


def crooked_box():
    """A box of two regions whose inner nodes are off the lattice, so that no angle is right."""
    mesh = box_mesh(
        planes(0, 0.5, 1, step=0.25),
        np.linspace(0, 1, 4),
        np.linspace(0, 1, 4),
        regions={"left": lambda p: p[..., 0] < 0.5, "right": lambda p: p[..., 0] > 0.5},
    )
    inside = np.all((mesh.points_m > 1e-9) & (mesh.points_m < 1 - 1e-9), axis=1) & (mesh.points_m[:, 0] != 0.5)
    mesh.points_m[inside] += np.random.default_rng(1).uniform(-0.05, 0.05, (inside.sum(), 3))
    return mesh


def test_the_energy_of_a_quadratic_is_exact() -> None:
    """integral |grad q|^2 over the unit cube, grad q = b + A x: b.b + b.A1 + sum over A A^T of the moments of x."""
    space = Space(Selection(crooked_box()), order=2)
    moments = np.full((3, 3), 0.25) + np.eye(3) / 12.0
    exact = SLOPE @ SLOPE + SLOPE @ HESSIAN @ np.ones(3) + np.trace(HESSIAN @ HESSIAN.T @ moments)
    values = quadratic(space.points_m)
    stiffness = space.stiffness(np.ones(len(space.selection.mesh.tets)))
    assert values @ (stiffness @ values) == pytest.approx(exact, rel=1e-12)
    assert abs(stiffness - stiffness.T).max() == 0.0
    assert np.abs(stiffness @ np.ones(space.num_nodes)).max() < 1e-13 * abs(stiffness).max()
    doubled = space.stiffness(np.full(len(space.selection.mesh.tets), 2.0))
    assert abs(doubled - 2.0 * stiffness).max() == 0.0


def test_a_quadratic_temperature_is_exact() -> None:
    """div(k grad q) + s = 0, with q itself given on the surface."""
    mesh, k = crooked_box(), 50.0
    given = Varying(lambda places, t: quadratic(places.points_m), in_time=False)
    fixed = (FixedTemperature(("*",), given), InternalHeat(("*",), -k * np.trace(HESSIAN)))
    solution = solve_steady(HeatProblem(mesh, {"left": STEEL, "right": STEEL}, effects=fixed), order=2)
    found = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    np.testing.assert_allclose(found, quadratic(Space(Selection(mesh), order=2).points_m), atol=1e-9)
    assert solution.energy_residual < 1e-10


def test_integrals_over_the_surface_are_those_of_a_basis_on_facets() -> None:
    """Exchange and inflow with values per triangle, against scikit-fem's basis on the facets of the tetrahedra."""
    mesh = crooked_box()
    space = Space(Selection(mesh), order=2)
    tets = MeshTet(mesh.points_m.T.copy(), mesh.tets.T.copy())
    number = {tuple(facet): index for index, facet in enumerate(tets.facets.T.tolist())}
    facets = np.array([number[tuple(sorted(facet))] for facet in mesh.facets.tolist()])
    ours, theirs = space.surface(np.arange(len(facets))), FacetBasis(tets, space.element, facets=facets, intorder=4)
    value = np.random.default_rng(6).uniform(1.0, 2.0, (len(facets), 1))
    matrix, expected = (
        heat_transfer.assemble(basis, coefficient=np.broadcast_to(value, basis.dx.shape)) for basis in (ours, theirs)
    )
    assert abs(matrix - expected).max() < 1e-12 * abs(expected).max()
    flux = Bounded(Varying(lambda places, time_s: value[:, 0], in_time=False), Bounds("flux", "W/m2"))
    found = FluxForm("sun", Term("flux", np.arange(len(facets)), (flux,)), space, 0.0).load(0.0)
    expected = LinearForm(lambda v, w: w.flux * v).assemble(theirs, flux=np.broadcast_to(value, theirs.dx.shape))
    assert abs(found - expected).max() < 1e-12 * abs(expected).max()


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
def test_heat_of_the_nodes_is_heat_of_the_patches(box, concrete, order) -> None:
    """What the equations feed to all nodes is what the report says of all patches, to round-off."""
    system = HeatSystem(HeatProblem(box, concrete, effects=ALL), order=order)
    relative = system.start_k
    heat = system.net_heat(relative, 0.0)
    flows = system.group_heat_w(relative, 0.0)
    assert len(flows) == len(system.groups) == 8
    assert heat.sum() == pytest.approx(flows.sum(), abs=1e-12 * np.abs(heat).sum())
    assert np.abs(heat - np.roll(heat, 1)).max() > 1e-3


@pytest.mark.parametrize("order", [1, 2])
def test_the_slope_of_radiation_is_its_derivative(box, concrete, order) -> None:
    system = HeatSystem(HeatProblem(box, concrete, effects=ALL), order=order)
    relative = system.start_k
    direction = np.random.default_rng(0).uniform(-1.0, 1.0, len(relative))
    change = system.radiation_load(relative + 1e-3 * direction, 0.0) - system.radiation_load(
        relative - 1e-3 * direction, 0.0
    )
    slope = -system.radiation_slope(relative, 0.0) @ direction
    np.testing.assert_allclose(change / 2e-3, slope, atol=1e-8 * np.abs(slope).max())
    assert np.abs(slope).max() > 1e-3


def test_exchange_over_the_triangles_is_exact(box, concrete) -> None:
    """integral(h T u) for linear T and u on the side x1, by hand; at the nodes it is not, but for a constant."""
    problem = HeatProblem(box, concrete, effects=(Convection(("x1",), 6.0, 20.0),))
    exact = 6.0 * (0.3**2 / 2) * (0.2 + 0.2**2 / 2)
    for order, error in ((1, 0.05), (2, 1e-12)):
        system = HeatSystem(problem, order=order)
        x, t, z = system.space.points_m.T
        convection = system.convection_matrix(0.0)
        assert (1.0 + z) @ convection @ t == pytest.approx(exact, rel=error)
        assert convection.sum() == pytest.approx(6.0 * 0.06, rel=1e-12)
        assert order == 2 or convection.nnz == np.count_nonzero(x == 0.4)


def test_radiation_over_the_triangles_is_exact_for_linear_temperatures(box, concrete) -> None:
    """integral(T^4) of T = 300 + 100 y over the side x1 has degree 4, which the six points integrate."""
    start = 300.0 - 273.15 + 100.0 * box.points_m[:, 1]
    problem = HeatProblem(
        replace(box, temperature_c=start), concrete, effects=(Radiation(("x1",), 1.0, -273.15, 1e-8),)
    )
    system = HeatSystem(problem, order=2)
    heat = system.group_heat_w(system.start_k, 0.0)[0]
    assert heat == pytest.approx(-1e-8 * 0.2 * (330.0**5 - 300.0**5) / 500.0, rel=1e-12)


def test_the_default_matrix_is_an_m_matrix(box, concrete) -> None:
    system = HeatSystem(HeatProblem(box, concrete, effects=ALL))
    dense = (system.matrix(0.0, np.inf) + system.radiation_slope(box.temperature_c - system.reference_c, 0.0)).toarray()
    np.testing.assert_array_equal(dense, dense.T)
    assert (dense - np.diag(np.diag(dense))).max() <= 0.0
    assert np.linalg.inv(dense).min() >= 0.0
