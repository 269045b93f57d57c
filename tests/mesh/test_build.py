from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from threadpoolctl import threadpool_limits

from tests.support.looking_cameras import looking_at
from tests.support.stuffed_shapes import on_surface, random_turn
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh import temperature
from thermoxels_ns.mesh.boundary.patches import DEFAULT_PATCHES
from thermoxels_ns.mesh.build import BuiltMesh, build_mesh
from thermoxels_ns.mesh.quality.checks import check_mesh, component_of
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.stuffing.isosurface import stuff
from thermoxels_ns.mesh.temperature import extend_harmonically, interpolate_corners
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, FACET_SURFACE, facet_areas
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

DENSE = SolidSelection(close_gaps=0, density_threshold=0.5)
VOXEL = "voxel"
MODES = ["conforming", "voxel"]


def linear_map(linear: np.ndarray, shift=(0.0, 0.0, 0.0)) -> np.ndarray:
    return np.block([[linear, np.array(shift)[:, None]], [np.zeros(3), 1.0]])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("mirror", [False, True])
def test_rotated_scaled_and_mirrored_meshes_stay_valid(snapshot_of, mirror, mode):
    linear = random_turn(5) @ (np.diag([1.0, 1.0, -1.0]) if mirror else np.eye(3))
    density = np.ones((6, 5, 4))
    density[:3, :3, 2:] = 0.0
    field = snapshot_of(density, lo=(-1.0, 2.0, 0.5), voxel_size=0.25)
    built = build_mesh(field, DENSE, linear_map(3.0 * linear, (5.0, -7.0, 1.0)), mode)
    quality = check_mesh(built.mesh)  # positive volumes, facets outwards
    exact = built.solid.cells.sum() * (0.25 * 3.0) ** 3
    assert quality.volume_m3 == pytest.approx(exact, rel=1e-12 if mode == "voxel" else 0.2)


def test_extension_conducts_like_the_voxels_do(snapshot_of):
    # A bar seen at both ends only, with a step in its width: four times as many voxels in the wide half.
    density = np.zeros((42, 4, 4))
    density[:, :2, :2] = 1.0
    density[21:, :3, :3] = 1.0
    weight = np.zeros(density.shape)
    weight[[0, -1]] = 1.0
    values = np.zeros(density.shape)
    values[-1] = 100.0
    whole = SolidSelection(close_gaps=0, density_threshold=1.0)
    mesh = build_mesh(snapshot_of(density, values, weight), whole, np.eye(4), VOXEL).mesh
    x = mesh.points_m[:, 0] / 0.5
    thin = mesh.temperature_c[x == 10].mean() - mesh.temperature_c[x == 5].mean()
    wide = mesh.temperature_c[x == 37].mean() - mesh.temperature_c[x == 32].mean()
    assert thin == pytest.approx(4 * wide, rel=1e-6)


def test_body_no_thermal_ray_saw_is_refused(snapshot_of):
    with pytest.raises(MeshError, match="thermal ray"):
        build_mesh(snapshot_of(np.ones((3, 3, 3)), 20.0, 0.0), DENSE, np.eye(4))


def test_part_no_thermal_ray_saw_is_left_out(snapshot_of):
    # Three bodies: one seen, one that touches it by a corner only, and one apart that nobody saw.
    cells = np.zeros((7, 4, 4), bool)
    cells[:2, :2, :2] = cells[2, 2, 2] = cells[4:6, :1, :3] = True
    weight = np.zeros((8, 5, 5))
    weight[0] = 1.0
    field = replace(snapshot_of(np.ones(weight.shape), 20.0, weight), voxel_density=cells.astype(np.float32))
    every = SolidSelection(close_gaps=0, density_threshold=0.5, region="all")
    built = build_mesh(field, every, np.eye(4), VOXEL)
    mesh, solid = built.mesh, built.solid
    assert (built.unobserved_parts, built.unobserved_voxels) == (1, 6)
    expected = cells.copy()
    expected[4:] = False
    assert np.array_equal(solid.cells, expected) and len(mesh.tets) == 6 * 9
    assert check_mesh(mesh).volume_m3 == pytest.approx(9 * 0.5**3)
    seen = replace(field, observed_weight=np.ones((8, 5, 5), np.float32))
    built = build_mesh(seen, every, np.eye(4), VOXEL)
    assert (built.unobserved_parts, built.unobserved_voxels, len(built.mesh.tets)) == (0, 0, 6 * 15)


