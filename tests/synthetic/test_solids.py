"""Exact solids: what each says of itself agrees with random points and rays, and with sizes known by hand."""

import math

import numpy as np
import pytest
from scipy.spatial import KDTree

from thermoxels_ns.synthetic.drawn_scenes import SCENE_NAMES, make_scene
from thermoxels_ns.synthetic.solids import BoxSolid, Cylinder, SolidUnion, Sphere

CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
NOTCHED = BoxSolid(
    [((0, 0, 0), (2, 1, 1)), ((1.5, 0.25, 1), (1.75, 0.75, 1.5)), ((-0.5, 0.2, 0.3), (0.4, 0.6, 0.7))],
    removed=[((0.8, -1, 0.5), (1.2, 0.4, 2)), ((0.2, 0.8, 0.1), (0.5, 1.0, 0.6))],
)
SOLIDS = {
    "box": BoxSolid([CUBE]),
    "notched": NOTCHED,
    "sphere": Sphere((0.3, -0.2, 0.5), 0.7),
    **{f"cylinder-{axis}": Cylinder((0.3, -0.2, 0.5), 0.4, 1.5, axis) for axis in range(3)},
    "union": SolidUnion((NOTCHED, Sphere((0.5, 0.5, 1.25), 0.25))),
    **{name: make_scene(name).solid for name in (*SCENE_NAMES, *(f"random-{family}" for family in range(5)))},
}


@pytest.fixture(params=SOLIDS, ids=str)
def solid(request: pytest.FixtureRequest):
    return SOLIDS[request.param]


def size_of(solid) -> float:
    return float(np.subtract(*solid.bounds[::-1]).max())


def points_around(solid, count: int, seed: int = 1) -> np.ndarray:
    lo, hi = np.array(solid.bounds)
    return np.random.default_rng(seed).uniform(lo - 0.2 * (hi - lo), hi + 0.2 * (hi - lo), (count, 3))


def random_rays(solid, count: int) -> tuple[np.ndarray, np.ndarray]:
    (lo, hi), draw = np.array(solid.bounds), np.random.default_rng(7)
    away = draw.standard_normal((count, 3))
    origins = 0.5 * (lo + hi) + 1.5 * np.linalg.norm(hi - lo) * away / np.linalg.norm(away, axis=1, keepdims=True)
    way = points_around(solid, count, 8) - origins
    return origins, way / np.linalg.norm(way, axis=1, keepdims=True)


def test_volume_agrees_with_a_count_of_random_points(solid) -> None:
    box = 1.4**3 * np.prod(np.subtract(*solid.bounds[::-1]))
    share = solid.volume / box
    sigma = box * math.sqrt(share * (1 - share) / 100_000)
    assert solid.contains(points_around(solid, 100_000)).mean() * box == pytest.approx(solid.volume, abs=4 * sigma)


def test_area_agrees_with_the_volume_of_a_thin_shell(solid) -> None:
    # The set within e of the surface has the volume 2 e A up to the second order in e.
    (lo, hi), e = np.array(solid.bounds), 2e-3 * size_of(solid)
    points = np.random.default_rng(2).uniform(lo - e, hi + e, (100_000, 3))
    share, box = (np.abs(solid.signed_distance(points)) <= e).mean(), float(np.prod(hi - lo + 2 * e))
    sigma = box * math.sqrt(share / len(points)) / (2 * e)
    assert share * box / (2 * e) == pytest.approx(solid.area, abs=4 * sigma + 0.01 * solid.area)


def test_surface_points_lie_on_the_surface_normals_point_outside_and_the_seed_repeats_them(solid) -> None:
    points, normals = solid.surface_points(4000, seed=3)
    assert np.abs(solid.signed_distance(points)).max() < 1e-12 * size_of(solid)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    step = 1e-6 * size_of(solid) * normals
    assert not solid.contains(points + step).any() and solid.contains(points - step).all()
    np.testing.assert_array_equal(points, solid.surface_points(4000, seed=3)[0])


