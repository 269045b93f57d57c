import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.camera_card import photograph
from tests.support.posed_model import CAMERA, ring_model
from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.masks import PhotographMasks
from thermoxels_ns.capture.rig_types import DriftEstimate, RigEstimate
from thermoxels_ns.capture.scene_writer import TRACKS_NAME, Scene, scene_names, write_scene_folder
from thermoxels_ns.capture.sfm.scale_and_up import MetricScale, Up
from thermoxels_ns.capture.stage_cache import prepare_output
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.data.scene_scale import scale_from_scene_file, up_from_scene_file
from thermoxels_ns.data.tracks import read_tracks
from thermoxels_ns.radiometry.thermal_pixels import read_thermal_file

THERMAL = Camera(40, 30, 50.0, 50.0, 20.5, 14.5, k1=0.01)
COUNT = 6


@pytest.fixture
def scene(tmp_path):
    rng = np.random.default_rng(0)
    model = ring_model(COUNT)
    frames = []
    for name in model.frames:
        path = photograph(tmp_path / "card" / f"{name}.jpg", rng.integers(0, 255, (480, 640, 3)).astype(np.uint8))
        temperature_c = rng.uniform(5, 30, (30, 40)).astype(np.float32)
        temperature_c[0, 0] = np.nan
        np.save(tmp_path / f"{name}.npy", temperature_c)
        frames.append(CaptureFrame(name, path, tmp_path / f"{name}.npy", f"{name}.jpg", f"{name}.tiff"))
    rig = np.eye(4)
    rig[:3, :3] = Rotation.from_euler("xyz", [1, -2, 0.5], degrees=True).as_matrix()
    rig[:3, 3] = (0.1, 0.02, -0.01)
    estimate = RigEstimate(THERMAL, rig, True, "Found.", ("rx",), np.eye(1) * 1e-4, 0.1, 0.4, 0.3)
    offsets = np.linspace(-1, 1, COUNT)
    drift = DriftEstimate(offsets, (0.5,), 1.0, 0.1, True, "Corrected.")
    up = Up(np.array([0.0, 0.6, 0.8]), "Measured.", 0.1)
    masks = PhotographMasks((640, 480))
    return Scene(frames, model, estimate, drift, MetricScale(0.5, 0.01, "GPS."), up, masks)


def with_masks(scene):
    overlay = np.ones((480, 640), dtype=bool)
    overlay[:40, :100] = False
    return Scene(**{**scene.__dict__, "masks": PhotographMasks((640, 480), overlay)})


def test_every_eighth_frame_evaluates_and_the_ends_train():
    assert [n for n, name in enumerate(scene_names(40)) if "eval" in name] == [4, 12, 20, 28, 36]
    for count in range(2, 12):
        sides = ["eval" in name for name in scene_names(count)]
        assert sum(sides) == 1 or count > 8
        assert not sides[-1] and len(sides) == count


def test_numbers_come_back_as_they_went_in(scene, tmp_path):
    output = prepare_output(tmp_path / "scene")
    write_scene_folder(scene, output)
    read = read_scene_file(output)
    by_source = {entry["source"]: entry for entry in read.meta["frames"]}
    assert set(by_source) == {f"f{n}.jpg" for n in range(COUNT)}
    for number, frame in enumerate(scene.frames):
        entry = by_source[frame.photograph_source]
        pose = scene.model.camera_to_world[number]
        assert np.array(entry["transform_matrix"]) == pytest.approx(pose)
        # A scene point: x_thermal = rig @ x_visible, both in OpenCV axes.
        point = scene.model.points[:1]
        in_visible = scene.model.in_camera(number, point)
        thermal_pose = np.array(entry["thermal_transform_matrix"])
        in_thermal = (point - thermal_pose[:3, 3]) @ thermal_pose[:3, :3] * (1, -1, -1)
        rig = scene.rig.visible_to_thermal
        assert in_thermal == pytest.approx(in_visible @ rig[:3, :3].T + rig[:3, 3])
        written = read_thermal_file(output / entry["thermal_file_path"], read.unit).temperature_c
        expected = np.load(frame.thermal) - scene.drift.offsets_k[number] - scene.drift.radial_k(40, 30)
        assert np.isnan(written[0, 0]) and np.isnan(written).sum() == 1
        assert written[1:] == pytest.approx(expected[1:], abs=1e-5)
        assert (output / entry["file_path"]).read_bytes() == frame.photograph.read_bytes()
    scale = scale_from_scene_file(read.meta)
    assert scale is not None
    assert (scale.metres_per_unit, scale.standard_error) == (0.5, 0.01)
    assert up_from_scene_file(read.meta) == pytest.approx((0.0, 0.6, 0.8))
    assert read.meta["fl_x"] == CAMERA.fl_x and read.meta["thermal_camera"]["cx"] == THERMAL.cx


def test_tracks_say_which_training_photograph_sees_which_point(scene, tmp_path):
    output = prepare_output(tmp_path / "scene")
    write_scene_folder(scene, output)
    outputs = ThermalDataParserConfig(data=output).setup().get_dataparser_outputs("train")
    tracks = read_tracks(output / TRACKS_NAME)
    assert np.array_equal(tracks.points, scene.model.points)
    assert np.array_equal(tracks.sighting_point, scene.model.sighting_point)
    seen = np.bincount(scene.model.sighting_frame, minlength=COUNT)
    train = [number for number, name in enumerate(tracks.frames) if "train" in name]
    lines = outputs.metadata["feature_rays"]
    assert len(lines.origins) == pytest.approx(seen[train].sum(), rel=0.05)
    assert len(lines.origins) <= seen[train].sum()


def test_an_earlier_scene_is_replaced_and_nothing_else_or_stays_whole(scene, tmp_path, monkeypatch):
    output = prepare_output(tmp_path / "scene")
    write_scene_folder(with_masks(scene), output)
    (output / "notes.txt").write_text("mine")
    write_scene_folder(scene, output)
    assert not (output / "masks").exists()
    assert (output / "notes.txt").read_text() == "mine"
    before = (output / "transforms.json").read_bytes()

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("thermoxels_ns.capture.scene_writer.write_points", stop)
    with pytest.raises(KeyboardInterrupt):
        write_scene_folder(with_masks(scene), output)
    assert (output / "transforms.json").read_bytes() == before
    assert len(read_scene_file(output).frames) == COUNT


def test_the_json_has_no_nan(scene, tmp_path):
    unknown = RigEstimate(THERMAL, np.eye(4), False, "Kept.")
    output = prepare_output(tmp_path / "scene")
    write_scene_folder(Scene(**{**scene.__dict__, "rig": unknown, "scale": None}), output)
    content = json.loads((output / "transforms.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert content["rig_info"]["determined"] is False
    assert "metres_per_unit" not in content
