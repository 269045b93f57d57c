import math

import numpy as np
import pytest

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.box_solid import BoxSolid
from thermoxels_ns.synthetic.catalogue import SCENE_NAMES, make_scene
from thermoxels_ns.synthetic.solid_union import SolidUnion
from thermoxels_ns.synthetic.solids import Cylinder, Sphere

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
    "disc": Cylinder((0.0, 0.1, 0.2), 0.5, 0.1, 2),
    "union": SolidUnion((NOTCHED, Sphere((0.5, 0.5, 1.25), 0.25))),
    **{name: make_scene(name).solid for name in (*SCENE_NAMES, *(f"random-{family}" for family in range(5)))},
}


@pytest.fixture(params=SOLIDS, ids=str)
def solid(request: pytest.FixtureRequest):
    return SOLIDS[request.param]


def points_around(solid, count: int, seed: int = 1) -> np.ndarray:
    lo, hi = np.array(solid.bounds)
    margin = 0.2 * (hi - lo)
    return np.random.default_rng(seed).uniform(lo - margin, hi + margin, (count, 3))


def test_volume_agrees_with_a_count_of_random_points(solid) -> None:
    points = points_around(solid, 100_000)
    box = 1.4**3 * np.prod(np.subtract(*solid.bounds[::-1]))
    share = solid.volume / box
    sigma = box * math.sqrt(share * (1 - share) / len(points))
    assert solid.contains(points).mean() * box == pytest.approx(solid.volume, abs=4 * sigma)


def test_area_agrees_with_the_volume_of_a_thin_shell(solid) -> None:
    # The set within e of the surface has the volume 2 e A up to the second order in e.
    lo, hi = np.array(solid.bounds)
    e = 2e-3 * float((hi - lo).max())
    points = np.random.default_rng(2).uniform(lo - e, hi + e, (200_000, 3))
    share = (np.abs(solid.signed_distance(points)) <= e).mean()
    box = float(np.prod(hi - lo + 2 * e))
    sigma = box * math.sqrt(share / len(points)) / (2 * e)
    assert share * box / (2 * e) == pytest.approx(solid.area, abs=4 * sigma + 0.01 * solid.area)


def test_surface_points_have_distance_zero_and_normals_point_outside(solid) -> None:
    points, normals = solid.surface_points(4000, seed=3)
    size = float(np.subtract(*solid.bounds[::-1]).max())
    assert np.abs(solid.signed_distance(points)).max() < 1e-12 * size
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    step = 1e-6 * size
    assert not solid.contains(points + step * normals).any()
    assert solid.contains(points - step * normals).all()


def test_surface_points_are_uniform_by_area_and_repeat_with_the_seed() -> None:
    slab = BoxSolid([((0, 0, 0), (4, 2, 0.5))])
    points, normals = slab.surface_points(20_000, seed=4)
    on_top = (normals[:, 2] > 0).mean()
    assert on_top == pytest.approx(8.0 / slab.area, abs=0.015)
    assert points[normals[:, 2] > 0, 0].mean() == pytest.approx(2.0, abs=0.05)
    np.testing.assert_array_equal(points, slab.surface_points(20_000, seed=4)[0])
    assert not np.array_equal(points, slab.surface_points(20_000, seed=5)[0])


def test_distance_gradient_has_length_one_almost_everywhere(solid) -> None:
    size = float(np.subtract(*solid.bounds[::-1]).max())
    points, step = points_around(solid, 4000), 1e-6 * size
    gradient = np.stack(
        [solid.signed_distance(points + step * e) - solid.signed_distance(points - step * e) for e in np.eye(3)], axis=1
    ) / (2 * step)
    off = np.abs(np.linalg.norm(gradient, axis=1) - 1.0) > 1e-4
    assert off.mean() < 2e-3  # points within a step of the medial axis