def test_part_of_a_conforming_mesh_no_thermal_ray_saw_is_counted(snapshot_of):
    """Two cubes that touch by a corner: one part as voxels, two as a smooth surface. Rays saw only the first."""
    cells = np.zeros((10, 10, 10), bool)
    cells[1:4, 1:4, 1:4] = cells[4:7, 4:7, 4:7] = True
    weight = np.zeros((11, 11, 11))
    weight[:3, :3, :3] = 1.0
    field = replace(snapshot_of(np.ones(weight.shape), 20.0, weight), voxel_density=cells.astype(np.float32))
    every = SolidSelection(close_gaps=0, density_threshold=0.5, interior="hollow")
    built = build_mesh(field, every, np.eye(4))
    assert (built.unobserved_parts, built.unobserved_voxels) == (1, 27)
    assert built.solid.cells.sum() == 27 and built.solid.cells[1:4, 1:4, 1:4].all()
    assert built.mesh.points_m.max() < 4.3 * 0.5
    assert check_mesh(built.mesh).volume_m3 == pytest.approx(27 * 0.5**3, rel=0.2)


def ball(snapshot_of, seen_side: bool = False):
    """A ball of radius 5.3 voxels of 0.5 in a lattice of 14, its density exponential in the distance to its surface."""
    corner = np.stack(np.meshgrid(*[np.arange(15.0)] * 3, indexing="ij"), axis=-1)
    inside = 5.3 - np.linalg.norm(corner - 7.0, axis=-1)
    weight = (np.abs(inside) < 1.5) * (corner[..., 0] > 7.0 if seen_side else 1.0)
    centre = np.stack(np.meshgrid(*[np.arange(14) + 0.5] * 3, indexing="ij"), axis=-1)
    depth = 5.3 - np.linalg.norm(centre - 7.0, axis=-1)
    field = snapshot_of(np.exp(3.0 * inside), 20.0 + corner[..., 0], weight)
    return replace(field, voxel_density=np.exp(3.0 * depth).astype(np.float32))


@pytest.mark.parametrize("mode", MODES)
def test_temperatures_come_from_what_was_seen_and_stay_in_its_range(snapshot_of, mode):
    mesh = build_mesh(ball(snapshot_of, seen_side=True), DENSE, np.eye(4), mode).mesh
    x = mesh.points_m[:, 0] / 0.5
    assert mesh.observed[x > 11].any() and not mesh.observed[x < 6].any()
    assert mesh.temperature_c[mesh.observed] == pytest.approx(20.0 + x[mesh.observed], abs=0.51)
    assert np.ptp(mesh.temperature_c[x < 4]) < 0.5  # far from what was seen it is level


@pytest.mark.parametrize("mode", MODES)
def test_the_area_is_that_of_the_surface_or_of_its_staircase(snapshot_of, mode):
    mesh = build_mesh(ball(snapshot_of), DENSE, linear_map(2.0 * random_turn(6)), mode).mesh
    boundary = mesh.boundary
    assert boundary.seen.all()  # without cameras nothing is known to be hidden
    radius = 5.3 + np.log(2.0) / 3.0  # where density is one half, [voxels]; a voxel is 0.5 * 2 wide
    more, bound = {"conforming": (1.0, 0.03), "voxel": (1.5, 0.1)}[mode]
    assert facet_areas(mesh.points_m, mesh.facets).sum() == pytest.approx(more * 4 * np.pi * radius**2, rel=bound)


def test_colour_is_that_of_corners_with_density(snapshot_of):
    field = ball(snapshot_of)
    density = np.where(field.density > 0.05, field.density, 0.0).astype(np.float32)
    colour = np.where(density[..., None] > 0.0, [0.75, 0.5, 0.25], 0.0).astype(np.float32)
    mesh = build_mesh(replace(field, density=density, colour=colour), DENSE, np.eye(4)).mesh
    assert np.all(mesh.colour == np.array([0.75, 0.5, 0.25], np.float32))


