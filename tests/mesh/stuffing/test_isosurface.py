import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree

from tests.support.stuffed_shapes import (
    ANGLE_BOUNDS_DEG,
    SHAPES,
    SHIFT,
    Shape,
    box_distance,
    centres,
    euler_characteristic,
    num_bodies,
    on_surface,
    random_turn,
    tet_mesh,
    turn,
    turned_box,
)
from thermoxels_ns.mesh.quality.checks import MeshFigures, check_mesh, dihedral_range_deg
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid, stuff
from thermoxels_ns.mesh.stuffing.lattice import bcc_lattice, coarse_interior
from thermoxels_ns.mesh.stuffing.sharp_edges import ANGLES_DEG, Surface, sharpen
from thermoxels_ns.mesh.tetrahedra import facet_areas, facet_normals


def sound(solid: StuffedSolid) -> MeshFigures:
    """Measures of a mesh that is conforming, closed and within the promised angles."""
    quality = check_mesh(tet_mesh(solid))
    assert ANGLE_BOUNDS_DEG[0] <= quality.dihedral_range_deg[0] <= quality.dihedral_range_deg[1] <= ANGLE_BOUNDS_DEG[1]
    return quality


WALL = np.array([0.5, 8.0, 7.0])
"""Half the sides of a wall one voxel thick."""


@pytest.mark.parametrize("offset", [0.1, 0.25, 0.4, 0.5])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0])
def test_wall_one_voxel_thick_as_signed_distance(degrees, offset):
    points = centres(24, 24, 24) - [offset, 0.03, 0.07]
    solid = stuff(np.clip(-box_distance(points @ turn(degrees), WALL), -1.0, 1.0))
    quality = sound(solid)
    # At 45 degrees and a quarter of a voxel, two rims of the wall hang on voxels that share an edge only.
    assert num_bodies(solid) <= 2
    assert euler_characteristic(solid) == 2 * num_bodies(solid), "a hole through the wall"
    assert quality.volume_m3 == pytest.approx(8 * WALL.prod(), rel=0.25)
    assert quality.area_m2 == pytest.approx(8 * (WALL[0] * WALL[1] + WALL[1] * WALL[2] + WALL[0] * WALL[2]), rel=0.1)


@pytest.mark.parametrize("tiny", [0.5, 0.1, 1e-3, 1e-9])
def test_wall_of_one_layer_never_gets_holes(tiny):
    """However shallow the level says the solid is."""
    level = np.full((7, 12, 11), -1.0)
    level[3, 1:-1, 1:-1] = tiny * np.random.default_rng(4).uniform(0.5, 1.0, (10, 9))
    solid = stuff(level)
    quality = sound(solid)
    assert num_bodies(solid) == 1 and euler_characteristic(solid) == 2
    assert quality.volume_m3 > 0.3 * 90


@pytest.mark.parametrize("tiny", [0.5, 0.1, 1e-9])
def test_gap_of_one_voxel_keeps_bodies_apart(tiny):
    level = np.ones((9, 8, 7))
    level[4] = -tiny * np.random.default_rng(5).uniform(0.5, 1.0, (8, 7))
    solid = stuff(level)
    sound(solid)
    # The two bodies meet in points of the gap's border at most.
    inner = solid.points[solid.facets[~solid.on_box]]
    middle = np.abs(inner[..., 0] - 4.5)
    assert middle.min() > 0.1
    assert euler_characteristic(solid) == 4 and num_bodies(solid) == 2


@pytest.mark.parametrize(
    ("first", "second", "bodies", "volume"), [(slice(1, 5), slice(1, 5), 1, 72), (slice(1, 4), slice(4, 7), 2, 54)]
)
def test_bodies_that_touch_along_an_edge_or_at_a_corner(first, second, bodies, volume):
    level = np.full((8, 8, second.stop + 1), -1.0)
    level[1:4, 1:4, first] = level[4:7, 4:7, second] = 1.0
    solid = stuff(level)
    assert num_bodies(solid) == bodies and (bodies == 1 or euler_characteristic(solid) == 4)
    assert 0.75 * volume < sound(solid).volume_m3 < volume