def test_distance_is_that_to_the_nearest_surface_point(solid) -> None:
    size = float(np.subtract(*solid.bounds[::-1]).max())
    points = points_around(solid, 150)
    surface, _ = solid.surface_points(60_000, seed=6)
    brute = np.array([np.sqrt(np.square(surface - p).sum(axis=1).min()) for p in points])
    distance = solid.signed_distance(points)
    np.testing.assert_array_equal(distance < 0, solid.contains(points))
    # Samples can only be farther than the surface itself, by their spacing at most.
    assert (np.abs(distance) <= brute + 1e-12 * size).all()
    assert (brute - np.abs(distance)).max() < 0.03 * size


def test_distance_of_known_points() -> None:
    cube = BoxSolid([CUBE])
    points = [[0.5, 0.5, 0.5], [0.5, 0.5, 0.9], [2.0, 0.5, 0.5], [4.0, 5.0, 1.0], [2.0, 3.0, 3.0], [1.0, 1.0, 1.0]]
    np.testing.assert_allclose(cube.signed_distance(points), [-0.5, -0.1, 1.0, 5.0, 3.0, 0.0], atol=1e-15)


def test_touching_boxes_share_no_surface() -> None:
    pair = BoxSolid([CUBE, ((1, 0, 0), (3, 1, 1))])
    assert pair.area == pytest.approx(14.0, rel=1e-14)
    assert pair.volume == pytest.approx(3.0, rel=1e-14)
    assert len(pair.rectangles) == 6
    assert pair.signed_distance([[1.0, 0.5, 0.5]])[0] == -0.5
    stepped = BoxSolid([CUBE, ((0.25, 0.25, 1), (0.75, 0.75, 1.5))])
    assert stepped.area == pytest.approx(6.0 + 4 * 0.5 * 0.5, rel=1e-14)


def test_boxes_that_touch_up_to_rounding_still_share_a_face() -> None:
    pair = BoxSolid([((0, 0, 0), (0.1 + 0.2, 1, 1)), ((0.3, 0, 0), (1, 1, 1))])
    assert pair.area == pytest.approx(6.0, rel=1e-12)


def test_overlapping_boxes_count_once_and_holes_add_their_walls() -> None:
    assert BoxSolid([CUBE, ((0.5, 0, 0), (1.5, 1, 1))]).volume == pytest.approx(1.5)
    tunnel = BoxSolid([CUBE], removed=[((0.25, 0.25, -1), (0.75, 0.75, 2))])
    assert tunnel.volume == pytest.approx(0.75)
    assert tunnel.area == pytest.approx(6.0 - 2 * 0.25 + 4 * 0.5)
    hollow = BoxSolid([CUBE], removed=[((0.25, 0.25, 0.25), (0.75, 0.75, 0.75))])
    assert hollow.area == pytest.approx(6.0 + 1.5)
    assert hollow.signed_distance([[0.5, 0.5, 0.5]])[0] == pytest.approx(0.25)


def test_a_box_solid_contains_its_boundary() -> None:
    corners = np.array([[0, 0, 0], [1, 1, 1], [1, 0.5, 0.5], [0.5, 0, 1]], dtype=float)
    assert BoxSolid([CUBE]).contains(corners).all()
    outwards = np.array([[-1e-9, 0, 0], [1e-9, 0, 0], [1e-9, 0, 0], [0, 0, 1e-9]])
    assert not BoxSolid([CUBE]).contains(corners + outwards).any()


