"""Scenes from a seed: exact, the same everywhere, nothing thinner than three voxels, and photographed from outside."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import tyro

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.box_solid import BoxSolid, distance_to_box
from thermoxels_ns.synthetic.catalogue import SceneWord, make_scene
from thermoxels_ns.synthetic.random_plan import SMALLEST, WIDEST, Plan
from thermoxels_ns.synthetic.random_scene import FAMILIES, random_scene, random_seed
from thermoxels_ns.synthetic.raycast import visible_surface_points
from thermoxels_ns.synthetic.scene_folder import load_truth, write_scene
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solid_union import SolidUnion

MANY = range(30)
ONE_OF_EACH = range(len(FAMILIES))
# Things that rest on something are this close to it, found by the nearest of random points [voxels of the plan].
_CONTACT = 0.06


def size(scene: SyntheticScene) -> float:
    lo, hi = scene.scene_box
    return float(np.subtract(hi, lo).max())


def laid_out(number: int, seed: int) -> Plan:
    plan = Plan(np.random.default_rng([99, seed]))
    FAMILIES[number].lay_out(plan)
    return plan


def boxes_of(scene: SyntheticScene) -> BoxSolid:
    part = scene.solid.parts[0] if isinstance(scene.solid, SolidUnion) else scene.solid
    assert isinstance(part, BoxSolid)
    return part


def test_a_seed_in_the_name_makes_the_scene() -> None:
    scene = make_scene("random-17")
    assert scene.name == "random-17" and make_scene("random-17") is scene
    assert scene.volume_m3 == random_scene(17).volume_m3 != random_scene(18).volume_m3
    assert [random_seed(f"random-{n}") for n in (0, 8, 10**17)] == [0, 8, 10**17]


@pytest.mark.parametrize(
    "name",
    ["random", "random-", "random-017", "random--1", "random-1.5", "random-x", "Random-1", "random-1 ", "random-²"],
)
def test_other_names_are_refused_with_the_names_there_are(name: str) -> None:
    with pytest.raises(SceneError, match=r"random-N or wild-N .* house-corner.*got '[Rr]andom") as problem:
        make_scene(name)
    assert repr(name) in str(problem.value)


def test_a_number_too_long_for_a_seed_and_a_negative_one_are_refused() -> None:
    with pytest.raises(SceneError, match="random-N"):
        make_scene("random-" + "9" * 5000)
    with pytest.raises(SceneError, match="seed: expected a whole number from 0 on, got -1"):
        random_scene(-1)


def test_the_command_line_takes_names_and_seeds_and_refuses_others(capsys: pytest.CaptureFixture[str]) -> None:
    assert tyro.cli(SceneWord, args=["random-3"]) == "random-3"  # type: ignore[call-overload]
    assert tyro.cli(SceneWord, args=["sphere"]) == "sphere"  # type: ignore[call-overload]
    with pytest.raises(SystemExit) as stop:
        tyro.cli(SceneWord, args=["random-03"])  # type: ignore[call-overload]
    assert stop.value.code == 2
    assert "random-N" in capsys.readouterr().err


def test_truth_comes_back_from_the_folder(tmp_path: Path) -> None:
    write_scene(make_scene("random-4"), tmp_path, num_train=2, num_eval=1, width=16, height=12, progress=False)
    truth = load_truth(tmp_path)
    assert truth is not None and truth.name == "random-4"
    assert (truth.volume_m3, truth.area_m2) == (random_scene(4).volume_m3, random_scene(4).area_m2)


# Volume [m3], area [m2], height of the first camera [m], temperature at the first of the surface points [C].
PINNED = {
    0: (351.011704, 558.930277, 5.6973, -6.21955596),
    1: (1.14495714, 17.8918927, 1.1287, 21.0535107),
    2: (2.5596005, 38.9510598, 1.25, 33.8749463),
    3: (1517.96143, 1939.57443, 9.4583, 17.940837),
    4: (107.433034, 276.630761, 4.3663, -4.86352921),
}


@pytest.mark.parametrize("seed", ONE_OF_EACH)
def test_a_seed_means_the_same_scene_on_every_machine(seed: int) -> None:
    scene = random_scene(seed)
    height = scene.poses(42, 6)[0][0][2, 3]
    temperature = scene.surface_temperature_c(scene.surface_points(10)[0])[0]
    assert (scene.volume_m3, scene.area_m2, height, temperature) == pytest.approx(PINNED[seed], rel=1e-6)


def test_ten_seeds_show_every_family_twice_and_no_scene_twice() -> None:
    scenes = [random_scene(seed) for seed in range(10)]
    assert len({scene.volume_m3 for scene in scenes}) == len({scene.focal_share for scene in scenes}) == 10
    has_round = [isinstance(scene.solid, SolidUnion) for scene in scenes]
    assert has_round == [family.name in ("machinery", "pipes and radiators") for family in FAMILIES] * 2


@pytest.mark.parametrize("seed", MANY)
def test_every_seed_makes_a_scene_that_lies_in_its_box_with_room_around_it(seed: int) -> None:
    scene = make_scene(f"random-{seed}")
    (lo, hi), (solid_lo, solid_hi) = np.array(scene.scene_box), np.array(scene.solid.bounds)
    voxel = size(scene) / 64
    assert (solid_lo - lo >= 2 * voxel).all() and (hi - solid_hi >= 2 * voxel).all()
    assert (solid_hi - solid_lo).max() > 0.9 * size(scene)
    points, normals = scene.surface_points(2000, seed=3)
    assert np.abs(scene.signed_distance(points)).max() < 1e-12 * size(scene)
    assert not scene.contains(points + 1e-6 * size(scene) * normals).any()
    assert scene.contains(points - 1e-6 * size(scene) * normals).all()


@pytest.mark.parametrize("seed", MANY)
def test_every_camera_stands_outside_and_has_the_scene_in_half_of_its_picture(seed: int) -> None:
    scene = make_scene(f"random-{seed}")
    camera, points = scene.camera(320, 240), scene.surface_points(2000)[0]
    poses = np.concatenate(scene.poses(42, 6))
    assert scene.signed_distance(poses[:, :3, 3]).min() > 0.3 * size(scene) and poses[:, 2, 3].min() > 0.0
    shares = []
    for pose in poses:
        pixel = camera.project_world(pose, points)
        inside = camera.contains(pixel)
        assert inside.all()
        shares.append(np.prod(np.ptp(pixel, axis=0)) / (320 * 240))
    assert np.mean(shares) > 0.4 and min(shares) > 0.2


@pytest.mark.parametrize("seed", range(20, 35))
def test_wild_scenes_stand_free_before_each_kind_of_surroundings_and_fill_the_picture(seed: int) -> None:
    scene = make_scene(f"wild-{seed}")
    camera, points = scene.camera(320, 240), scene.surface_points(1000)[0]
    poses = np.concatenate(scene.poses(42, 6))
    assert scene.signed_distance(poses[:, :3, 3]).min() > 0.3 * size(scene)
    assert all(camera.contains(camera.project_world(pose, points)).all() for pose in poses)
    inside = np.random.default_rng(1).uniform(*scene.solid.bounds, (2000, 3))
    if scene.around is not None:
        assert min(scene.around.solid.signed_distance(at).min() for at in (poses[:, :3, 3], inside)) > 0.0
    sky = scene.background_rgb([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    kind = "around" if scene.around else "plain" if (sky[0] == sky[1]).all() else "smooth"
    assert kind == ("smooth", "plain", "around")[seed % 3]
    points, normals = scene.surface_points(2000)
    assert scene.colour(points, normals).std(axis=0).max() > 0.05


def test_wild_scenes_have_plain_walls_mirrors_and_railings_and_random_ones_have_not() -> None:
    plain, mirrors, thinnest = [], [], []
    for seed in range(20, 40):
        scene = make_scene(f"wild-{seed}")
        mirrors.append(scene.mirror is not None)
        lo, hi = boxes_of(scene).filled_boxes
        thinnest.append(127 / size(scene) * (hi - lo).min(axis=1).min())
        wall = Plan(np.random.default_rng(0), plain_walls=seed % 2 == 0)
        plain.append(wall.paints[wall.paint("wall")].contrast == 0.0)
    assert 3 <= sum(mirrors) <= 14 and plain == [True, False] * 10
    assert make_scene("random-20").mirror is None and not np.isclose(
        make_scene("wild-20").volume_m3, random_scene(20).volume_m3
    )


@pytest.mark.parametrize("seed", MANY)
def test_nothing_is_thinner_or_closer_than_three_voxels_of_128(seed: int) -> None:
    scene = make_scene(f"random-{seed}")
    boxes, voxel = boxes_of(scene), size(scene) / 127
    points, normals = boxes.surface_points(2500, seed=2)
    for voxels in np.linspace(0.02, 2.99, 12):
        assert boxes.contains(points - voxels * voxel * normals).all()
        assert not boxes.contains(points + voxels * voxel * normals).any()


@pytest.mark.parametrize(("number", "seed"), list(itertools.product((1, 2), range(4))))
def test_round_things_keep_their_distance_or_rest_on_something(number: int, seed: int) -> None:
    plan = laid_out(number, seed)
    boxes = [piece.shape for piece in plan.pieces if isinstance(piece.shape, tuple)]
    things = [piece.shape for piece in plan.pieces if not isinstance(piece.shape, tuple)]
    assert len(things) >= 3
    assert all(2.0 * thing.radius > SMALLEST for thing in things)
    for thing in things:
        points = thing.surface_points(20_000, seed=1)[0]
        gaps = np.array([distance_to_box(points, *box).min() for box in boxes])
        resting = gaps < _CONTACT
        assert resting.any() and (gaps[~resting] > SMALLEST - _CONTACT).all()
        assert all(other.signed_distance(points).min() > SMALLEST for other in things if other is not thing)


@pytest.mark.parametrize(("number", "seed"), list(itertools.product(ONE_OF_EACH, range(4))))
def test_boxes_touch_each_other_from_the_ground_up(number: int, seed: int) -> None:
    boxes = np.array([piece.shape for piece in laid_out(number, seed).pieces if isinstance(piece.shape, tuple)])
    lo, hi = boxes[:, 0], boxes[:, 1]
    meet = np.all((lo[:, None] <= hi[None] + 1e-9) & (lo[None] <= hi[:, None] + 1e-9), axis=2)
    reached = np.zeros(len(boxes), dtype=bool)
    reached[0] = True
    for _ in boxes:
        reached = meet[reached].any(axis=0)
    assert reached.all() and (hi - lo).max() <= WIDEST and np.ptp(boxes.reshape(-1, 3), axis=0).max() <= WIDEST


@pytest.mark.parametrize("seed", range(10))
def test_temperatures_fill_their_bounds_and_are_continuous(seed: int) -> None:
    scene = make_scene(f"random-{seed}")
    lowest, highest = scene.temperature_bounds_c
    points, normals = scene.surface_points(20_000, seed=5)
    surface = scene.surface_temperature_c(points)
    directions = np.random.default_rng(0).standard_normal((3000, 3))
    directions = np.concatenate([directions / np.linalg.norm(directions, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    behind = scene.background_temperature_c(directions)
    both = np.concatenate([surface, behind])
    assert 15.0 <= highest - lowest <= 60.0
    assert lowest <= both.min() and both.max() <= highest and np.ptp(both) > 0.9 * (highest - lowest)
    along = np.cross(normals, [0.31, 0.55, 0.77])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    beside = scene.surface_temperature_c(points + 0.01 * size(scene) / 127 * along)
    assert np.abs(beside - surface).max() < 0.02 * (highest - lowest)


@pytest.mark.parametrize("seed", range(10))
def test_paints_go_from_textured_to_plain_and_tell_pieces_apart(seed: int) -> None:
    scene = make_scene(f"random-{seed}")
    points, normals = scene.surface_points(4000, seed=6)
    colour = scene.colour(points, normals)
    assert colour.shape == (4000, 3) and colour.min() >= 0.0 and colour.max() <= 1.0 and colour.std() > 0.05
    contrasts = [paint.contrast for paint in laid_out(seed % len(FAMILIES), seed).paints]
    assert len(contrasts) >= 5 and min(contrasts) >= 0.08 and max(contrasts) <= 0.35 and np.ptp(contrasts) > 0.05


def test_a_pane_has_its_own_paint_and_its_warmth() -> None:
    plan = Plan(np.random.default_rng(0))
    wall, glass = plan.paint("wall"), plan.paint("glass")
    plan.put(((0.0, 0.0, 0.0), (40.0, 20.0, 30.0)), wall, 0.2)
    plan.recess((1, -1, 0.0), (10.0, 18.0), (8.0, 20.0), 4.0, glass, 0.9)
    solid = plan.solid()
    assert solid.volume == pytest.approx(40 * 20 * 30 - 8 * 12 * 4)
    on_pane, beside = [[14.0, 4.0, 14.0]], [[4.0, 0.0, 4.0]]
    towards = [[0.0, -1.0, 0.0]]
    assert solid.signed_distance(on_pane)[0] == 0.0
    assert plan.part(on_pane, towards)[0] == glass and plan.part(beside, towards)[0] == wall
    assert plan.warmth(on_pane)[0] == pytest.approx(0.9) and plan.warmth(beside)[0] < 0.4


def test_a_plan_in_another_unit_is_the_same_plan() -> None:
    plan = laid_out(1, 5)
    larger = plan.scaled(2.5)
    assert larger.solid().volume == pytest.approx(2.5**3 * plan.solid().volume)
    points, normals = plan.solid().surface_points(3000, seed=1)
    np.testing.assert_allclose(larger.warmth(2.5 * points), plan.warmth(points), atol=1e-12)
    assert (larger.part(2.5 * points, normals) == plan.part(points, normals)).mean() > 0.999


def test_pieces_that_touch_pass_their_warmth_on() -> None:
    plan = Plan(np.random.default_rng(0))
    for x, warmth in ((0.0, 0.0), (10.0, 1.0)):
        plan.put(((x, 0.0, 0.0), (x + 10.0, 10.0, 10.0)), plan.paint("stone"), warmth)
    plan.pieces[:] = [dataclasses.replace(piece, slope=np.zeros(3)) for piece in plan.pieces]
    warmth = plan.warmth([[1.0, 0.0, 5.0], [10.0, 0.0, 5.0], [19.0, 0.0, 5.0]])
    # Nine voxels from the contact the other's share is exp(-9 / 2) of the own one.
    far = math.exp(-4.5) / (1.0 + math.exp(-4.5))
    np.testing.assert_allclose(warmth, [far, 0.5, 1.0 - far])


@pytest.mark.parametrize("seed", ONE_OF_EACH)
def test_most_of_what_can_be_seen_is_seen_by_three_cameras(seed: int) -> None:
    scene = make_scene(f"random-{seed}")
    points, normals = scene.surface_points(3000)
    seen = visible_surface_points(scene, scene.poses(42, 6)[0], scene.camera(320, 240), points, normals)
    if FAMILIES[seed].arc_deg is None:
        assert seen[normals[:, 2] > -0.5].mean() > 0.9
    else:
        assert seen[normals[:, 1] < -0.5].mean() > 0.95 and not seen[normals[:, 1] > 0.5].any()
