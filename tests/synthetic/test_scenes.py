"""All scenes by name: laws that each keeps, and for single ones sizes, temperatures, pictures and surroundings."""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
import pytest

from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.drawn_scenes import DEVELOPMENT_NAMES, SCENE_NAMES, make_scene
from thermoxels_ns.synthetic.random_plan import SMALLEST, Plan
from thermoxels_ns.synthetic.random_scene import FAMILIES
from thermoxels_ns.synthetic.raycast import render_view, visible_surface_points
from thermoxels_ns.synthetic.scene_truth import look_at
from thermoxels_ns.synthetic.solids import BoxSolid, SolidUnion, distance_to_box

RANDOM = tuple(f"random-{seed}" for seed in range(15))
ROOMS = ("living-room", "l-room")  # cameras stand in them
AROUND = (*(name for name in DEVELOPMENT_NAMES if name not in ROOMS), "house-corner+street", "hot-object+room")


@pytest.mark.parametrize("name", (*SCENE_NAMES, *RANDOM))
def test_solid_lies_in_the_scene_box_with_room_for_two_voxels(name: str) -> None:
    scene = make_scene(name)
    (lo, hi), (solid_lo, solid_hi) = np.array(scene.scene_box), np.array(scene.solid.bounds)
    voxel = scene.size / 64
    assert (solid_lo - lo >= 2 * voxel).all() and (hi - solid_hi >= 2 * voxel).all()
    assert name not in RANDOM or (solid_hi - solid_lo).max() > 0.9 * scene.size


