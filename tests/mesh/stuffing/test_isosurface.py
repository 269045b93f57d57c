from itertools import combinations, product

import numpy as np
import pytest

from tests.support.stuffed_shapes import ANGLE_BOUNDS_DEG, centres, tet_mesh, volumes_and_angles
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.stuffing.isosurface import BUNDLE_EDGES, BUNDLE_POINTS, CODE_WEIGHTS, stencil_table, stuff
from thermoxels_ns.mesh.stuffing.lattice import ALPHA_INSIDE, ALPHA_OUTSIDE, DIRECTIONS


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 2, 1), (1, 4, 5), (4, 3, 5)])
def test_full_lattice_is_a_box_to_the_last_bit(shape):
    solid = stuff(np.random.default_rng(1).uniform(0.1, 1.0, shape))
    quality = check_mesh(tet_mesh(solid))
    a, b, c = shape
    assert quality.volume_m3 == pytest.approx(a * b * c, rel=1e-14)
    assert quality.area_m2 == pytest.approx(2 * (a * b + b * c + a * c), rel=1e-14)
    assert solid.on_box.all()
    assert np.array_equal(solid.points.min(axis=0), [0, 0, 0]) and np.array_equal(solid.points.max(axis=0), shape)
    assert (quality.dihedral_range_deg[0], quality.dihedral_range_deg[1]) == pytest.approx((45.0, 90.0))


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


def test_tags_of_nodes_and_triangles():
    ball = 6.0 - np.linalg.norm(centres(10, 10, 10) - [1.0, 0.0, 0.0], axis=-1)
    solid = stuff(ball.clip(-1, 1))
    quality = check_mesh(tet_mesh(solid))
    assert 0 < quality.num_box_facets < quality.num_facets
    assert np.array_equal(np.flatnonzero(solid.on_surface), np.unique(solid.facets))
    corners = solid.points[solid.facets]
    flat = [(corners[:, :, axis] == side).all(axis=1) for axis in range(3) for side in (0.0, 10.0)]
    assert np.array_equal(solid.on_box, np.any(flat, axis=0))
    assert np.all((solid.points >= 0.0) & (solid.points <= 10.0))


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
    quality = check_mesh(tet_mesh(solid))
    assert ANGLE_BOUNDS_DEG[0] <= quality.dihedral_range_deg[0]
    assert quality.dihedral_range_deg[1] <= ANGLE_BOUNDS_DEG[1]
    assert np.all((solid.points >= 0.0) & (solid.points <= level.shape))


def _tet_volumes(corners: np.ndarray) -> np.ndarray:
    return np.linalg.det(corners[:, 1:] - corners[:, :1])


@pytest.mark.parametrize("signs", [s for s in product((-1, 0, 1), repeat=4) if max(s) > 0], ids=str)
def test_angles_of_every_stencil_at_the_ends_of_all_ranges(signs):
    """Cuts and moved points independent of each other, at the ends of what `warp` allows: the bound for any levels."""
    random = np.random.default_rng(7)
    trials, points = 4000, (0, 1, 2, 3)
    positions = np.zeros((trials, 19, 3))
    positions[:, :6] = BUNDLE_POINTS
    towards = {}
    for v in points:
        if signs[v] == 0:
            step = random.integers(0, 15, trials)
            target = BUNDLE_POINTS[v] + DIRECTIONS[step % 14]
            # A point moves towards the other sign: within the tetrahedron that limits how far.
            same = np.abs(target[:, None] - BUNDLE_POINTS[:4]).max(axis=-1) < 0.1
            inside = same @ np.array(signs)
            either = np.maximum(ALPHA_OUTSIDE, ALPHA_INSIDE)
            most = np.choose(inside + 1, [alpha[step % 14] for alpha in (ALPHA_INSIDE, either, ALPHA_OUTSIDE)])
            most *= step < 14
            positions[:, v] += most[:, None] * DIRECTIONS[step % 14]
            towards[v] = np.where((step < 14)[:, None], target, np.nan)
    for edge, (a, b) in enumerate(BUNDLE_EDGES):
        if a in points and b in points and signs[a] * signs[b] < 0:
            a, b = (a, b) if signs[a] > 0 else (b, a)
            way = np.argmin(np.abs(DIRECTIONS - (BUNDLE_POINTS[b] - BUNDLE_POINTS[a])).max(axis=1))
            share = random.choice([ALPHA_INSIDE[way], 0.5, 1.0 - ALPHA_OUTSIDE[way]], trials)
            positions[:, 6 + edge] = BUNDLE_POINTS[a] + share[:, None] * DIRECTIONS[way]
    # Two points never move towards each other: one edge has one cut.
    for v, w in combinations(towards, 2):
        facing = np.all(towards[v] == BUNDLE_POINTS[w], axis=1) & np.all(towards[w] == BUNDLE_POINTS[v], axis=1)
        positions = positions[~facing]
        towards = {u: t[~facing] for u, t in towards.items()}

    tets, start = stencil_table()
    # The face's other two corners are outside: only this tetrahedron of the bundle is asked about.
    code = int(CODE_WEIGHTS @ (np.array([*signs, -1, -1]) + 1))
    tets = tets[start[code] : start[code + 1]]
    outside = set(range(19)) - {0, 1, 2, 3, 6, 7, 8, 11, 12, 15}
    tets = np.array([tet for tet in tets if not outside & set(tet)])
    assert len(tets) >= 1
    for tet in tets:
        corners = positions[:, tet]
        assert _tet_volumes(corners).min() > 0.0
        _, low, high = volumes_and_angles(corners.reshape(-1, 3), np.arange(4 * len(corners)).reshape(-1, 4))
        assert low > 10.94 and high < 163.75


@pytest.mark.parametrize("level", [np.full((3, 3, 3), -1.0), np.zeros((2, 2, 2)), np.ones((0, 4, 4))])
def test_nothing_solid(level):
    with pytest.raises(MeshError, match="level: expected solid voxels, with levels above 0, got none"):
        stuff(level)
