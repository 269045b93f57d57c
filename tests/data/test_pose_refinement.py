"""Poses that the photographs of a scene contradict, from files to the dataset."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.data.dataparser import ThermalDataParserConfig, refine_poses
from thermoxels_ns.data.dataset import ThermalDataset
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.multiview.bundle_adjustment import Tracks, _distances
from thermoxels_ns.synthetic.imperfections import Imperfections
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

VIEWS = (16, 3)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("scenes")
    off = Imperfections(pose_error_deg=0.3)
    options = {"own_thermal_camera": True, "progress": False}
    return {
        name: write_scene(make_scene("house-corner"), folder / name, *VIEWS, imperfections=flaws, **options)
        for name, flaws in (("right", Imperfections()), ("off", off))
    }


def split(folder: Path):
    scene = read_scene_file(folder)
    training = [n for n, frame in enumerate(scene.frames) if "frame_train" in frame.name]
    true = json.loads((folder / "truth.json").read_text())["poses"]
    names = [frame["file_path"] for frame in json.loads((folder / "transforms.json").read_text())["frames"]]
    return scene, training, np.array([true[names.index(frame.name)] for frame in scene.frames])


def pixels_off(poses: np.ndarray, true: np.ndarray, focal: float) -> float:
    """Median distance between exact sightings of points in the scene's middle and these points, triangulated."""
    draw = np.random.default_rng(0)
    points = draw.uniform((-2, -2, 0.5), (2, 2, 4), (300, 3))
    photograph = np.tile(np.arange(len(true)), len(points))
    point = np.repeat(np.arange(len(points)), len(true))
    local = np.einsum("nji,nj->ni", true[photograph][:, :3, :3], points[point] - true[photograph, :3, 3])
    place = local[:, :2] * (1.0, -1.0) / -local[:, 2:]
    return float(np.median(_distances(Tracks(photograph, point, place), poses, np.full(len(true), focal))))


@pytest.fixture(scope="module")
def refined(scenes):
    """What is made of poses that are off, and what is said."""
    said: list[str] = []
    scene, training, _ = split(scenes["off"])
    return *refine_poses(scene, training, said.append), said


def test_poses_that_are_off_are_adjusted_and_said(scenes, refined):
    scene, training, true = split(scenes["off"])
    found, fitted, said = refined
    before, after = (np.stack([each.frames[n].pose for n in training]) for each in (scene, found))
    focal = scene.frames[0].intrinsics.fl_x
    assert pixels_off(after, true[training], focal) < 0.35 * pixels_off(before, true[training], focal)
    assert len(said) == 1 and "--refine-poses given" in said[0]
    held_out = sorted(set(range(len(scene.frames))) - set(training))
    for number in held_out:  # they judge, and are not touched
        np.testing.assert_array_equal(found.frames[number].pose, scene.frames[number].pose)
    assert sorted(fitted) == held_out
    every = np.stack([fitted.get(n, found.frames[n].pose) for n in range(len(scene.frames))])
    given = np.stack([frame.pose for frame in found.frames])
    assert pixels_off(every, true, focal) < pixels_off(given, true, focal)
    rigs = [
        np.stack([np.linalg.inv(frame.pose) @ frame.thermal_pose for frame in each.frames]) for each in (scene, found)
    ]
    np.testing.assert_allclose(rigs[1], rigs[0], atol=1e-9)  # thermal cameras follow their photographs


def test_poses_that_fit_stay(scenes):
    said: list[str] = []
    scene, training, _ = split(scenes["right"])
    found, fitted = refine_poses(scene, training, said.append)
    assert found is scene and not fitted and said[0].startswith("poses: kept")


def test_held_out_photographs_change_nothing_in_training(scenes, refined):
    scene, training, _ = split(scenes["off"])
    every = refined[0]
    for number in set(range(len(scene.frames))) - set(training):
        scene.frames[number] = scene.frames[training[0]]  # other photographs in their places
    again, _ = refine_poses(scene, training, lambda _: None)
    for number in training:
        np.testing.assert_array_equal(again.frames[number].pose, every.frames[number].pose)


def test_the_parser_gives_adjusted_poses_and_those_that_held_out_photographs_say(scenes):
    given, auto = (
        ThermalDataParserConfig(data=scenes["off"], refine_poses=source).setup() for source in ("given", "auto")
    )
    plain, moved = (parser.get_dataparser_outputs("train") for parser in (given, auto))
    assert np.abs(np.asarray(plain.cameras.camera_to_worlds - moved.cameras.camera_to_worlds)).max() > 1e-3
    assert given.get_dataparser_outputs("val").metadata["fitted_poses"] is None
    held_out = auto.get_dataparser_outputs("val")
    assert held_out.metadata["fitted_poses"].shape == (VIEWS[1], 3, 4)
    item = ThermalDataset(held_out).get_data(1)
    np.testing.assert_allclose(
        item["fitted_camera"].camera_to_worlds[0], held_out.metadata["fitted_poses"][1], atol=1e-6
    )
    rig = [
        np.linalg.inv(np.vstack((one.camera_to_worlds[0], [0, 0, 0, 1])))
        @ np.vstack((two.camera_to_worlds[0], [0, 0, 0, 1]))
        for one, two in (
            (ThermalDataset(held_out).cameras[1:2], item["thermal_camera"]),
            (item["fitted_camera"], item["fitted_thermal_camera"]),
        )
    ]
    np.testing.assert_allclose(rig[1], rig[0], atol=1e-5)


def test_masked_features_move_no_pose(scenes, tmp_path):
    Image.new("L", (32, 24)).save(tmp_path / "nothing.png")
    scene, training, _ = split(scenes["off"])
    scene.frames[:] = [replace(frame, mask=tmp_path / "nothing.png") for frame in scene.frames]
    assert refine_poses(scene, training, lambda _: None) == (scene, {})