def test_surface_points_are_uniform_by_area() -> None:
    points, normals = BoxSolid([((0, 0, 0), (4, 2, 0.5))]).surface_points(20_000, seed=4)
    assert (normals[:, 2] > 0).mean() == pytest.approx(8.0 / 22.0, abs=0.015)
    assert points[normals[:, 2] > 0, 0].mean() == pytest.approx(2.0, abs=0.05)
    rod = Cylinder((0.0, 0.0, 0.0), radius=0.5, length=1.5, axis=0)
    points, normals = rod.surface_points(40_000, seed=4)
    on_end = np.abs(normals[:, 0]) > 0.5
    assert on_end.mean() == pytest.approx(2 * math.pi * 0.25 / rod.area, abs=0.01)
    from_axis = np.hypot(points[on_end, 1], points[on_end, 2])
    assert np.square(from_axis / 0.5).mean() == pytest.approx(0.5, abs=0.015)
    assert points[~on_end, 0].std() == pytest.approx(1.5 / math.sqrt(12.0), abs=0.01)


def test_distance_is_that_to_the_nearest_surface_point(solid) -> None:
    points, size = points_around(solid, 150), size_of(solid)
    surface, _ = solid.surface_points(60_000, seed=6)
    nearest, distance = KDTree(surface).query(points)[0], solid.signed_distance(points)
    np.testing.assert_array_equal(distance < 0, solid.contains(points))
    # Samples can only be farther than the surface itself, by their spacing at most.
    assert (np.abs(distance) <= nearest + 1e-12 * size).all() and (nearest - np.abs(distance)).max() < 0.03 * size


ROD = Cylinder((0.0, 0.0, 0.0), radius=0.5, length=4.0, axis=1)


@pytest.mark.parametrize(
    ("boxes", "removed", "volume", "area"),
    [
        ([CUBE, ((1, 0, 0), (3, 1, 1))], (), 3.0, 14.0),  # touching boxes share no surface
        ([((0, 0, 0), (0.1 + 0.2, 1, 1)), ((0.3, 0, 0), (1, 1, 1))], (), 1.0, 6.0),  # nor do those up to rounding
        ([CUBE, ((0.25, 0.25, 1), (0.75, 0.75, 1.5))], (), 1.125, 7.0),
        ([CUBE, ((0.5, 0, 0), (1.5, 1, 1))], (), 1.5, 8.0),
        ([CUBE], [((0.25, 0.25, -1), (0.75, 0.75, 2))], 0.75, 7.5),
        ([CUBE], [((0.25, 0.25, 0.25), (0.75, 0.75, 0.75))], 0.875, 7.5),
    ],
)
def test_sizes_of_joined_and_cut_boxes(boxes: list, removed: list, volume: float, area: float) -> None:
    solid = BoxSolid(boxes, removed)
    assert (solid.volume, solid.area) == pytest.approx((volume, area), rel=1e-12)


def test_hits_lie_on_the_surface_and_the_way_there_is_free(solid) -> None:
    origins, directions = random_rays(solid, 1500)
    distance, normal = solid.intersect(origins, directions)
    hit = np.isfinite(distance)
    assert 0.2 < hit.mean() <= 1.0
    origin, way, reach = origins[hit], directions[hit], distance[hit, None]
    assert np.abs(solid.signed_distance(origin + reach * way)).max() < 2e-9 * size_of(solid)
    assert (np.einsum("ij,ij->i", normal[hit], way) < 0).all()
    for share in (0.3, 0.8, 0.97, 0.999999):
        assert not solid.contains(origin + share * reach * way).any()
    np.testing.assert_array_equal(normal[~hit], 0.0)
    np.testing.assert_allclose(solid.intersect(origins, 4.0 * directions)[0] * 4.0, distance)
    for t in np.linspace(0.0, 5.0 * size_of(solid), 120):  # those that miss stay outside all along
        assert not solid.contains(origins[~hit] + t * directions[~hit]).any()


