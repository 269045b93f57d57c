import numpy as np
import pytest

from tests.support.stuffed_shapes import (
    ANGLE_BOUNDS_DEG,
    box_distance,
    centres,
    euler_characteristic,
    num_bodies,
    tet_mesh,
    turn,
)
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import facet_areas
from thermoxels_ns.mesh.quality.report import QualityReport, check_mesh
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid, stuff


def sound(solid: StuffedSolid) -> QualityReport:
    """Measures of a mesh that is conforming, closed and within the promised angles."""
    quality = check_mesh(tet_mesh(solid))
    assert ANGLE_BOUNDS_DEG[0] <= quality.dihedral_range_deg[0] <= quality.dihedral_range_deg[1] <= ANGLE_BOUNDS_DEG[1]
    return quality


def binary(*shape: int, solid: tuple[slice, ...] | list[tuple]) -> np.ndarray:
    level = np.full(shape, -1.0)
    for part in solid if isinstance(solid, list) else [solid]:
        level[part] = 1.0
    return level


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
    solid = stuff(binary(8, 8, second.stop + 1, solid=[(*np.s_[1:4, 1:4], first), (*np.s_[4:7, 4:7], second)]))
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


@pytest.mark.parametrize("cell", [(0, 0, 0), (0, 2, 4), (1, 1, 1), (2, 2, 2), (4, 4, 4)])
@pytest.mark.parametrize(("level", "least"), [(1.0, 0.2), (1e-9, 0.05)])
def test_single_voxel(cell, level, least):
    solid = stuff(np.where(binary(5, 5, 5, solid=cell) > 0.0, level, -1.0))
    quality = sound(solid)
    assert num_bodies(solid) == 1 and euler_characteristic(solid) == 2
    assert np.all(np.abs(solid.points - np.add(cell, 0.5)) <= 0.5)
    assert least < quality.volume_m3 <= 1.0


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 7), (6, 1, 1), (4, 3, 5)])
def test_a_full_lattice_is_a_box_to_the_last_bit_also_one_voxel_wide(shape):
    full = stuff(np.random.default_rng(1).uniform(0.1, 1.0, shape))
    quality, (a, b, c) = sound(full), shape
    assert quality.volume_m3 == pytest.approx(a * b * c, rel=1e-14)
    assert quality.area_m2 == pytest.approx(2 * (a * b + b * c + a * c), rel=1e-14)
    assert quality.dihedral_range_deg == pytest.approx((45.0, 90.0)) and full.on_box.all()
    assert np.array_equal(full.points.min(axis=0), [0, 0, 0]) and np.array_equal(full.points.max(axis=0), shape)
    random = np.random.default_rng(6).normal(size=shape)
    random.flat[0] = 1.0
    assert 0.0 < sound(stuff(random)).volume_m3 <= np.prod(shape)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.98])
def test_random_cells(share):
    cells = np.random.default_rng(9).random((12, 13, 14)) < share
    solid = stuff(np.where(cells, 1.0, -1.0), coarsest=1)
    quality = sound(solid)
    # Every solid voxel is there: its centre is a node inside the mesh.
    inside = {tuple(point) for point in solid.points[~solid.on_surface]}
    assert all(tuple(centre) in inside for centre in np.argwhere(cells) + 0.5)
    assert quality.num_tets > 20 * np.count_nonzero(cells) * (1.0 - share)


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
    solid = stuff(level)
    sound(solid)
    assert np.all((solid.points >= 0.0) & (solid.points <= level.shape))


@pytest.mark.parametrize("level", [np.full((3, 3, 3), -1.0), np.zeros((2, 2, 2)), np.ones((0, 4, 4))])
def test_nothing_solid(level):
    with pytest.raises(MeshError, match=r"^level: expected"):
        stuff(level)