@pytest.mark.parametrize(("centre", "share"), [((0, 8, 8), 2), ((0, 0, 8), 4), ((0, 0, 0), 8), ((16, 16, 0), 8)])
def test_ball_cut_by_the_border(centre, share):
    distance = np.linalg.norm(centres(16, 16, 16) + 8.0 - centre, axis=-1)
    solid = stuff(np.clip((6.0 - distance) / 1.5, -1.0, 1.0))
    quality = sound(solid)
    assert num_bodies(solid) == 1 and euler_characteristic(solid) == 2
    assert quality.volume_m3 == pytest.approx(4 / 3 * np.pi * 6.0**3 / share, rel=0.04)
    # Where the surface meets the border the edge is a chamfer about half a voxel wide.
    on_box = facet_areas(solid.points, solid.facets)[solid.on_box].sum()
    fans = np.log2(share) * 2 / share
    assert on_box == pytest.approx(fans * (np.pi * 6.0**2 - 0.5 * 2 * np.pi * 6.0), rel=0.1)
    assert np.all((solid.points >= 0.0) & (solid.points <= 16.0))


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 7), (6, 1, 1), (4, 3, 5)])
def test_a_full_lattice_is_a_box_to_the_last_bit_also_one_voxel_wide(shape):
    full = stuff(np.random.default_rng(1).uniform(0.1, 1.0, shape))
    quality, (a, b, c) = sound(full), shape
    assert quality.volume_m3 == pytest.approx(a * b * c, rel=1e-14)
    assert quality.area_m2 == pytest.approx(2 * (a * b + b * c + a * c), rel=1e-14)
    assert quality.dihedral_range_deg == pytest.approx((45.0, 90.0)) and full.on_box.all()
    assert sharpen(full, shape) is full
    assert np.array_equal(full.points.min(axis=0), [0, 0, 0]) and np.array_equal(full.points.max(axis=0), shape)
    random = np.random.default_rng(6).normal(size=shape)
    random.flat[0] = 1.0
    assert 0.0 < sound(stuff(random)).volume_m3 <= np.prod(shape)


@pytest.mark.parametrize("seed", range(4))
def test_linear_level_gives_its_plane_exactly(seed):
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    solid = stuff(-(centres(12, 11, 10) @ normal + random.uniform(-1, 1)))
    check_mesh(tet_mesh(solid))
    # At the border the surface turns into the box within two voxels.
    nodes = solid.points[np.unique(solid.facets[~solid.on_box])]
    far = np.all((nodes > 2.0) & (nodes < np.array([10, 9, 8])), axis=1)
    distance = (nodes - [6.0, 5.5, 5.0]) @ normal
    assert np.count_nonzero(far) > 50
    assert np.ptp(distance[far]) < 1e-12


RANDOM_LEVELS = {
    "white noise": lambda random, shape: random.normal(size=shape),
    "twelve orders of magnitude": lambda random, shape: (
        random.normal(size=shape) * 10.0 ** random.uniform(-12, 0, shape)
    ),
    "six hundred orders": lambda random, shape: random.normal(size=shape) * 10.0 ** random.uniform(-300, 307, shape),
    "binary": lambda random, shape: np.where(random.random(shape) < random.uniform(0.1, 0.9), 1.0, -1.0),
    "few values, many zeros": lambda random, shape: random.choice([-1.0, -0.5, 0.0, 0.0, 0.5, 1.0], size=shape),
    "smooth": lambda random, shape: sum(
        np.cos(centres(*shape) @ random.normal(size=3) * 0.7 + random.uniform(0, 6)) for _ in range(4)
    ),
    "single precision": lambda random, shape: (random.normal(size=shape) * 1e30 ** random.uniform(-1, 1, shape)).astype(
        np.float32
    ),
}


