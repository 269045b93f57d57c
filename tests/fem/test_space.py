from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import Delaunay

from tests.support.heat_bodies import CONCRETE, STEEL, box_mesh, mesh_from, planes, shell_mesh, storage
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.linear_tets import TET_EDGES, lumped_mass, refine_mesh, stiffness_matrix
from thermoxels_ns.fem.problem import AdaptiveSteps, Effect, HeatProblem, TimeSteps, Varying
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space, conduction
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import (
    AbsorbedSolar,
    Convection,
    FixedTemperature,
    GroundContact,
    HeatFlux,
    InternalHeat,
    Radiation,
)
from thermoxels_ns.heat.solving import Goals
from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

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
def test_heat_of_the_nodes_is_heat_of_the_patches_and_its_slope_the_derivative(box, order) -> None:
    """What the equations feed to all nodes is what the report says of all patches, to round-off."""
    system = HeatSystem(HeatProblem(box, CONCRETE, effects=ALL), order=order)
    relative = system.start_k
    heat = system.net_heat(relative, 0.0)
    flows = system.by_group(system.part_heat_w(relative, 0.0))
    assert len(flows) == len(system.groups) == 8
    assert heat.sum() == pytest.approx(flows.sum(), abs=1e-12 * np.abs(heat).sum())
    assert np.abs(heat - np.roll(heat, 1)).max() > 1e-3
    direction = np.random.default_rng(0).uniform(-1.0, 1.0, len(relative))
    after, before = (system.radiation_load(relative + step_k * direction, 0.0) for step_k in (1e-3, -1e-3))
    slope = -system.radiation_slope(relative, 0.0) @ direction
    np.testing.assert_allclose((after - before) / 2e-3, slope, atol=1e-8 * np.abs(slope).max())
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


REGIONS = {"inner": lambda p: p[..., 0] < 0.25, "outer": lambda p: p[..., 0] > 0.25}
BOX = box_mesh(np.linspace(0, 0.5, 5), [0, 0.2], [0, 0.2], regions=REGIONS)
EMPTY = replace(CONCRETE, density_kg_m3=1.0, specific_heat_j_kgk=1e-12)
NAN, INF = float("nan"), float("inf")
Refused = list[tuple[str, Callable[[], Any]]]


def body(**changes: Any) -> HeatProblem:
    return HeatProblem(replace(BOX, **changes), {"inner": CONCRETE, "outer": CONCRETE})


def tagged(**changes: Any) -> HeatSystem:
    return HeatSystem(body(boundary=replace(BOX.boundary, **changes)))


def acting(*effects: Effect) -> Any:
    return solve_steady(replace(body(), effects=effects))


def moved(values: np.ndarray, place: Any, value: float) -> np.ndarray:
    changed = values.copy()
    changed[place] = value
    return changed


STEPS: Refused = [
    ("tolerance_k", lambda: Goals(tolerance_k=0.0)),
    ("flow_tolerance", lambda: Goals(flow_tolerance=1.5)),
    ("leave_out_below", lambda: Goals(flow_tolerance=0.05, leave_out_below=0.01)),
    ("memory_gb", lambda: Goals(memory_gb=-1.0)),
    ("step_seconds", lambda: TimeSteps(10, 1e308)),
    *(("steps", lambda n=n: TimeSteps(n, 60.0)) for n in (0, -1, 2.5, True, "10")),
    *(("step_seconds", lambda s=s: TimeSteps(10, s)) for s in (0.0, -60.0, NAN, INF)),
    ("duration_s", lambda: AdaptiveSteps(0.0)),
    ("tolerance_k", lambda: AdaptiveSteps(60.0, -1.0)),
    *(("outputs", lambda n=n: AdaptiveSteps(60.0, outputs=n)) for n in (0, 1.5)),
    *(
        ("heat capacity", lambda t=t: solve_heat(HeatProblem(BOX, EMPTY), t))
        for t in (TimeSteps(3, 1.0), AdaptiveSteps(9.0))
    ),
]
MESHES: Refused = [
    ("mesh points_m", lambda: body(points_m=moved(BOX.points_m, (3, 1), NAN))),
    ("mesh tets", lambda: body(tets=np.concatenate([BOX.tets[:1, [1, 0, 2, 3]], BOX.tets[1:]]))),
    ("mesh tets", lambda: body(points_m=BOX.points_m * [1.0, 1.0, 0.0])),
    ("mesh tets", lambda: body(tets=moved(BOX.tets, (0, 0), len(BOX.points_m)))),
    ("mesh tets", lambda: body(tets=BOX.tets[:0])),
    ("mesh points", lambda: HeatProblem(mesh_from(np.vstack([BOX.points_m, [[9, 9, 9]]]), BOX.tets), CONCRETE)),
    *(("mesh temperature_c", lambda t=t: body(temperature_c=moved(BOX.temperature_c, 5, t))) for t in (NAN, -274.0)),
    ("mesh temperature_c", lambda: body(temperature_c=BOX.temperature_c[:-1])),
    ("mesh boundary.patch", lambda: tagged(patch=np.full(len(BOX.facets), 7))),
    ("mesh boundary.patch", lambda: tagged(patch=np.zeros(3, np.int64))),
]
PROBLEMS: Refused = [
    *(("up", lambda u=u: HeatProblem(BOX, CONCRETE, up=u)) for u in ((0.0, 0.0, 0.0), (1.0, 2.0))),
    ("materials", lambda: HeatProblem(BOX, {"inner": CONCRETE})),
    *(
        (name, lambda n=name, v=value: replace(CONCRETE, **{n: v}))
        for name in ("conductivity_w_mk", "density_kg_m3", "specific_heat_j_kgk")
        for value in (0.0, NAN, "1.7")
    ),
    *(("steady heat problem", lambda e=e: acting(*e)) for e in ((), (HeatFlux(("*",), 1.0),))),
    ("steady heat problem", lambda: acting(Convection(("*",), 0.0, 20.0))),
]
EFFECTS: Refused = [
    ("patches", lambda: Convection("x0", 5.0, 20.0)),  # type: ignore[arg-type]
    ("coefficient_w_m2k", lambda: Convection(("*",), -1.0, 20.0)),
    *(("flux_w_m2", lambda f=f: HeatFlux(("*",), f)) for f in (True, np.ones(3), lambda places, time_s: 1.0)),
    ("emissivity", lambda: Radiation(("*",), 1.01, 20.0)),
    *(("surroundings_c", lambda t=t: Radiation(("*",), 0.9, t)) for t in (1e6, 1e300)),
    ("air_c", lambda: Convection(("*",), 5.0, 1e6)),
    ("resistance_m2k_w", lambda: GroundContact(("*",), 0.0, 10.0)),
    *(("patches", lambda p=p: acting(HeatFlux(p, 1.0))) for p in (("roof",), ("x0", "X?"))),
    ("regions", lambda: acting(InternalHeat(("oven",), 1.0))),
]


