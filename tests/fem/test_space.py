import numpy as np
import pytest
from skfem import FacetBasis, LinearForm, MeshTet

from tests.support.heat_bodies import STEEL
from tests.support.heat_meshes import box_mesh, planes
from tests.support.shell_mesh import shell_mesh
from thermoxels_ns.fem.forms import FluxForm, heat_transfer
from thermoxels_ns.fem.problem import HeatProblem, Term
from thermoxels_ns.fem.quantities import Bounded, Bounds, Varying
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.heat.effects import FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material

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


def test_p1_is_part_of_p2() -> None:
    """Restricted to functions that are linear in each tetrahedron, the matrices are those of P1."""
    mesh = shell_mesh(0.5, 0.6, 3, 2)
    linear, space = Space(Selection(mesh)), Space(Selection(mesh), order=2)
    conductivity = np.random.default_rng(2).uniform(1.0, 5.0, len(mesh.tets))
    u, v = np.random.default_rng(3).normal(size=(2, len(mesh.points_m)))
    fine_u, fine_v = space.from_mesh_nodes(u), space.from_mesh_nodes(v)
    of_linear, of_quadratic = linear.stiffness(conductivity), space.stiffness(conductivity)
    assert fine_u @ (of_quadratic @ fine_v) == pytest.approx(u @ (of_linear @ v), rel=1e-11)
    every = np.arange(len(mesh.tets))
    load = space.source_load(every, np.repeat(conductivity / 4.0, 4))
    assert fine_u @ load == pytest.approx(u @ linear.source_load(every, conductivity), rel=1e-11)


def test_a_quadratic_temperature_is_exact() -> None:
    """div(k grad q) + s = 0 with the flux of q through one side, convection, and q itself on the others."""
    mesh, k = crooked_box(), 50.0
    space = Space(Selection(mesh), order=2)

    def gradient(points):
        return SLOPE + points @ HESSIAN

    side = Varying(lambda places, t: k * gradient(places.points_m)[:, 2], in_time=False)
    given = Varying(lambda places, t: quadratic(places.points_m), in_time=False)
    effects = (
        FixedTemperature(("x?", "y?", "z0"), given),
        HeatFlux(("z1",), side),
        InternalHeat(("*",), -k * np.trace(HESSIAN)),
    )
    solution = solve_steady(HeatProblem(mesh, {"left": STEEL, "right": STEEL}, effects=effects), order=2)
    exact = quadratic(space.points_m)
    found = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    # The flux is taken at the centroids of the triangles: exact in the mean only. The rest is not touched by it.
    assert np.abs(found - exact).max() < 0.02 * np.ptp(exact)
    fixed = (FixedTemperature(("*",), given), InternalHeat(("*",), -k * np.trace(HESSIAN)))
    solution = solve_steady(HeatProblem(mesh, {"left": STEEL, "right": STEEL}, effects=fixed), order=2)
    found = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    np.testing.assert_allclose(found, exact, atol=1e-9)
    assert solution.energy_residual < 1e-10


def test_radiation_is_integrated() -> None:
    """NAFEMS T2: a rod at 1000 K that radiates at its other end, 927.0076 K there."""
    mesh = box_mesh(np.linspace(0, 0.1, 3), [0, 0.01], [0, 0.01])
    effects = (FixedTemperature(("x0",), 726.85), Radiation(("x1",), 0.98, 26.85, 5.67e-8))
    solution = solve_steady(HeatProblem(mesh, Material("rod", 55.6, 7850.0, 460.0), effects=effects), order=2)
    end_k = solution.temperature_c[mesh.points_m[:, 0] == 0.1] + 273.15
    np.testing.assert_allclose(end_k, 927.0076, atol=1e-4)


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