def random_rays(solid, count: int, seed: int = 7) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(seed)
    lo, hi = np.array(solid.bounds)
    origins = 0.5 * (lo + hi) + 1.5 * np.linalg.norm(hi - lo) * _unit(draw.standard_normal((count, 3)))
    return origins, _unit(draw.uniform(lo - 0.2 * (hi - lo), hi + 0.2 * (hi - lo), (count, 3)) - origins)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_hits_lie_on_the_surface_and_the_way_there_is_free(solid) -> None:
    origins, directions = random_rays(solid, 1500)
    size = float(np.subtract(*solid.bounds[::-1]).max())
    hits = solid.intersect(origins, directions)
    assert 0.2 < hits.hit.mean() <= 1.0
    points = origins[hits.hit] + hits.distance[hits.hit, None] * directions[hits.hit]
    assert np.abs(solid.signed_distance(points)).max() < 2e-9 * size
    assert (np.einsum("ij,ij->i", hits.normal[hits.hit], directions[hits.hit]) < 0).all()
    for share in (0.3, 0.8, 0.97, 0.999999):
        assert not solid.contains(
            origins[hits.hit] + share * hits.distance[hits.hit, None] * directions[hits.hit]
        ).any()
    np.testing.assert_array_equal(hits.normal[~hits.hit], 0.0)


def test_missing_rays_stay_outside_all_along(solid) -> None:
    origins, directions = random_rays(solid, 800)
    missed = ~solid.intersect(origins, directions).hit
    assert missed.any()
    size = float(np.linalg.norm(np.subtract(*solid.bounds[::-1])))
    for t in np.linspace(0.0, 3.0 * size, 120):
        assert not solid.contains(origins[missed] + t * directions[missed]).any()


@pytest.mark.parametrize(("solid", "z"), [(Sphere((0, 0, 0), 0.5), 0.0), (Cylinder((0, 0, 0), 0.5, 2.0, axis=2), 0.25)])
def test_hits_on_round_solids_are_analytic_even_from_far_away(solid, z: float) -> None:
    height = np.array([0.0, 0.3, 0.4, 0.5, 0.6])
    for away in (2.0, 1e6):
        origins = np.stack([np.full(5, -away), height, np.full(5, z)], axis=1)
        distance = solid.intersect(origins, np.tile([1.0, 0.0, 0.0], (5, 1))).distance
        np.testing.assert_allclose(distance, away - np.array([0.5, 0.4, 0.3, 0.0, -np.inf]), rtol=1e-15)


def test_distance_to_a_cylinder_is_that_to_its_side_end_or_rim() -> None:
    rod = Cylinder((1.0, 2.0, 3.0), radius=0.5, length=4.0, axis=1)
    points = np.array([[0, 0, 0], [0, 0, 0.4], [0, 1.9, 0], [2, 1, 0], [0.1, 5, 0.2], [3.5, -6, 0], [0, 2.3, 0.9]])
    np.testing.assert_allclose(
        rod.signed_distance(points + rod.centre), [-0.5, -0.1, -0.1, 1.5, 3.0, 5.0, 0.5], atol=1e-14
    )
    assert rod.volume == pytest.approx(math.pi) and rod.area == pytest.approx(4.5 * math.pi)
    assert rod.bounds == ((0.5, 0.0, 2.5), (1.5, 4.0, 3.5))


@pytest.mark.parametrize("tilt", [0.0, 1e-7, -1e-7, 1e-17, 1e-160, -1e-200, 1e-300])
def test_rays_along_a_cylinder_enter_through_its_end(tilt: float) -> None:
    rod = Cylinder((0.0, 0.0, 0.0), radius=0.5, length=2.0, axis=2)
    hits = rod.intersect(
        [[0.1, 0.2, 5.0], [0.1, 0.2, -5.0], [0.6, 0.0, 5.0]], [[tilt, 0, -1], [0, tilt, 1], [0, 0, -1]]
    )
    np.testing.assert_allclose(hits.distance, [4.0, 4.0, np.inf])
    np.testing.assert_array_equal(hits.normal, [[0, 0, 1], [0, 0, -1], [0, 0, 0]])
    level = rod.intersect(
        [[-2.0, 0.0, 0.5], [-2.0, 0.0, 1.5], [2.0, 0.0, 0.5]], [[1, 0, tilt], [1, 0, 0], [1, 0, tilt]]
    )
    np.testing.assert_allclose(level.distance, [1.5, np.inf, np.inf])
    np.testing.assert_allclose(level.normal[0], [-1, 0, 0], atol=1e-12)


