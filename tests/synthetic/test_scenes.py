"""All scenes by name: laws that each keeps, and for single ones sizes, temperatures, pictures and surroundings."""

import dataclasses
import itertools

import numpy as np
import pytest

from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.camera_rings import CameraRing, CameraWalk, look_at, ring_poses
from thermoxels_ns.synthetic.catalogue import DEVELOPMENT_NAMES, SCENE_NAMES, make_scene
from thermoxels_ns.synthetic.raycast import render_view, visible_surface_points
from thermoxels_ns.synthetic.solids import BoxSolid

RANDOM = tuple(f"random-{seed}" for seed in range(15))
AROUND = (*DEVELOPMENT_NAMES, "house-corner+street", "hot-object+room")


@pytest.fixture(params=SCENE_NAMES)
def scene(request: pytest.FixtureRequest):
    return make_scene(request.param)


def unit_directions() -> np.ndarray:
    drawn = np.random.default_rng(0).standard_normal((3000, 3))
    return np.concatenate([drawn / np.linalg.norm(drawn, axis=1, keepdims=True), np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("name", (*SCENE_NAMES, *RANDOM))
def test_solid_lies_in_the_scene_box_with_room_for_two_voxels(name: str) -> None:
    scene = make_scene(name)
    (lo, hi), (solid_lo, solid_hi) = np.array(scene.scene_box), np.array(scene.solid.bounds)
    voxel = scene.size / 64
    assert (solid_lo - lo >= 2 * voxel).all() and (hi - solid_hi >= 2 * voxel).all()
    assert name not in RANDOM or (solid_hi - solid_lo).max() > 0.9 * scene.size


@pytest.mark.parametrize("name", (*SCENE_NAMES, *RANDOM[:10]))
def test_temperatures_fill_their_bounds_and_are_continuous(name: str) -> None:
    scene = make_scene(name)
    lowest, highest = scene.temperature_bounds_c
    points, normals = scene.solid.surface_points(20_000, seed=5)
    surface = scene.surface_temperature_c(points)
    both = np.concatenate([surface, scene.background_temperature_c(unit_directions())])
    assert lowest <= both.min() and both.max() <= highest and np.ptp(both) > 0.9 * (highest - lowest)
    if name not in RANDOM:  # parts of the others stand side by side
        return
    assert 15.0 <= highest - lowest <= 60.0
    beside = scene.surface_temperature_c(points + 0.01 * scene.size / 127 * along_surface(normals))
    assert np.abs(beside - surface).max() < 0.02 * (highest - lowest)


def along_surface(normals: np.ndarray) -> np.ndarray:
    along = np.cross(normals, [0.31, 0.55, 0.77])
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def test_exact_sizes() -> None:
    assert make_scene("sphere").solid.area == pytest.approx(np.pi)
    assert make_scene("sphere").solid.volume == pytest.approx(np.pi / 6)
    hot = make_scene("hot-object")
    table, lower, upper, ball = 1.0 * 0.8 * 0.08, 0.34 * 0.32 * 0.14, 0.18 * 0.32 * 0.14, 4 / 3 * np.pi * 0.12**3
    assert hot.solid.volume == pytest.approx(table + lower + upper + ball)
    sides = 2 * 0.08 * 1.8 + 2 * 0.14 * (0.34 + 0.32) + 2 * 0.14 * (0.18 + 0.32)
    assert hot.solid.area == pytest.approx(2 * 1.0 * 0.8 + sides + 4 * np.pi * 0.12**2)
    house = make_scene("house-corner")
    panes = [(1.2, 1.1), (1.4, 1.1), (1.1, 1.7), (0.9, 1.1), (1.1, 2.1), (1.3, 1.1), (1.8, 1.2), (0.9, 1.2)]
    recesses = 0.35 * sum(w * h for w, h in panes)
    ground, building, roof, balcony = 7.6 * 7.1 * 0.45, 6 * 5 * 5.0, 6.6 * 5.6 * 0.35, 3.0 * 1.3 * 0.35
    assert house.solid.volume == pytest.approx(ground + building + roof + balcony - recesses)
    court = make_scene("courtyard")
    openings = [(1.0, 2.1), (0.8, 1.2), (1.5, 1.3), (1.2, 1.2), (1.4, 1.2), (1.1, 1.1)]
    wings = 2.2 * 4.4 * 3.4 + 7.8 * 2.2 * 3.4 + 2.2 * 2.9 * 2.7 - 0.3 * sum(w * h for w, h in openings)
    # The north and the west roof share 0.4 m x 3 m.
    roofs = 0.3 * (3.0 * 4.4 + 8.6 * 3.0 + 3.0 * 3.3)
    beam_m = 2.25 + 0.28 + 1.7
    thin = 0.28**2 * (4 * 2.4 + beam_m) + 3.6 * 0.16 * 1.6 + 0.35**3 + 0.5 * 0.5 * 0.9
    assert court.solid.volume == pytest.approx(10.4 * 10.4 * 0.4 + wings + roofs + thin)
    pipes = make_scene("pipes")
    rods = [(0.13, 1.6), (0.075, 2.3), (0.04, 1.7)]
    assert pipes.solid.volume == pytest.approx(2.6 * 0.16 * 1.8 + sum(np.pi * r * r * h for r, h in rods))
    wall_m2 = 2 * (2.6 * 0.16 + 2.6 * 1.8 + 0.16 * 1.8)
    assert pipes.solid.area == pytest.approx(wall_m2 + sum(2 * np.pi * r * (r + h) for r, h in rods))


@pytest.mark.parametrize(
    ("name", "points", "degrees"),
    [
        ("hot-object", [[-0.36, 0, 0.05], [0.24, -0.04, 0.24], [0.48, 0.38, 0.0]], [66.75, 47.2, 19.06]),
        (
            "house-corner",
            [[-1.8, -2.15, 1.4], [-2.8, -2.5, 1.0], [-2.8, -2.5, 2.625], [0, -3.8, 2.6]],
            [14, 4.82, 8.02, 1.8],
        ),
        ("sphere", [[0, 0, -0.5], [0.3, 0.4, 0]], [20.0, 30.0]),
        (
            "courtyard",
            [[4.25, 0.5, 1.4], [-0.6, 2.3, 1.0], [3.0, -4.4, 1.0], [3.0, -4.24, 1.0]],
            [39.5, 22.0, 15.0, 5.0],
        ),
        ("courtyard", [[-3.9, 0.0, 1.7], [3.9, -0.8, 1.7], [0.0, -1.0, 3.7]], [5.66, 10.34, -1.45]),
        ("pipes", [[-0.55, -0.41, 0], [0.05, -0.675, 0.3], [0.5, -0.24, 0], [-0.55, 0, 0]], [62, 44, 30, 26]),
    ],
)
def test_temperatures_tell_the_parts_apart(name: str, points: list, degrees: list) -> None:
    np.testing.assert_allclose(make_scene(name).surface_temperature_c(points), degrees, atol=0.05)


@pytest.mark.parametrize(("name", "zenith", "horizon"), [("house-corner", -20.0, 0.0), ("courtyard", -10.0, 2.0)])
def test_the_sky_is_colder_above(name: str, zenith: float, horizon: float) -> None:
    sky = make_scene(name).background_temperature_c([[0, 0, 1.0], [1.0, 0, 0]])
    np.testing.assert_allclose(sky, [zenith, horizon], atol=0.5)


def seen_by_three(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    scene = make_scene(name)
    points, normals = scene.solid.surface_points(6000)
    return (
        points,
        normals,
        visible_surface_points(scene, scene.poses(42, 6)[0], scene.camera(320, 240), points, normals),
    )


@pytest.mark.parametrize("name", RANDOM[:5])
def test_most_of_what_can_be_seen_is_seen_by_three_cameras(name: str) -> None:
    _, normals, seen = seen_by_three(name)
    if name == "random-4":  # the facade, in front of which they stand
        assert seen[normals[:, 1] < -0.5].mean() > 0.95 and not seen[normals[:, 1] > 0.5].any()
    else:
        assert seen[normals[:, 2] > -0.5].mean() > 0.9


def test_three_cameras_see_the_front_of_the_pipes_and_not_their_back() -> None:
    points, normals, seen = seen_by_three("pipes")
    before_the_wall, on_its_front = points[:, 1] < -0.01, np.abs(points[:, 1]) < 1e-9
    assert seen[on_its_front].all() and seen[before_the_wall & (normals[:, 1] < 0)].mean() > 0.98
    assert not seen[normals[:, 1] > 0.99].any()


def test_three_cameras_see_the_yard_and_the_columns_of_the_courtyard() -> None:
    points, normals, seen = seen_by_three("courtyard")
    assert seen[normals[:, 2] > -0.5].mean() > 0.97
    yard = (np.abs(points[:, 0]) < 1.7) & (points[:, 1] > -0.9) & (points[:, 1] < 1.6) & (points[:, 2] == 0.0)
    columns = (np.abs(points[:, 1] + 2.16) < 0.15) & (points[:, 2] > 0) & (points[:, 2] < 2.4)
    assert yard.sum() > 50 and seen[yard].mean() > 0.95
    assert columns.sum() > 100 and seen[columns].mean() > 0.9


def test_cameras_above_the_table_never_see_its_bottom() -> None:
    points, normals, seen = seen_by_three("hot-object")
    assert not seen[(normals[:, 2] < -0.999) & (points[:, 2] < -0.07)].any()
    assert seen[(normals[:, 2] > 0.999) & (points[:, 2] > 0.2)].all() and 0.5 < seen.mean() < 0.75


@pytest.mark.parametrize("name", (*SCENE_NAMES, *AROUND, *RANDOM, *(f"wild-{seed}" for seed in range(20, 35))))
def test_cameras_stand_free_and_frame_the_scene(name: str) -> None:
    scene = make_scene(name)
    camera, points = scene.camera(320, 240), scene.solid.surface_points(2000)[0]
    poses = np.concatenate(scene.poses(42, 6))
    assert scene.solid.signed_distance(poses[:, :3, 3]).min() > 0.3 * scene.size
    inside = np.random.default_rng(1).uniform(*scene.solid.bounds, (2000, 3))
    if scene.around is not None:
        assert min(scene.around.solid.signed_distance(at).min() for at in (poses[:, :3, 3], inside)) > 0.0
    pixels = np.array([camera.project_world(pose, points) for pose in poses])
    spread = np.ptp(pixels, axis=1) / (320, 240)
    if name not in ("facade", "street"):  # cameras walk past these
        assert camera.contains(pixels.reshape(-1, 2)).all()
    if name in SCENE_NAMES:
        assert (spread * (320, 240)).max(axis=1).min() > 0.4 * 320
    if name in RANDOM:
        assert spread.prod(axis=1).mean() > 0.4 and spread.prod(axis=1).min() > 0.2 and poses[:, 2, 3].min() > 0.0
    elif name.startswith("wild"):
        sky = scene.background_rgb([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
        kind = "around" if scene.around else "plain" if (sky[0] == sky[1]).all() else "smooth"
        assert kind == ("smooth", "plain", "around")[int(name[5:]) % 3]


@pytest.mark.parametrize("name", AROUND)
def test_surroundings_are_seen_within_the_bounds_of_temperature(name: str) -> None:
    scene = make_scene(name)
    lowest, highest = scene.temperature_bounds_c
    view = render_view(scene, scene.poses(3, 0)[0][1], scene.camera(64, 48))
    assert lowest <= view.temperature_c.min() and view.temperature_c.max() <= highest
    assert 0.15 < view.hit.mean() < 0.95 and view.rgb.std() > 0.05


@pytest.mark.parametrize(("num_train", "num_eval"), [(42, 6), (1, 1), (2, 3), (7, 0), (4, 9)])
def test_no_evaluation_view_repeats_a_view(scene, num_train: int, num_eval: int) -> None:
    train, held_out = scene.poses(num_train, num_eval)
    assert train.shape == (num_train, 4, 4) and held_out.shape == (num_eval, 4, 4)
    positions = np.concatenate([train, held_out])[:, :3, 3]
    size = np.subtract(*scene.scene_box[::-1]).max()
    assert all(np.linalg.norm(a - b) > 0.02 * size for a, b in itertools.combinations(positions, 2))


def test_evaluation_views_stand_half_way_between_training_views() -> None:
    ring = CameraRing((1.0, 2.0, 0.0), 3.0, 1.5)
    train, held_out = ring_poses([ring], 8, 4)
    azimuth = np.sort(np.degrees(np.arctan2(train[:, 1, 3] - 2.0, train[:, 0, 3] - 1.0)) % 360)
    np.testing.assert_allclose(np.diff(azimuth), 45.0)
    between = np.degrees(np.arctan2(held_out[:, 1, 3] - 2.0, held_out[:, 0, 3] - 1.0)) % 360
    np.testing.assert_allclose((between - azimuth[0]) % 45.0, 22.5)
    arc = dataclasses.replace(ring, start_deg=0.0, span_deg=90.0)
    train, held_out = ring_poses([arc], 5, 2)
    azimuths = [np.degrees(np.arctan2(p[:, 1, 3] - 2.0, p[:, 0, 3] - 1.0)) for p in (train, held_out)]
    assert azimuths[0].min() < azimuths[1].min() and azimuths[1].max() < azimuths[0].max() <= 90.0


def test_sphere_depth_and_temperature_are_analytic() -> None:
    scene, camera = make_scene("sphere"), make_scene("sphere").camera(81, 61)
    view = render_view(scene, look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0)), camera, samples_per_axis=1)
    column, row = np.meshgrid(np.arange(81) + 0.5 - camera.cx, np.arange(61) + 0.5 - camera.cy)
    squared = (column**2 + row**2) / camera.fl_x**2
    cosine = 1.0 / np.sqrt(1.0 + squared)
    reach = 0.25 - 4.0 * (1.0 - cosine**2)
    with np.errstate(invalid="ignore"):
        depth = np.where(reach >= 0, 2.0 * cosine - np.sqrt(reach), np.inf)
    np.testing.assert_array_equal(view.hit, reach >= 0)
    np.testing.assert_allclose(view.depth_m, depth, rtol=1e-12)
    z = -row / camera.fl_y * cosine * np.where(view.hit, view.depth_m, 0.0)
    np.testing.assert_allclose(view.temperature_c, np.where(view.hit, 30.0 + 20.0 * z, 10.0), atol=1e-9)


def test_supersampling_is_the_mean_of_a_finer_image(scene) -> None:
    pose = scene.poses(3, 0)[0][1]
    coarse = render_view(scene, pose, scene.camera(20, 15), samples_per_axis=2)
    fine = render_view(scene, pose, scene.camera(40, 30), samples_per_axis=1)
    np.testing.assert_allclose(
        coarse.temperature_c, fine.temperature_c.reshape(15, 2, 20, 2).mean(axis=(1, 3)), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(coarse.rgb, fine.rgb.reshape(15, 2, 20, 2, 3).mean(axis=(1, 3)), atol=1e-5)
    assert (coarse.hit == np.isfinite(coarse.depth_m)).all()


def test_colours_are_textured_and_smoother_than_two_voxels(scene) -> None:
    points, normals = scene.solid.surface_points(4000)
    colour, along, voxel = scene.colour(points, normals), along_surface(normals), scene.size / 64
    assert colour[normals[:, 2] > 0.7].std(axis=0).min() > 0.05
    # A hundredth of a voxel along the surface changes little; two voxels change about as much as anything does.
    near = np.abs(scene.colour(points + 0.01 * voxel * along, normals) - colour).mean()
    far = np.abs(scene.colour(points + 2.0 * voxel * along, normals) - colour).mean()
    # Most of the pipes' scene is a wall that shows little texture on purpose.
    assert near < 0.02 and near < 0.05 * far and far > (0.012 if scene.name == "pipes" else 0.03)


@pytest.mark.parametrize("name", (*SCENE_NAMES, *RANDOM[:10], *(f"wild-{seed}" for seed in range(20, 25))))
def test_colours_are_in_range_and_differ(name: str) -> None:
    scene = make_scene(name)
    colour = scene.colour(*scene.solid.surface_points(4000, seed=6))
    assert colour.shape == (4000, 3) and colour.min() >= 0.0 and colour.max() <= 1.0 and colour.std() > 0.05


def test_a_camera_inside_the_solid_is_an_error() -> None:
    scene = make_scene("house-corner")
    pose = look_at((0.0, 0.0, 1.0), (3.0, 0.0, 1.5))
    with pytest.raises(SceneError):
        render_view(scene, pose, scene.camera(8, 6))
    with pytest.raises(SceneError):
        visible_surface_points(scene, [pose], scene.camera(8, 6), *scene.solid.surface_points(10))


def test_visibility_counts_views() -> None:
    scene, camera = make_scene("sphere"), make_scene("sphere").camera(64, 48)
    poses = [look_at(p, (0, 0, 0)) for p in ((2, 0, 0.1), (0, 2, 0.1), (2, 0.1, 0))]
    points = np.array([[0.5, 0, 0], [0, 0.5, 0], [-0.5, 0, 0], [0.3, 0.4, 0.0]])
    counts = sum(
        visible_surface_points(scene, poses, camera, points, points / 0.5, min_views=n).astype(int) for n in (1, 2, 3)
    )
    np.testing.assert_array_equal(counts, [2, 1, 0, 3])


def test_names_say_what_stands_behind() -> None:
    scene = make_scene("house-corner+sky=0.55,0.57,0.60+street")
    assert scene.name == "house-corner+sky=0.55,0.57,0.60+street" and scene.around is not None
    np.testing.assert_allclose(scene.background_rgb(np.eye(3)), [[0.55, 0.57, 0.60]] * 3, atol=1e-6)
    plain = make_scene("house-corner")
    assert scene.solid.area == plain.solid.area and plain.around is None
    np.testing.assert_array_equal(scene.background_temperature_c(np.eye(3)), plain.background_temperature_c(np.eye(3)))
    white = make_scene("house-corner+white")
    assert white.colour([[-2.8, -2.5, 0.5], [2.8, -2.5, 0.5]], [[0, -1, 0]] * 2).std(axis=0).max() == 0.0


@pytest.mark.parametrize(
    "name",
    [
        *("castle", "sphere+", "sphere+moon", "sphere+sky=1,1", "sphere+sky=1,1,2", "sphere+street+room"),
        *("pipes+white", "random", "random-", "random-017", "random--1", "random-1.5", "random-x", "Random-1"),
        *("random-1 ", "random-²", "random-" + "9" * 5000),
    ],
)
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(SceneError):
        make_scene(name)


def test_what_stands_behind_has_parallax_and_hides_what_is_farther() -> None:
    scene = make_scene("wall-object")
    assert scene.around is not None
    eye = np.array([0.0, -2.0, 0.1])
    camera, pose = Camera(3, 3, 9.0, 9.0, 1.5, 1.5), look_at(eye, np.add(eye, [0.0, 1.0, 0.0]))
    shifted = dataclasses.replace(
        scene, around=dataclasses.replace(scene.around, surface_temperature_c=lambda points: np.asarray(points)[:, 0])
    )
    bare = dataclasses.replace(shifted, solid=make_scene("sphere").solid)
    view = render_view(
        bare, look_at(np.add(eye, [3.0, 0.0, 0.0]), np.add(eye, [3.0, 1.0, 0.0])), camera, samples_per_axis=1
    )
    np.testing.assert_allclose(view.temperature_c, [[3.0 + 2.7 * k / 9.0 for k in (-1, 0, 1)]] * 3)
    assert not view.hit.any()
    hidden = dataclasses.replace(
        scene,
        solid=make_scene("sphere").solid,
        around=dataclasses.replace(scene.around, solid=BoxSolid((((-9.0, -1.0, -9.0), (9.0, -0.9, 9.0)),))),
    )
    assert not render_view(hidden, pose, camera).hit.any()
    point = np.array([[0.0, -0.5, 0.0]])
    for one, seen in ((bare, True), (hidden, False)):
        assert visible_surface_points(one, [pose] * 3, camera, point, [[0.0, -1.0, 0.0]])[0] == seen


def test_a_pane_mirrors_what_lies_along_the_reflected_ray() -> None:
    scene = make_scene("street")
    assert scene.mirror is not None
    pane, ray = np.array([[-4.0, 0.35, 5.5]]), np.array([0.3, 1.0, 0.1]) / np.linalg.norm([0.3, 1.0, 0.1])
    assert scene.mirror(pane, [[0.0, -1.0, 0.0]])[0] == np.float32(0.6)
    one = Camera(1, 1, 1e4, 1e4, 0.5, 0.5)
    seen = render_view(scene, look_at(pane[0] - 6.0 * ray, pane[0]), one, 1).rgb[0, 0]
    back = ray * [1.0, -1.0, 1.0]
    mirrored = render_view(scene, look_at(pane[0] + 1e-9 * back, pane[0] + back), one, 1).rgb[0, 0]
    paint = scene.colour(pane, [[0.0, -1.0, 0.0]])[0]
    np.testing.assert_allclose(seen, 0.4 * paint + 0.6 * mirrored, atol=1e-4)


def test_cameras_of_a_walk_stand_on_a_line_and_look_across_it() -> None:
    walk = CameraWalk(((-3.0, -5.0, 1.0), (3.0, -5.0, 1.0)), ((-1.0, 0.0, 1.0), (1.0, 0.0, 1.0)))
    train, held_out = ring_poses([walk], 6, 2)
    assert np.ptp(train[:, 1:3, 3], axis=0).max() < 1e-12 and (np.abs(train[:, 0, 3]) <= 3.0).all()
    np.testing.assert_allclose(np.diff(train[:, 0, 3]), 1.0)
    assert (train[:, 1, 2] < -0.9).all() and train[0, 0, 3] < held_out[0, 0, 3] < held_out[1, 0, 3] < train[-1, 0, 3]
