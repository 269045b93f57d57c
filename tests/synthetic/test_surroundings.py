import dataclasses

import numpy as np
import pytest

from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.camera_rings import CameraWalk, look_at, ring_poses
from thermoxels_ns.synthetic.catalogue import DEVELOPMENT_NAMES, make_scene
from thermoxels_ns.synthetic.raycast import render_view, visible_surface_points

ALL = (*DEVELOPMENT_NAMES, "house-corner+street", "hot-object+room")


def test_names_say_what_stands_behind() -> None:
    scene = make_scene("house-corner+sky=0.55,0.57,0.60+street")
    assert scene.name == "house-corner+sky=0.55,0.57,0.60+street" and scene.around is not None
    np.testing.assert_allclose(scene.background_rgb(np.eye(3)), [[0.55, 0.57, 0.60]] * 3, atol=1e-6)
    plain = make_scene("house-corner")
    assert scene.area_m2 == plain.area_m2 and plain.around is None
    np.testing.assert_array_equal(scene.background_temperature_c(np.eye(3)), plain.background_temperature_c(np.eye(3)))
    white = make_scene("house-corner+white")
    assert white.colour([[-2.8, -2.5, 0.5], [2.8, -2.5, 0.5]], [[0, -1, 0]] * 2).std(axis=0).max() == 0.0


@pytest.mark.parametrize(
    "name", ["sphere+", "sphere+moon", "sphere+sky=1,1", "sphere+sky=1,1,2", "sphere+street+room", "pipes+white"]
)
def test_other_variants_are_refused_with_those_there_are(name: str) -> None:
    with pytest.raises(SceneError, match=r"\+sky=R,G,B, \+white, \+street, \+room"):
        make_scene(name)


@pytest.mark.parametrize("name", ALL)
def test_cameras_stand_outside_of_everything_and_surroundings_reach_no_farther_than_the_body(name: str) -> None:
    scene = make_scene(name)
    lo, hi = np.array(scene.scene_box)
    eyes = np.concatenate(scene.poses(42, 6))[:, :3, 3]
    assert scene.signed_distance(eyes).min() > 0.3 * (hi - lo).max()
    inside = np.random.default_rng(0).uniform(*scene.solid.bounds, (4000, 3))
    if scene.around is not None:
        assert min(scene.around.solid.signed_distance(at).min() for at in (eyes, inside)) > 0.0
    lowest, highest = scene.temperature_bounds_c
    view = render_view(scene, scene.poses(3, 0)[0][1], scene.camera(64, 48))
    assert lowest <= view.temperature_c.min() and view.temperature_c.max() <= highest
    assert 0.15 < view.hit.mean() < 0.95 and view.rgb.std() > 0.05


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
        around=dataclasses.replace(
            scene.around, solid=dataclasses.replace(scene.around.solid, boxes=(((-9.0, -1.0, -9.0), (9.0, -0.9, 9.0)),))
        ),
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