@pytest.mark.parametrize("seed", range(4))
def test_maximum_principle_on_random_bodies(seed):
    random = np.random.default_rng(seed)
    cells = random.random(tuple(random.integers(1, 7, size=3))) < random.uniform(0.15, 0.95)
    cells[tuple(random.integers(0, cells.shape))] = True
    corners, tets = kuhn_tets(cells)
    (edges, weights), num_nodes = temperature.tet_conductances(corners, tets), len(corners)
    measured = random.normal(20.0, 30.0, num_nodes)
    observed = random.random(num_nodes) < 0.5
    parts = component_of(num_nodes, *edges.T)
    for part in range(parts.max() + 1):  # every body needs a measurement
        observed[np.flatnonzero(parts == part)[0]] = True
    filled = extend_harmonically(edges, np.where(observed, measured, 1e6), observed, weights)
    assert np.array_equal(filled[observed], measured[observed])
    for part in range(parts.max() + 1):
        inside = parts == part
        assert filled[inside].min() >= measured[inside & observed].min()
        assert filled[inside].max() <= measured[inside & observed].max()


def test_a_solver_that_fails_is_reported(monkeypatch):
    monkeypatch.setattr(temperature, "_MOST_ROUNDS", 1)
    chain = np.stack([np.arange(6), np.arange(1, 7)], axis=1)
    with pytest.raises(MeshError, match="harmonic extension of the temperature"):
        extend_harmonically(chain, np.linspace(10.0, 40.0, 7), np.arange(7) % 6 == 0, np.arange(1.0, 7.0))


def test_the_number_of_threads_changes_no_bit():
    edges, weights = temperature.tet_conductances(*kuhn_tets(np.ones((24, 24, 24), dtype=bool)))
    random = np.random.default_rng(0)
    measured, observed = random.normal(20.0, 5.0, 25**3), random.random(25**3) < 0.02
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            found.append(extend_harmonically(edges, measured, observed, weights))
    np.testing.assert_array_equal(found[0], found[1])


def test_linear_temperatures_are_extended_through_tetrahedra_of_any_size():
    """A graded mesh: a uniform edge weight would be off by percents where the size of the tetrahedra changes."""
    level = 9.3 - np.linalg.norm(np.indices((20, 20, 20)).transpose(1, 2, 3, 0) - 9.5, axis=-1)
    solid = stuff(np.clip(level / 1.5, -1.0, 1.0), 4)
    linear = 20.0 + solid.points @ [1.0, -2.0, 0.5]
    edges, conductance = temperature.tet_conductances(solid.points, solid.tets)
    known = on_surface(solid)
    filled = extend_harmonically(edges, np.where(known, linear, 0.0), known, conductance)
    lengths = np.linalg.norm(solid.points[solid.tets[:, 0]] - solid.points[solid.tets[:, 1]], axis=1)
    assert lengths.max() > 1.9  # there are coarse tetrahedra
    worst = np.abs(filled - linear).max() / np.ptp(linear)
    uniform = extend_harmonically(edges, np.where(known, linear, 0.0), known, np.ones(len(edges)))
    assert worst < 0.01 < 0.03 < np.abs(uniform - linear).max() / np.ptp(linear)


def test_an_edge_with_negative_conductance_does_not_break_the_maximum_principle():
    edges = np.array([[0, 1], [1, 2], [0, 2], [1, 3]])
    known, conductance = np.array([True, False, True, False]), np.array([1.0, 1.0, 1.0, -5.0])
    filled = extend_harmonically(edges, np.array([10.0, 0.0, 30.0, 0.0]), known, conductance)
    assert filled.tolist() == pytest.approx([10.0, 20.0, 30.0, 20.0])


SHAPE = (4, 5, 3)


def test_trilinear_functions_are_exact_where_all_is_known():
    x, y, z = np.indices(SHAPE).astype(float)
    points = np.random.default_rng(0).random((200, 3)) * (np.array(SHAPE) - 1)
    values, weight = interpolate_corners(points, 2 + x - 3 * y + x * y * z, np.ones(SHAPE))
    px, py, pz = points.T
    assert values == pytest.approx(2 + px - 3 * py + px * py * pz, abs=1e-12)
    assert weight == pytest.approx(np.ones(len(points)))