@pytest.mark.parametrize(("name", "make"), [*STEPS, *MESHES, *PROBLEMS, *EFFECTS])
def test_what_cannot_be_is_refused_by_its_name(name, make) -> None:
    with pytest.raises(HeatError, match=f"^{name}: expected"):
        make()


def turned(facets: np.ndarray) -> set[tuple[int, ...]]:
    """Triangles from their smallest node on, which keeps their sense of rotation."""
    return {tuple(np.roll(facet, -int(np.argmin(facet)))) for facet in facets}


def notched() -> TetMesh:
    mesh = box_mesh(
        [0, 1, 2, 4],
        [0, 1, 2],
        [0, 1.5, 2],
        temperature_c=lambda p: 3 * p[:, 0] - p[:, 2],
        regions={"low": lambda p: p[..., 0] < 2, "high": lambda p: p[..., 0] > 2},
        keep=lambda p: (p[..., 0] < 2) | (p[..., 1] < 1),
    )
    tags = mesh.boundary
    return replace(
        mesh,
        boundary=replace(tags, seen=tags.patch % 2 == 0),
        colour=np.linspace(0, 1, 3 * len(mesh.points_m), dtype=np.float32).reshape(-1, 3),
        observed=mesh.points_m[:, 0] < 1.5,
    )


@pytest.mark.parametrize("make", [notched, lambda: shell_mesh(0.5, 0.6, 2, 1)], ids=["notched", "shell"])
def test_the_body_and_its_boundary_stay_the_same(make) -> None:
    mesh = make()
    fine = refine_mesh(mesh)
    assert len(fine.tets) == 8 * len(mesh.tets) and len(fine.facets) == 4 * len(mesh.facets)
    parts = signed_volumes(fine.points_m, fine.tets).reshape(-1, 8)
    assert parts.min() > 0.0
    # Each child is an eighth of its parent, and stands where its parent stood.
    before = signed_volumes(mesh.points_m, mesh.tets)
    np.testing.assert_allclose(parts, np.repeat(before[:, None] / 8.0, 8, axis=1), rtol=1e-9)
    # Conforming: what faces no other tetrahedron is exactly the children of the boundary, with their orientation.
    assert turned(boundary_facets(fine.tets)) == turned(fine.facets)
    areas, finer = (facet_areas(one.points_m, one.facets) for one in (mesh, fine))
    np.testing.assert_allclose(finer.reshape(-1, 4), np.repeat(areas[:, None] / 4.0, 4, axis=1))
    assert len(np.unique(fine.tets)) == len(fine.points_m)