def test_a_ray_that_starts_in_a_cylinder_sees_no_wall_from_behind() -> None:
    rod = Cylinder((0.0, 0.0, 0.0), radius=0.5, length=2.0, axis=0)
    assert not rod.intersect([0.2, 0.1, 0.0], np.concatenate([np.eye(3), -np.eye(3)])).hit.any()


def test_points_on_a_cylinder_are_uniform_by_area() -> None:
    rod = Cylinder((0.0, 0.0, 0.0), radius=0.5, length=1.5, axis=0)
    points, normals = rod.surface_points(40_000, seed=4)
    on_end = np.abs(normals[:, 0]) > 0.5
    assert on_end.mean() == pytest.approx(2 * math.pi * 0.25 / rod.area, abs=0.01)
    from_axis = np.hypot(points[on_end, 1], points[on_end, 2])
    assert np.square(from_axis / 0.5).mean() == pytest.approx(0.5, abs=0.015)
    assert points[~on_end, 0].std() == pytest.approx(1.5 / math.sqrt(12.0), abs=0.01)
    np.testing.assert_array_equal(points, rod.surface_points(40_000, seed=4)[0])


def test_distances_are_multiples_of_the_direction(solid) -> None:
    origins, directions = random_rays(solid, 300)
    np.testing.assert_allclose(
        solid.intersect(origins, 4.0 * directions).distance * 4.0, solid.intersect(origins, directions).distance
    )


@pytest.mark.parametrize("tilt", [0.0, 1e-6, -1e-6, 1e-7, -1e-7, 1e-300, -1e-300])
def test_rays_parallel_to_an_axis_hit_the_face_ahead_only(tilt: float) -> None:
    cube = BoxSolid([CUBE])
    hits = cube.intersect([-2.0, 0.5, 0.5], [[1.0, tilt, 0.0], [1.0, tilt, tilt], [-1.0, tilt, 0.0]])
    np.testing.assert_allclose(hits.distance, [2.0, 2.0, np.inf])
    np.testing.assert_array_equal(hits.normal[:2], [[-1, 0, 0], [-1, 0, 0]])
    assert not cube.intersect([-2.0, 1.5, 0.5], [[1.0, tilt, 0.0]]).hit.any()


def test_rays_through_edges_and_corners_do_not_slip_between_faces() -> None:
    cube = BoxSolid([CUBE, ((1, 0, 0), (2, 1, 0.5))])
    targets = np.array([[0, 0, 0.3], [0, 0, 0], [1, 0, 0.5], [1, 0.5, 0.5], [1.0, 1.0, 0.5], [1.0, 0.0, 0.25]])
    for origin in ([-1.0, -1.0, -1.0], [-0.3, -0.7, -0.1], [-1.0 / 3.0, -0.1, 1.0 / 7.0]):
        rays = targets - origin
        assert (cube.intersect(origin, rays).distance <= 1.0 + 1e-9).all()
    draw = np.random.default_rng(8)
    on_edge = np.stack([np.full(5000, 0.3), np.full(5000, 0.1), draw.uniform(0.0, 0.7, 5000)], axis=1)
    origins = np.array([0.3, 0.1, 0.35]) - draw.uniform(0.05, 3.0, (5000, 3))
    odd = BoxSolid([((0.3, 0.1, 0.0), (0.9, 0.8, 0.7))])
    assert (odd.intersect(origins, on_edge - origins).distance <= 1.0 + 1e-9).all()
    from_above = np.array([[1.0, 0.5, 0.5], [1.0, 0.1, 0.5]]) - [3.0, 0.5, 2.5]
    np.testing.assert_allclose(cube.intersect([3.0, 0.5, 2.5], from_above).distance, 1.0)


