import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.synthetic.imperfections import DrawnFlaws, Imperfections
from thermoxels_ns.synthetic.raycast import render_view
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

SHAPE = (60, 80)
POSES = np.stack([np.eye(4)] * 200)
POSES[:, 2, 3] = 5.0


def drawn(**flaws) -> DrawnFlaws:
    return DrawnFlaws(Imperfections(**flaws), 0, POSES, (0.0, 0.0, 0.0), (10.0, 30.0))


def test_gains_multiply_the_photograph():
    flaws, seen = drawn(exposure_stops=0.3, white_balance=0.03), np.full((*SHAPE, 3), 0.3, np.float32)
    np.testing.assert_allclose(np.log2(flaws.gains.mean(1)).std(), 0.3, rtol=0.15)
    spread = (flaws.gains / flaws.gains.mean(1, keepdims=True)).std()
    np.testing.assert_allclose(spread, 0.03 * np.sqrt(2 / 3), rtol=0.15)
    np.testing.assert_allclose(flaws.photograph(7, seen).mean((0, 1)) / (0.3 * 255.0), flaws.gains[7], rtol=0.01)


def test_poses_are_turned_and_moved_by_as_much_as_asked_for():
    flaws = drawn(pose_error_deg=0.15)
    given = flaws.given_poses()
    cosine = 0.5 * (np.trace(given[:, :3, :3], axis1=1, axis2=2) - 1.0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    np.testing.assert_allclose(np.sqrt(np.mean(angle**2)), np.sqrt(3) * 0.15, rtol=0.1)
    np.testing.assert_allclose((given - POSES)[:, :3, 3].std(), np.deg2rad(0.15) * 5.0, rtol=0.1)
    walk = drawn(pose_error_deg=0.15, pose_correlation=0.95)  # like its neighbours
    assert np.diff(walk.turns_rad, axis=0).std() < 0.5 * np.diff(flaws.turns_rad, axis=0).std()


@pytest.mark.parametrize(
    "flaw",
    [{"vignetting": 0.3}, {"noise_counts": 2.0}, {"motion_blur_px": 3.0}, {"rolling_shutter_px": 4.0}],
)
def test_flaws_of_photographs_change_photographs_alone(flaw):
    flaws, warm = drawn(**flaw), np.full(SHAPE, 20.0)
    seen = np.random.default_rng(0).uniform(0.2, 0.6, (*SHAPE, 3)).astype(np.float32)
    assert np.abs(flaws.photograph(0, seen) - 255.0 * seen).mean() > 1.0
    np.testing.assert_array_equal(flaws.thermogram(0, warm), warm)


def test_who_walks_by_is_in_the_same_place_of_both_images():
    flaws = drawn(passers_by=1.0)
    dark = flaws.photograph(0, np.full((*SHAPE, 3), 0.5, np.float32))[..., 0] < 60
    assert 0.03 < dark.mean() < 0.3
    np.testing.assert_array_equal(flaws.thermogram(0, np.full(SHAPE, 20.0)) > 25.0, dark)


def test_dead_pixels_read_the_same_in_all_images():
    flaws = drawn(dead_pixels=0.01)
    first, second = (flaws.thermogram(n, np.full(SHAPE, value)) for n, value in ((0, 15.0), (1, 25.0)))
    same = first == second
    assert 0.003 < same.mean() < 0.03


@pytest.mark.parametrize("field", [f.name for f in fields(Imperfections)])
def test_what_cannot_be_drawn_is_refused(field):
    with pytest.raises(ThermoxelsError, match=field):
        replace(Imperfections(), **{field: float("nan")}).check()


def test_the_folder_gives_wrong_poses_and_tells_the_truth(tmp_path: Path):
    scene, flaws = make_scene("sphere"), Imperfections(pose_error_deg=1.0, rig_error_deg=1.0, focal_error=0.01)
    write_scene(
        scene, tmp_path, 4, 1, 40, 30, own_thermal_camera=True, imperfections=flaws, photo_format="png", progress=False
    )
    content, truth = (json.loads((tmp_path / name).read_text()) for name in ("transforms.json", "truth.json"))
    poses = np.array(truth["poses"])
    given = np.array([frame["transform_matrix"] for frame in content["frames"]])
    assert 0.003 < np.abs(given - poses)[:, :3, :3].max() < 0.1
    photograph = np.asarray(Image.open(tmp_path / content["frames"][2]["file_path"]))
    view = render_view(scene, poses[2], scene.camera(40, 30))
    np.testing.assert_allclose(photograph, 255.0 * view.rgb, atol=0.51)
    np.testing.assert_allclose(content["fl_x"], 1.01 * scene.camera(40, 30).fl_x)
    rig = np.linalg.inv(given) @ np.array([frame["thermal_transform_matrix"] for frame in content["frames"]])
    np.testing.assert_allclose(rig, np.broadcast_to(rig[0], rig.shape), atol=1e-12)