def test_corners_that_know_nothing_have_no_influence():
    values = np.full(SHAPE, 1e6)
    weights = np.zeros(SHAPE)
    values[1, 1, 1], weights[1, 1, 1] = 20.0, 3.0
    values[1, 1, 2], weights[1, 1, 2] = 24.0, 1.0
    found, weight = interpolate_corners(np.array([[1.0, 1.0, 1.5], [0.5, 1.0, 1.0], [3.0, 4.0, 0.0]]), values, weights)
    assert found.tolist() == [21.0, 20.0, 0.0]
    assert weight.tolist() == [2.0, 1.5, 0.0]


def test_a_hollow_body_that_no_camera_sees_from_below_gets_a_floor(snapshot_of):
    """A cup upside down, photographed from above all around: floor and ceiling alike, and the underside is outside."""
    density = np.zeros((25, 25, 25))
    density[5:20, 5:20, 5:20] = 20.0
    density[8:17, 8:17, :17] = 0.0
    angle = 2.0 * np.pi * np.arange(12) / 12
    eyes = np.column_stack((12 + 60 * np.cos(angle), 12 + 60 * np.sin(angle), np.full(12, 30.0)))
    field = replace(snapshot_of(density), views=looking_at((12.0, 12.0, 12.0), eyes))
    selection = replace(DENSE, interior="hollow", wall_thickness=2.0)
    mesh = build_mesh(field, selection, np.eye(4), VOXEL).mesh
    area = dict.fromkeys(DEFAULT_PATCHES, 0.0)
    for patch, of in zip(mesh.boundary.patch, facet_areas(mesh.points_m, mesh.facets)):
        area[mesh.boundary.patch_names[patch]] += of
    assert area["interior-up"] == pytest.approx(area["interior-down"], rel=0.1) and area["interior-up"] > 10.0
    assert area["exterior-down"] == pytest.approx(area["exterior-up"], rel=0.1)


AS_IT_IS = SolidSelection(density_threshold=0.5, close_gaps=0, region="all", interior="hollow")


def trained(cells: np.ndarray) -> GridSnapshot:
    """A field as training leaves one: opaque voxels, temperature 20 to 21, some corners unseen, cameras around."""
    cells = np.asarray(cells, dtype=bool)
    lattice = Lattice((-1.0, -1.0, -1.0), 2.0 / max(cells.shape), tuple(n + 1 for n in cells.shape))  # type: ignore[arg-type]
    touched = binary_dilation(np.pad(cells, (0, 1)), np.ones((2, 2, 2)), origin=-1)
    random = np.random.default_rng(0)
    weight = np.where(touched & (random.random(lattice.shape) < 0.8), 3.0, 0.1).astype(np.float32)
    weight[tuple(np.argwhere(touched)[:1].T)] = 3.0
    temperature = (20.0 + random.random(lattice.shape)).astype(np.float32)
    temperature[weight < 0.5] = 500.0  # what nobody measured may be anything
    density = np.where(cells, 40.0, 0.0).astype(np.float32)
    return GridSnapshot(
        lattice,
        np.where(touched, 40.0, 0.0).astype(np.float32),
        temperature,
        weight,
        density,
        colour=random.random((*lattice.shape, 3)).astype(np.float32),
        views=looking_at(
            (0.0, 0.0, 0.0), [[4.0, 0.5, 1.0], [-4.0, 0.3, 0.7], [0.2, 4.0, 0.4], [0.1, -4.0, 0.6], [0.3, 0.2, 4.0]]
        ),
    )


def thin_wall(degrees: float) -> np.ndarray:
    """Voxels whose centre is within half a voxel of a plane through the middle, turned about z."""
    x, y, _ = np.indices((16, 16, 10)) + 0.5
    angle = np.radians(degrees)
    across = (x - 8.0) * np.cos(angle) + (y - 8.0) * np.sin(angle)
    return np.abs(across - 0.25) <= 0.5 * max(1.0, np.abs(np.cos(angle)) + np.abs(np.sin(angle)))


def boxes(*corners: tuple[int, int, int], size: int = 3) -> np.ndarray:
    cells = np.zeros((10, 10, 10), dtype=bool)
    for i, j, k in corners:
        cells[i : i + size, j : j + size, k : k + size] = True
    return cells