@pytest.mark.parametrize("kind", RANDOM_LEVELS)
@pytest.mark.parametrize("seed", range(4))
def test_any_levels_give_a_sound_mesh(kind, seed):
    random = np.random.default_rng(seed)
    level = RANDOM_LEVELS[kind](random, tuple(random.integers(9, 14, size=3)))
    solid = stuff(level, coarsest=1)
    sound(solid)
    assert np.all((solid.points >= 0.0) & (solid.points <= level.shape))
    # Every solid voxel is there: its centre is a node inside the mesh.
    inside = {tuple(point) for point in solid.points[~on_surface(solid)]}
    assert kind != "binary" or inside >= {tuple(at) for at in np.argwhere(level > 0.0) + 0.5}


def ball(cells: int, radius: float, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    distance = np.linalg.norm(centres(cells, cells, cells) - offset, axis=-1)
    return np.clip((radius - distance) / 1.5, -1.0, 1.0)


def blobs(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    level = ndimage.gaussian_filter(random.normal(size=shape), 6.0, mode="wrap")
    return np.clip(level / np.abs(level).max() * 4.0 + 0.8, -1.0, 1.0)


def pinholes(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Levels without order, some not above 0: points move and edges are cut wherever they may."""
    level = random.uniform(size=shape) ** 8 + 1e-12
    return np.where(random.random(shape) < 6e-4, -random.choice([0.0, 1e-9, 0.5, 100.0], size=shape), level)


def smallest_numbers(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Levels above 0 whose means are 0 by rounding, here and there in a solid."""
    return np.where(ndimage.gaussian_filter(random.normal(size=shape), 1.5) > 0.06, 5e-324, 0.5)


@pytest.mark.parametrize("kind", [blobs, pinholes, smallest_numbers], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("seed", range(3))
def test_the_inside_changes_and_the_surface_does_not(kind, seed):
    random = np.random.default_rng(seed)
    level = kind(random, tuple(random.integers(27, 34, size=3)))
    uniform = stuff(level, coarsest=1)
    volume = signed_volumes(uniform.points, uniform.tets).sum()
    count = len(uniform.tets)
    for coarsest in (2, 4, 8):
        graded = stuff(level, coarsest)
        quality = sound(graded)
        # The surface is the same bits in the same order, up to node numbers.
        assert np.array_equal(graded.points[graded.facets], uniform.points[uniform.facets])
        assert np.array_equal(graded.on_box, uniform.on_box)
        assert np.array_equal(graded.points[on_surface(graded)], uniform.points[on_surface(uniform)])
        assert quality.volume_m3 == pytest.approx(volume, rel=1e-13)
        assert len(graded.tets) <= count
        count = len(graded.tets)
    assert count < 0.9 * len(uniform.tets)


@pytest.mark.parametrize("coarsest", [2, 4, 8, 16])
def test_angles_of_the_coarse_part(coarsest):
    lattice = bcc_lattice(ball(64, 31.0))
    interior = coarse_interior(lattice, coarsest)
    points, tets = lattice.positions(np.arange(len(lattice.level))), interior.tets
    edges = np.linalg.norm(points[tets[:, 1:]] - points[tets[:, :1]], axis=-1)
    assert min(8, coarsest) <= edges.max() <= coarsest
    assert signed_volumes(points, tets).min() > 0.0
    assert dihedral_range_deg(points, tets) == pytest.approx((45.0, 120.0), abs=1e-9)


def test_place_in_the_lattice_does_not_matter():
    level = ball(30, 13.0, (0.3, 0.2, 0.1))
    here = stuff(level)
    moved = stuff(np.pad(level, ((5, 0), (1, 7), (0, 3)), constant_values=-1.0))
    assert len(here.tets) < 0.7 * len(stuff(level, coarsest=1).tets)
    assert np.array_equal(here.tets, moved.tets) and np.array_equal(here.facets, moved.facets)
    assert np.allclose(here.points, moved.points - np.array([5, 1, 0]), rtol=0.0, atol=1e-13)


CELLS = 48
VOXEL = 2.0 / CELLS


def sharpened(level: np.ndarray) -> tuple[StuffedSolid, StuffedSolid, np.ndarray]:
    """A mesh before and after, and its nodes that moved."""
    solid = stuff(level)
    sharp = sharpen(solid, level.shape)
    return solid, sharp, np.flatnonzero(np.any(solid.points != sharp.points, axis=1))


def relative_errors(shape: Shape, solid: StuffedSolid) -> tuple[float, float]:
    points = solid.points * VOXEL
    volume, area = signed_volumes(points, solid.tets).sum(), facet_areas(points, solid.facets).sum()
    return volume / shape.volume - 1.0, area / shape.area - 1.0


def crossings(solid: StuffedSolid) -> int:
    """How often a side of a boundary triangle passes through another one near it that has none of its nodes."""
    corners = solid.points[solid.facets]
    pairs = KDTree(corners.mean(axis=1)).query_pairs(1.4, output_type="ndarray")
    apart = ~(solid.facets[pairs[:, 0], :, None] == solid.facets[pairs[:, 1], None, :]).any(axis=(1, 2))
    side, through = np.concatenate([pairs[apart], pairs[apart, ::-1]]).T
    found = 0
    for start, end in ((0, 1), (1, 2), (2, 0)):
        triangle, p, q = corners[through], corners[side, start], corners[side, end]
        normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        height_p, height_q = (np.einsum("ij,ij->i", end - triangle[:, 0], normal) for end in (p, q))
        share = height_p / np.where(height_p == height_q, 1.0, height_p - height_q)
        at = p + share[:, None] * (q - p)
        inside = height_p * height_q < 0.0
        for n in range(3):
            inward = np.cross(triangle[:, (n + 1) % 3] - triangle[:, n], at - triangle[:, n])
            inside &= np.einsum("ij,ij->i", inward, normal) > 0.0
        found += np.count_nonzero(inside)
    return found


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_boxes_at_any_angle(seed, noise):
    shape = turned_box((0.7, 0.25, 0.5), random_turn(seed))
    level = shape.level(CELLS, 1.0)
    level = np.clip(level + noise * np.random.default_rng(seed).normal(size=level.shape), -1.0, 1.0)
    solid, sharp, _ = sharpened(level)
    (volume, area), (old_volume, old_area) = relative_errors(shape, sharp), relative_errors(shape, solid)
    # Noise adds area of its own, everywhere.
    assert abs(area) < 0.005 + 0.03 * noise and abs(volume) < 0.004
    assert area > old_area + 0.015 and abs(volume) < 0.7 * abs(old_volume)
    check_mesh(tet_mesh(sharp))
    assert signed_volumes(sharp.points, sharp.tets).min() > 4.5e-4


def test_concave_edges_as_well():
    """An L in cross section: five convex edges along it and a concave one."""
    rotation = random_turn(5)

    def distance(p: np.ndarray) -> np.ndarray:
        q = p @ rotation
        foot = box_distance(q - [0.0, -0.3, 0.0], np.array([0.7, 0.2, 0.4]))
        return np.minimum(foot, box_distance(q - [-0.45, 0.1, 0.0], np.array([0.25, 0.6, 0.4])))

    shape = Shape(distance, 0.8 * 0.96, 2 * 0.96 + 0.8 * 5.2)
    solid, sharp, _ = sharpened(shape.level(CELLS, 1.0))
    assert relative_errors(shape, solid)[1] < -0.03
    assert abs(relative_errors(shape, sharp)[1]) < 0.005
    # Along the inner edge the surface retreats.
    step = sharp.points - solid.points
    normals = Surface.of(solid).node_normals
    assert np.count_nonzero(np.einsum("ij,ij->i", step, normals) < -0.1) > 10


def test_angles_move_length_and_topology_are_as_promised():
    for seed in range(3):
        solid, sharp, nodes = sharpened(turned_box((0.5, 0.4, 0.3), random_turn(seed)).level(32, 1.0))
        assert len(nodes) > 100
        assert np.all(np.linalg.norm(sharp.points - solid.points, axis=1) <= 1.0)
        assert on_surface(solid)[nodes].all()
        assert sharp.tets is solid.tets and sharp.facets is solid.facets
        around = solid.tets[np.isin(solid.tets, nodes).any(axis=1)]
        low, high = dihedral_range_deg(sharp.points, around)
        assert ANGLES_DEG[0] - 1e-9 <= low <= high <= ANGLES_DEG[1] + 1e-9


def test_moved_nodes_lie_on_the_true_edges_and_corners():
    half = np.array([0.7, 0.25, 0.5])
    _, sharp, nodes = sharpened(SHAPES["slab at 30 degrees"].level(CELLS, 1.0))
    inside = np.abs(((sharp.points[nodes] - 0.5 * CELLS) * VOXEL - SHIFT) @ turn(30.0)) - half
    # On an edge two of three coordinates are those of a face; at a corner all are.
    second = np.sort(np.abs(inside), axis=1)[:, 1] / VOXEL
    assert np.quantile(second, 0.9) < 0.1 and second.max() < 0.45
    corners = np.abs(inside).max(axis=1) / VOXEL < 0.2
    assert 4 <= np.count_nonzero(corners) <= 8


@pytest.mark.parametrize("name", ["sphere", "torus"])
@pytest.mark.parametrize("noise", [0.0, 0.1, 0.4])
def test_smooth_and_noisy_surfaces_stay(name, noise):
    level = SHAPES[name].level(CELLS)
    level += noise * np.random.default_rng(1).normal(size=level.shape)
    solid, sharp, nodes = sharpened(level)
    assert len(nodes) <= 2e-4 * np.count_nonzero(on_surface(solid))
    assert relative_errors(SHAPES[name], sharp)[1] == pytest.approx(relative_errors(SHAPES[name], solid)[1], abs=1e-3)


def test_what_lies_on_the_border_stays_there():
    tilt = turn(3.0) @ np.roll(turn(-1.5), 2, axis=(0, 1))
    box = box_distance((centres(30, 30, 30) - [9.0, 0.0, 0.0]) @ tilt, np.array([14.3, 8.2, 7.4]))
    solid, sharp, nodes = sharpened(np.clip(-box, -1.0, 1.0))
    assert solid.on_box.any() and len(nodes) > 50
    border = np.unique(solid.facets[solid.on_box])
    assert np.array_equal(solid.points[border], sharp.points[border])
    check_mesh(tet_mesh(sharp))
    assert np.all(np.abs(facet_normals(sharp.points, sharp.facets[sharp.on_box])) == [1.0, 0.0, 0.0])


@pytest.mark.parametrize("seed", [0, 1, 39])
def test_edges_that_face_each_other_do_not_cross(seed):
    """Two bars, edge to edge, less than two voxels apart."""
    random = np.random.default_rng(seed)
    axes, half = random_turn(seed), np.array([0.25, 0.25, 0.25])
    away = random.uniform(0.3, 0.8) * VOXEL + 0.25 * np.sqrt(2.0)
    middle = np.array([away, random.uniform(-0.05, 0.05), 0.03])

    def distance(p: np.ndarray) -> np.ndarray:
        q = p @ axes
        return np.minimum(box_distance((q - middle) @ turn(45.0), half), box_distance((q + middle) @ turn(45.0), half))

    solid, sharp, nodes = sharpened(Shape(distance, 1.0, 1.0).level(CELLS, 1.0))
    assert len(nodes) > 100
    assert crossings(solid) == 0 and crossings(sharp) == 0