def test_a_ray_within_the_plane_of_a_face_touches_its_edge() -> None:
    hits = BoxSolid([CUBE]).intersect([-1.0, 0.5, 1.0], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_array_equal(hits.distance, [1.0, np.inf])
    assert BoxSolid([CUBE]).intersect([0.0, 0.5, 0.5], [[1.0, 0.0, 0.0]]).distance[0] == 0.0  # starts on the face


def test_a_ray_that_starts_inside_sees_no_wall_from_behind() -> None:
    pair = BoxSolid([CUBE, ((3, 0, 0), (4, 1, 1))])
    hits = pair.intersect([0.5, 0.5, 0.5], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(hits.distance, [2.5, np.inf])
    assert not Sphere((0, 0, 0), 1.0).intersect([0.1, 0.0, 0.0], [[1.0, 0.0, 0.0]]).hit.any()


def test_a_union_adds_up_and_takes_the_nearest() -> None:
    ball = Sphere((0.5, 0.5, 1.5), 0.5)
    both = SolidUnion((BoxSolid([CUBE]), ball))
    assert both.area == pytest.approx(6.0 + math.pi)
    assert both.volume == pytest.approx(1.0 + math.pi / 6.0)
    hits = both.intersect([0.5, 0.5, 5.0], [[0.0, 0.0, -1.0]])
    assert hits.distance[0] == pytest.approx(3.0)
    np.testing.assert_allclose(both.signed_distance([[0.5, 0.5, 1.5], [0.5, 0.5, 0.9]]), [-0.5, -0.1])


@pytest.mark.parametrize(
    "parts",
    [
        (BoxSolid([CUBE]), Sphere((0.5, 0.5, 1.4), 0.5)),
        (Sphere((0, 0, 0), 1.0), Sphere((1.5, 0, 0), 1.0)),
        (BoxSolid([CUBE]), BoxSolid([((1.0, 0, 0), (2, 1, 1))])),
        (BoxSolid([CUBE]), Sphere((0.5, 0.5, 0.5), 0.1)),
        (BoxSolid([CUBE]), Cylinder((0.5, 0.5, 1.25), 0.1, 0.5, axis=2)),
        (BoxSolid([CUBE]), Cylinder((1.1, 1.1, 0.5), 0.15, 0.5, axis=2)),
        (Cylinder((0, 0, 0), 0.5, 2.0, axis=1), Sphere((0, 1.2, 0), 0.3)),
        (Cylinder((0, 0, 0), 0.5, 2.0, axis=1), Cylinder((0.7, 1.5, 0.7), 0.5, 2.0, axis=1)),
        (Cylinder((0, 0, 0), 0.5, 2.0, axis=1), Cylinder((0, 0, 0.9), 0.5, 2.0, axis=0)),
    ],
)
def test_a_union_refuses_overlap(parts: tuple) -> None:
    with pytest.raises(SceneError, match="parts 0 and 1"):
        SolidUnion(parts)


@pytest.mark.parametrize(
    "parts",
    [
        (BoxSolid([CUBE]), Cylinder((0.5, 0.5, 1.3), 0.1, 0.5, axis=2)),
        (BoxSolid([CUBE]), Cylinder((1.1, 1.1, 0.5), 0.14, 0.5, axis=2)),
        (Sphere((0, 1.4, 0), 0.3), Cylinder((0, 0, 0), 0.5, 2.0, axis=1)),
        (Cylinder((0, 0, 0), 0.5, 2.0, axis=1), Cylinder((0.8, 1.5, 0.8), 0.5, 2.0, axis=1)),
        (Cylinder((0, 0, 0), 0.5, 2.0, axis=1), Cylinder((0, 2.1, 0), 0.5, 2.0, axis=1)),
        (Cylinder((0, 0, 0), 0.5, 2.0, axis=1), Cylinder((0, 0, 1.1), 0.5, 2.0, axis=0)),
    ],
)
def test_a_union_takes_parts_with_a_gap(parts: tuple) -> None:
    assert SolidUnion(parts).volume == pytest.approx(parts[0].volume + parts[1].volume)