HARD: dict[str, Callable[[], np.ndarray]] = {
    "wall one voxel thick": lambda: thin_wall(0.0),
    "wall at 30 degrees": lambda: thin_wall(30.0),
    "two touch at an edge": lambda: boxes((2, 2, 2), (5, 5, 2)),
    "two touch at a corner": lambda: boxes((2, 2, 2), (5, 5, 5)),
    "touches the border": lambda: boxes((0, 3, 7)),
    "single voxel": lambda: boxes((4, 4, 4), size=1),
    "checkerboard": lambda: np.indices((7, 6, 8)).sum(axis=0) % 2 == 0,
    "noise": lambda: np.random.default_rng(3).random((9, 10, 8)) < 0.4,
    "full": lambda: np.ones((6, 5, 7), dtype=bool),
    "hollow": lambda: boxes((3, 3, 3)) & ~boxes((4, 4, 4), size=1),
    "a lattice of one voxel": lambda: np.ones((1, 1, 1), dtype=bool),
}


def assert_sound(built: BuiltMesh, mode: str) -> None:
    mesh, boundary = built.mesh, built.mesh.boundary
    quality = check_mesh(mesh)  # volumes above 0, conforming, closed
    low, high = (10.7, 164.8) if mode == "conforming" else (45.0 - 1e-6, 90.0 + 1e-6)
    assert low <= quality.dihedral_range_deg[0] and quality.dihedral_range_deg[1] <= high
    assert mesh.observed.any()
    assert mesh.temperature_c.min() >= 20.0 - 1e-6 and mesh.temperature_c.max() <= 21.0 + 1e-6
    assert facet_areas(mesh.points_m, mesh.facets).min() > 0.0
    assert boundary.patch.min() >= 0 and boundary.patch.max() < len(boundary.patch_names)
    assert mesh.colour.min() >= 0.0 and mesh.colour.max() <= 1.0


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", HARD)
def test_hard_bodies_become_sound_meshes(name: str, mode) -> None:
    cells = HARD[name]()
    assert_sound(build_mesh(trained(cells), SolidSelection(), np.eye(4), mode), mode)
    built = build_mesh(trained(cells), AS_IT_IS, np.diag([2.0, 2.0, 2.0, 1.0]), mode)
    assert_sound(built, mode)
    assert np.array_equal(built.solid.cells, cells) or built.unobserved_parts > 0
    if mode == "voxel":
        voxel_m, quality, mesh = 2.0 * 2.0 / max(cells.shape), check_mesh(built.mesh), built.mesh
        count, faces = built.solid.cells.sum(), exposed_faces(built.solid.cells)
        assert signed_volumes(mesh.points_m, mesh.tets) == pytest.approx(np.full(6 * count, voxel_m**3 / 6), rel=1e-14)
        assert quality.volume_m3 == pytest.approx(count * voxel_m**3, rel=1e-14)
        assert len(mesh.facets) == 2 * faces and quality.area_m2 == pytest.approx(faces * voxel_m**2, rel=1e-14)
        assert quality.dihedral_range_deg == pytest.approx((45.0, 90.0))


def test_a_small_body_in_256_cubed_voxels() -> None:
    cells = np.zeros((256, 256, 256), dtype=bool)
    cells[100:130, 100:130, 180:184] = True
    built = build_mesh(trained(cells), AS_IT_IS, np.eye(4))
    assert_sound(built, "conforming")
    assert built.solid.cells.sum() == 30 * 30 * 4


def exposed_faces(cells: np.ndarray) -> int:
    """Number of voxel faces between solid and empty."""
    padded = np.pad(cells, 1)
    return sum(int(np.count_nonzero(np.diff(padded, axis=axis))) for axis in range(3))


def test_box_facets_are_those_on_the_lattice_border(mesh_of_cells):
    cells = np.zeros((3, 3, 3), dtype=bool)
    cells[1:, 1, 1] = True  # touches the box at x = 3 with one voxel face
    mesh = mesh_of_cells(cells, voxel_size=1.0)
    box = mesh.facet_tags == FACET_BOX
    assert np.all(mesh.points_m[mesh.facets[box]][:, :, 0] == 3.0)
    assert facet_areas(mesh.points_m, mesh.facets[box]).sum() == pytest.approx(1.0)
    assert np.count_nonzero(mesh.facet_tags == FACET_SURFACE) == len(mesh.facets) - 2