@pytest.mark.parametrize("tilt", [0.0, 1e-7, -1e-17, 1e-160, -1e-300])
def test_rays_almost_along_an_axis_hit_what_lies_ahead(tilt: float) -> None:
    rod, cube, miss = Cylinder((0.0, 0.0, 0.0), radius=0.5, length=2.0, axis=2), BoxSolid([CUBE]), (np.inf, [0, 0, 0])
    for solid, origin, direction, distance, normal in (
        (rod, [0.1, 0.2, 5.0], [tilt, 0, -1], 4.0, [0, 0, 1]),
        (rod, [0.1, 0.2, -5.0], [0, tilt, 1], 4.0, [0, 0, -1]),
        (rod, [0.6, 0.0, 5.0], [0, 0, -1], *miss),
        (rod, [-2.0, 0.0, 0.5], [1, 0, tilt], 1.5, [-1, 0, 0]),
        (rod, [-2.0, 0.0, 1.5], [1, 0, 0], *miss),
        (rod, [2.0, 0.0, 0.5], [1, 0, tilt], *miss),
        (cube, [-2.0, 0.5, 0.5], [1, tilt, 0], 2.0, [-1, 0, 0]),
        (cube, [-2.0, 0.5, 0.5], [1, tilt, tilt], 2.0, [-1, 0, 0]),
        (cube, [-2.0, 0.5, 0.5], [-1, tilt, 0], *miss),
        (cube, [-2.0, 1.5, 0.5], [1, tilt, 0], *miss),
        (cube, [-1.0, 0.5, 1.0], [1, 0, 0], 1.0, [-1, 0, 0]),  # within the plane of a face
        (cube, [-1.0, 0.5, 1.0], [0, 1, 0], *miss),
    ):
        found = solid.intersect(origin, [direction])
        np.testing.assert_allclose(found[0], [distance])
        np.testing.assert_allclose(found[1], [normal], atol=1e-12)


def test_rays_through_edges_and_corners_do_not_slip_between_faces() -> None:
    cube = BoxSolid([CUBE, ((1, 0, 0), (2, 1, 0.5))])
    targets = np.array([[0, 0, 0.3], [0, 0, 0], [1, 0, 0.5], [1, 0.5, 0.5], [1.0, 1.0, 0.5], [1.0, 0.0, 0.25]])
    for origin in ([-1.0, -1.0, -1.0], [-0.3, -0.7, -0.1], [-1.0 / 3.0, -0.1, 1.0 / 7.0]):
        assert (cube.intersect(origin, targets - origin)[0] <= 1.0 + 1e-9).all()
    draw = np.random.default_rng(8)
    on_edge = np.stack([np.full(5000, 0.3), np.full(5000, 0.1), draw.uniform(0.0, 0.7, 5000)], axis=1)
    origins = np.array([0.3, 0.1, 0.35]) - draw.uniform(0.05, 3.0, (5000, 3))
    odd = BoxSolid([((0.3, 0.1, 0.0), (0.9, 0.8, 0.7))])
    assert (odd.intersect(origins, on_edge - origins)[0] <= 1.0 + 1e-9).all()


def test_a_ray_that_starts_inside_sees_no_wall_from_behind() -> None:
    pair = BoxSolid([CUBE, ((3, 0, 0), (4, 1, 1))])
    distance, _ = pair.intersect([0.5, 0.5, 0.5], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(distance, [2.5, np.inf])
    for solid in (Sphere((0, 0, 0), 1.0), ROD):
        assert np.isinf(solid.intersect([0.2, 0.1, 0.0], np.concatenate([np.eye(3), -np.eye(3)]))[0]).all()
    assert pair.intersect([0.0, 0.5, 0.5], [[1.0, 0.0, 0.0]])[0][0] == 0.0  # starts on the face