@pytest.mark.parametrize("name", (*SCENE_NAMES, *RANDOM[:10]))
def test_temperatures_fill_their_bounds(name: str) -> None:
    scene = make_scene(name)
    lowest, highest = scene.temperature_bounds_c
    points, _ = scene.solid.surface_points(20_000, seed=5)
    surface = scene.surface_temperature_c(points)
    drawn = np.random.default_rng(0).standard_normal((3000, 3))
    directions = np.concatenate([drawn / np.linalg.norm(drawn, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    both = np.concatenate([surface, scene.background_temperature_c(directions)])
    assert lowest <= both.min() and both.max() <= highest and np.ptp(both) > 0.9 * (highest - lowest)
    assert name not in RANDOM or 15.0 <= highest - lowest <= 60.0


# Volume [m3], area [m2], height of the first camera [m], temperature at the first of the surface points [C].
PINNED = {
    "hot-object": (0.0945342295, 2.39375574, 0.36, 21.6255185),
    "house-corner": (184.138, 276.53, 1.7, 1.49617591),
    "sphere": (np.pi / 6, np.pi, -0.75, 39.6176368),
    "courtyard": (165.887747, 427.9644, 1.9, -2.25088079),
    "pipes": (0.882938152, 13.7375905, -0.7, 19.5607015),
    "random-0": (351.011704, 558.930277, 5.6973, -6.21955596),
    "random-1": (1.14495714, 17.8918927, 1.1287, 21.0535107),
    "random-2": (2.5596005, 38.9510598, 1.25, 33.8749463),
    "random-3": (1517.96143, 1939.57443, 9.4583, 17.940837),
    "random-4": (107.433034, 276.630761, 4.3663, -4.86352921),
}


@pytest.mark.parametrize("name", PINNED)
def test_a_name_means_the_same_scene_on_every_machine(name: str) -> None:
    scene = make_scene(name)
    height = scene.poses(42, 6)[0][0][2, 3]
    temperature = scene.surface_temperature_c(scene.solid.surface_points(10)[0])[0]
    assert (scene.solid.volume, scene.solid.area, height, temperature) == pytest.approx(PINNED[name], rel=1e-6)


@pytest.mark.parametrize(
    ("name", "side", "least"),
    [
        *((f"random-{family}", lambda p, n: n[:, 2] > -0.5, 0.9) for family in range(4)),
        ("random-4", lambda p, n: n[:, 1] < -0.5, 0.95),  # the facade, in front of which they stand
        ("pipes", lambda p, n: (p[:, 1] < -0.01) & (n[:, 1] < 0), 0.98),
        ("courtyard", lambda p, n: n[:, 2] > -0.5, 0.97),
        ("courtyard", lambda p, n: (np.abs(p[:, 1] + 2.16) < 0.15) & (p[:, 2] > 0) & (p[:, 2] < 2.4), 0.9),  # columns
        ("hot-object", lambda p, n: (n[:, 2] > 0.999) & (p[:, 2] > 0.2), 0.99),
        ("hot-object", lambda p, n: (n[:, 2] < -0.999) & (p[:, 2] < -0.07), 0.0),  # the table's bottom
        ("pipes", lambda p, n: n[:, 1] > 0.99, 0.0),  # the back of the wall
    ],
)
def test_three_cameras_see_what_can_be_seen_and_nothing_else(name: str, side: Callable, least: float) -> None:
    scene = make_scene(name)
    points, normals = scene.solid.surface_points(6000)
    seen = visible_surface_points(scene, scene.poses(42, 6)[0], scene.camera(320, 240), points, normals)
    share = seen[side(points, normals)].mean()
    assert share > least if least else share == 0.0


@pytest.mark.parametrize("name", (*SCENE_NAMES, *AROUND, *RANDOM, *(f"wild-{seed}" for seed in range(20, 35))))
def test_cameras_stand_free_and_frame_the_scene(name: str) -> None:
    scene = make_scene(name)
    camera, (points, normals) = scene.camera(320, 240), scene.solid.surface_points(2000)
    colour = scene.colour(points, normals)
    assert colour.shape == (2000, 3) and colour.min() >= 0.0 and colour.max() <= 1.0 and colour.std() > 0.05
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


@pytest.mark.parametrize("name", (*AROUND, *ROOMS))
def test_what_is_seen_of_surroundings_or_from_within_a_room_keeps_the_bounds_of_temperature(name: str) -> None:
    scene = make_scene(name)
    lowest, highest = scene.temperature_bounds_c
    poses = scene.poses(3, 0)[0]
    assert name not in ROOMS or scene.solid.signed_distance(poses[:, :3, 3]).min() > 0.3
    for pose in poses:
        view = render_view(scene, pose, scene.camera(64, 48))
        assert lowest <= view.temperature_c.min() and view.temperature_c.max() <= highest
        hit = np.isfinite(view.depth_m)
        assert hit.all() if name in ROOMS else 0.15 < hit.mean() < 0.95 and view.rgb.std() > 0.05


@pytest.mark.parametrize(("num_train", "num_eval"), [(42, 6), (1, 1), (2, 3), (7, 0), (4, 9)])
@pytest.mark.parametrize("name", SCENE_NAMES)
def test_no_evaluation_view_repeats_a_view(name: str, num_train: int, num_eval: int) -> None:
    scene = make_scene(name)
    train, held_out = scene.poses(num_train, num_eval)
    assert train.shape == (num_train, 4, 4) and held_out.shape == (num_eval, 4, 4)
    positions = np.concatenate([train, held_out])[:, :3, 3]
    size = np.subtract(*scene.scene_box[::-1]).max()
    assert all(np.linalg.norm(a - b) > 0.02 * size for a, b in itertools.combinations(positions, 2))


def test_sphere_depth_and_temperature_are_analytic() -> None:
    scene, camera = make_scene("sphere"), make_scene("sphere").camera(81, 61)
    view = render_view(scene, look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0)), camera, samples_per_axis=1)
    column, row = np.meshgrid(np.arange(81) + 0.5 - camera.cx, np.arange(61) + 0.5 - camera.cy)
    squared = (column**2 + row**2) / camera.fl_x**2
    cosine = 1.0 / np.sqrt(1.0 + squared)
    reach = 0.25 - 4.0 * (1.0 - cosine**2)
    with np.errstate(invalid="ignore"):
        depth = np.where(reach >= 0, 2.0 * cosine - np.sqrt(reach), np.inf)
    np.testing.assert_allclose(view.depth_m, depth, rtol=1e-12)
    z = -row / camera.fl_y * cosine * np.where(reach >= 0, view.depth_m, 0.0)
    np.testing.assert_allclose(view.temperature_c, np.where(reach >= 0, 30.0 + 20.0 * z, 10.0), atol=1e-9)


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
    eye = np.array([0.0, -2.0, 0.1])
    camera, pose = Camera(3, 3, 9.0, 9.0, 1.5, 1.5), look_at(eye, np.add(eye, [0.0, 1.0, 0.0]))
    along_x = dataclasses.replace(scene.around, surface_temperature_c=lambda points: np.asarray(points)[:, 0])
    bare = dataclasses.replace(scene, around=along_x, solid=make_scene("sphere").solid)
    aside = look_at((3.0, -2.0, 0.1), (3.0, -1.0, 0.1))
    view = render_view(bare, aside, camera, samples_per_axis=1)
    np.testing.assert_allclose(view.temperature_c, [[3.0 + 2.7 * k / 9.0 for k in (-1, 0, 1)]] * 3)
    assert np.isinf(view.depth_m).all()
    near = dataclasses.replace(scene.around, solid=BoxSolid((((-9.0, -1.0, -9.0), (9.0, -0.9, 9.0)),)))
    hidden = dataclasses.replace(bare, around=near)
    assert np.isinf(render_view(hidden, pose, camera).depth_m).all()
    point = np.array([[0.0, -0.5, 0.0]])
    for one, seen in ((bare, True), (hidden, False)):
        assert visible_surface_points(one, [pose] * 3, camera, point, [[0.0, -1.0, 0.0]])[0] == seen


def test_a_pane_mirrors_what_lies_along_the_reflected_ray() -> None:
    scene = make_scene("street")
    pane, ray = np.array([[-4.0, 0.35, 5.5]]), np.array([0.3, 1.0, 0.1]) / np.linalg.norm([0.3, 1.0, 0.1])
    assert scene.mirror(pane, [[0.0, -1.0, 0.0]])[0] == np.float32(0.6)
    one = Camera(1, 1, 1e4, 1e4, 0.5, 0.5)
    seen = render_view(scene, look_at(pane[0] - 6.0 * ray, pane[0]), one, 1).rgb[0, 0]
    back = ray * [1.0, -1.0, 1.0]
    mirrored = render_view(scene, look_at(pane[0] + 1e-9 * back, pane[0] + back), one, 1).rgb[0, 0]
    paint = scene.colour(pane, [[0.0, -1.0, 0.0]])[0]
    np.testing.assert_allclose(seen, 0.4 * paint + 0.6 * mirrored, atol=1e-4)


# Things that rest on something are this close to it, found by the nearest of random points [voxels of the plan].
CONTACT = 0.06


@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_thinner_or_closer_than_three_voxels_of_128(seed: int) -> None:
    scene = make_scene(f"random-{seed}")
    boxes = scene.solid.parts[0] if isinstance(scene.solid, SolidUnion) else scene.solid
    voxel = scene.size / 127
    points, normals = boxes.surface_points(2500, seed=2)
    for voxels in np.linspace(0.02, 2.99, 12):
        assert boxes.contains(points - voxels * voxel * normals).all()
        assert not boxes.contains(points + voxels * voxel * normals).any()


@pytest.mark.parametrize(("number", "seed"), list(itertools.product((1, 2), range(4))))
def test_round_things_keep_their_distance_or_rest_on_something(number: int, seed: int) -> None:
    plan = Plan(np.random.default_rng([99, seed]))
    FAMILIES[number].lay_out(plan)
    boxes = [piece.shape for piece in plan.pieces if isinstance(piece.shape, tuple)]
    things = [piece.shape for piece in plan.pieces if not isinstance(piece.shape, tuple)]
    assert len(things) >= 3
    assert all(2.0 * thing.radius > SMALLEST for thing in things)
    for thing in things:
        points = thing.surface_points(20_000, seed=1)[0]
        gaps = np.array([distance_to_box(points, *box).min() for box in boxes])
        resting = gaps < CONTACT
        assert resting.any() and (gaps[~resting] > SMALLEST - CONTACT).all()
        assert all(other.signed_distance(points).min() > SMALLEST for other in things if other is not thing)