def test_children_inherit() -> None:
    mesh = notched()
    fine = refine_mesh(mesh)
    tags, finer = mesh.boundary, fine.boundary
    np.testing.assert_array_equal(fine.region, np.repeat(mesh.region, 8))
    for name in ("patch", "seen"):
        np.testing.assert_array_equal(getattr(finer, name), np.repeat(getattr(tags, name), 4, axis=0))
    np.testing.assert_array_equal(fine.facet_tags, np.repeat(mesh.facet_tags, 4))
    assert finer.patch_names == tags.patch_names and fine.region_names == mesh.region_names
    old = len(mesh.points_m)
    np.testing.assert_array_equal(fine.points_m[:old], mesh.points_m)
    np.testing.assert_array_equal(fine.observed[:old], mesh.observed)
    # Linear data stay linear; a node between a seen and an unseen one was not seen.
    np.testing.assert_allclose(fine.temperature_c, 3 * fine.points_m[:, 0] - fine.points_m[:, 2], atol=1e-12)
    np.testing.assert_array_equal(fine.observed, fine.points_m[:, 0] <= 1.0)
    assert fine.colour.dtype == np.float32 and fine.colour.min() >= 0.0 and fine.colour.max() <= 1.0
    np.testing.assert_array_equal(refine_mesh(replace(mesh, boundary=None, colour=None)).tets, fine.tets)


def test_no_angle_of_a_lattice_becomes_obtuse() -> None:
    """Entries of the stiffness matrix off its diagonal stay below 0: the maximum principle survives."""
    mesh = box_mesh([0, 1, 2], [0, 1], [0, 1])
    for _ in range(3):
        mesh = refine_mesh(mesh)
        stiffness = stiffness_matrix(mesh.points_m, mesh.tets, np.ones(len(mesh.tets)))
        stiffness.setdiag(0.0)
        assert stiffness.max() <= 0.0
        corner = mesh.points_m[mesh.tets]
        lengths = np.linalg.norm(corner[:, TET_EDGES[:, 0]] - corner[:, TET_EDGES[:, 1]], axis=2)
        # All children are of the one shape of the parents.
        shapes = np.sort(lengths, axis=1) / lengths.min(axis=1)[:, None]
        np.testing.assert_allclose(shapes, np.tile(np.sqrt([1, 1, 1, 2, 2, 3]), (len(shapes), 1)))


def test_shapes_do_not_degenerate() -> None:
    """Where tetrahedra are irregular, three more refinements leave the worst shape as it is after the first."""
    mesh, worst = shell_mesh(0.5, 0.6, 2, 1, eighth=True), []
    for _ in range(4):
        mesh = refine_mesh(mesh)
        corner = mesh.points_m[mesh.tets]
        longest = np.linalg.norm(corner[:, TET_EDGES[:, 0]] - corner[:, TET_EDGES[:, 1]], axis=2).max(axis=1)
        worst.append(float((signed_volumes(mesh.points_m, mesh.tets) / longest**3).min()))
    assert worst[-1] == pytest.approx(worst[0], rel=0.3), worst


def kuhn_mesh() -> tuple[np.ndarray, np.ndarray]:
    corners, tets = kuhn_tets(np.random.default_rng(5).random((4, 3, 5)) < 0.8)
    return 0.07 * corners, tets


def random_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Without flat tetrahedra; the inverted ones are turned over."""
    points = np.random.default_rng(6).uniform(-1.0, 2.0, (150, 3))
    tets = Delaunay(points).simplices.astype(np.int64)
    volumes = signed_volumes(points, tets)
    tets = np.where(volumes[:, None] > 0, tets, tets[:, [0, 2, 1, 3]])
    tets = tets[np.abs(volumes) > 1e-3 * np.median(np.abs(volumes))]
    used, numbers = np.unique(tets, return_inverse=True)
    return points[used], numbers.reshape(-1, 4)


MESHES = {"kuhn": kuhn_mesh, "random": random_mesh}


def space(points: np.ndarray, tets: np.ndarray) -> Space:
    return Space(Selection(mesh_from(points, tets)))


@pytest.mark.parametrize("mesh", MESHES)
def test_matrices_are_those_of_the_forms_of_scikit_fem(mesh: str) -> None:
    points, tets = MESHES[mesh]()
    varied = 10.0 ** np.random.default_rng(9).uniform(-3.0, 3.0, len(tets))
    for conductivity in (np.full(len(tets), 1.7), varied):
        expected = space(points, tets).assembled(conduction, 0, conductivity=conductivity).toarray()
        stiffness = stiffness_matrix(points, tets, conductivity)
        assert np.abs(stiffness.toarray() - expected).max() < 1e-13 * np.abs(expected).max()
    nodal = space(points, tets).assembled(storage, 2, heat_capacity=1e5 * varied) @ np.ones(len(points))
    np.testing.assert_allclose(lumped_mass(points, tets, 1e5 * varied), nodal, rtol=1e-12)


def test_right_angles_couple_nothing_wherever_the_body_stands() -> None:
    """Nodes that only right angles lie between have no entry, so that matrices of lattices are small."""
    points, tets = kuhn_mesh()
    stiffness = stiffness_matrix(points, tets, np.full(len(tets), 1.7))
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    moved = stiffness_matrix(points @ turn + [30.0, -50.0, 10.0], tets, np.full(len(tets), 1.7))
    assert np.diff(stiffness.indptr).max() == 7 and stiffness.nnz == moved.nnz
    assert (stiffness != stiffness.T).nnz == 0
    assert np.abs(stiffness - moved).max() < 1e-11 * stiffness.max()
