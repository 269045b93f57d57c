import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.unreadable import contents
from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.synthetic import scene_folder
from thermoxels_ns.synthetic.imperfections import DrawnFlaws, Imperfections
from thermoxels_ns.synthetic.raycast import render_view
from thermoxels_ns.synthetic.scene_folder import load_truth, make_scene, write_scene

SMALL = {"num_train": 3, "num_eval": 2, "width": 40, "height": 30, "progress": False}


def transforms(folder: Path) -> dict:
    return json.loads((folder / "transforms.json").read_text())


def png_to_celsius(folder: Path, frame: dict) -> np.ndarray:
    bounds = json.loads((folder / "temperature_bounds.json").read_text())
    lowest, highest = bounds["absolute_min_temperature"], bounds["absolute_max_temperature"]
    counts = np.asarray(Image.open(folder / frame["thermal_file_path"])).astype(np.float64)
    return lowest + counts / 65535 * (highest - lowest)


def test_layout_is_that_of_thermoscenes(tmp_path: Path) -> None:
    scene = make_scene("hot-object")
    assert write_scene(scene, tmp_path / "made" / "here", **SMALL) == tmp_path / "made" / "here"
    folder = tmp_path / "made" / "here"
    names = [f"frame_{kind}_{n:05d}" for kind, count in (("train", 3), ("eval", 2)) for n in range(1, count + 1)]
    assert set(contents(folder)) == {
        *("transforms.json", "temperature_bounds.json", "truth.json"),
        *(f"images/{name}.jpg" for name in names),
        *(f"thermal/{name}.png" for name in names),
    }
    content = transforms(folder)
    assert (content["w"], content["h"], content["camera_model"]) == (40, 30, "OPENCV")
    assert [content[k] for k in ("k1", "k2", "p1", "p2")] == [0.0] * 4
    assert [content[k] for k in ("fl_x", "fl_y", "cx", "cy")] == [40.0, 40.0, 20.0, 15.0]
    assert not {"scene_box", "truth"} & set(content)  # nothing that photographs do not show
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["synthetic_scene"] == "hot-object" and truth["scene_box"] == [list(c) for c in scene.scene_box]
    assert (content["metres_per_unit"], content["up"]) == (1.0, [0, 0, 1])
    assert [f["file_path"] for f in content["frames"]] == [f"images/{n}.jpg" for n in names]
    assert [f["thermal_file_path"] for f in content["frames"]] == [f"thermal/{n}.png" for n in names]
    assert "thermal_camera" not in content and "thermal_unit" not in content
    train, held_out = scene.poses(3, 2)
    np.testing.assert_array_equal([f["transform_matrix"] for f in content["frames"]], [*train, *held_out])


@pytest.mark.parametrize(
    ("layout", "name", "within_k", "own"),
    [
        ("thermoscenes", "house-corner", 1e-3, False),
        ("nerfstudio", "sphere", 2e-6, False),
        ("thermoscenes", "hot-object", 1e-3, True),
    ],
)
def test_files_hold_the_pictures_that_the_scene_shows(tmp_path, layout, name, within_k, own) -> None:
    scene = make_scene(name)
    write_scene(scene, tmp_path, photo_format="png", layout=layout, own_thermal_camera=own, **SMALL)
    content, camera = transforms(tmp_path), scene.camera(40, 30)
    if own:
        thermal = content["thermal_camera"]
        assert set(thermal) == {"camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"}
        assert (thermal["w"], thermal["h"]) == (20, 16) and thermal["cx"] != 10.0 and "thermal_unit" not in content
        camera = replace(scene.camera(20, 16), **{k: thermal[k] for k in ("fl_x", "fl_y", "cx", "cy")})
        offsets = np.linalg.inv([frame["transform_matrix"] for frame in content["frames"]])
        offsets = offsets @ np.array([frame["thermal_transform_matrix"] for frame in content["frames"]])
        np.testing.assert_allclose(offsets, np.broadcast_to(offsets[0], (5, 4, 4)), atol=1e-12)
        np.testing.assert_allclose(offsets[0][:3, :3] @ offsets[0][:3, :3].T, np.eye(3), atol=1e-12)
        assert 0.005 < np.linalg.norm(offsets[0][:3, 3]) < 0.1
    for frame in content["frames"]:
        pose = np.array(frame["transform_matrix"])
        if layout == "nerfstudio":
            celsius = np.load(tmp_path / "thermal" / f"{Path(frame['file_path']).stem}.npy")
        else:
            celsius = png_to_celsius(tmp_path, frame)
        seen = render_view(scene, np.array(frame.get("thermal_transform_matrix", pose)), camera)
        assert np.abs(celsius - seen.temperature_c).max() < within_k
        rgb = np.asarray(Image.open(tmp_path / frame["file_path"])) / 255.0
        np.testing.assert_allclose(rgb, render_view(scene, pose, scene.camera(40, 30)).rgb, atol=0.5 / 255.0 + 1e-6)


def test_noise_and_drift_have_the_size_asked_for_and_are_not_clipped(tmp_path: Path) -> None:
    scene = make_scene("sphere")
    flaws = Imperfections(noise_k=0.5, drift_k=2.0)
    write_scene(scene, tmp_path, **{**SMALL, "num_train": 8, "num_eval": 0}, imperfections=flaws, seed=3)
    content = transforms(tmp_path)
    drifts = json.loads((tmp_path / "truth.json").read_text())["drift_k"]
    assert 0.8 < np.std(drifts) < 4.0
    for frame, drift in zip(content["frames"], drifts):
        view = render_view(scene, np.array(frame["transform_matrix"]), scene.camera(40, 30))
        error = png_to_celsius(tmp_path, frame) - view.temperature_c
        assert error.mean() == pytest.approx(drift, abs=0.06)
        assert error.std() == pytest.approx(0.5, rel=0.1)
        counts = np.asarray(Image.open(tmp_path / frame["thermal_file_path"]))
        assert counts.min() > 0 and counts.max() < 65535


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        flaws = Imperfections(noise_k=0.1, drift_k=0.1)
        write_scene(make_scene("sphere"), tmp_path / name, imperfections=flaws, seed=seed, **SMALL)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert contents(tmp_path / "a") != contents(tmp_path / "c")


@pytest.mark.parametrize("text", ['{"synthetic_scene": "castle"}', '{"seed": 1}', '{"synthetic_scene": ', "[1, 2]"])
def test_bad_truth_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "truth.json").write_text(text)
    with pytest.raises(SceneError):
        load_truth(tmp_path)


def test_real_photographs_have_no_truth_and_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    assert load_truth(tmp_path) is None
    with pytest.raises(SceneError):
        write_scene(make_scene("sphere"), tmp_path, **SMALL)
    assert (tmp_path / "transforms.json").read_text() == '{"frames": []}'


def test_no_file_outside_the_folder_is_ever_looked_at(tmp_path: Path, monkeypatch) -> None:
    """A layout without a model of COLMAP once named its files from the root of the disk, and they were removed."""
    removed: list[Path] = []
    monkeypatch.setattr(scene_folder, "remove_file", removed.append)
    exists = Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: removed.append(path) or exists(path))
    for _ in range(2):
        write_scene(make_scene("sphere"), tmp_path / "scene", **SMALL)
    assert removed and all(path.is_relative_to(tmp_path) for path in removed)


def test_nothing_stale_stays_of_an_older_scene_not_even_of_an_interrupted_write(tmp_path: Path) -> None:
    scene = make_scene("sphere")
    write_scene(scene, tmp_path, layout="nerfstudio", **{**SMALL, "num_train": 5})
    (tmp_path / "images" / "mine.png").write_text("mine")

    def broken(points: np.ndarray) -> np.ndarray:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_scene(replace(scene, surface_temperature_c=broken), tmp_path, **SMALL)
    assert not (tmp_path / "transforms.json").exists()
    assert not [p for p in tmp_path.rglob("*") if ".part" in p.name]
    write_scene(scene, tmp_path, **SMALL)
    listed = {f[key] for f in transforms(tmp_path)["frames"] for key in ("file_path", "thermal_file_path")}
    ours = {"transforms.json", "temperature_bounds.json", "truth.json"}
    assert set(contents(tmp_path)) == {*listed, *ours, "images/mine.png"} and len(listed) == 10


@pytest.mark.parametrize(
    ("options", "field"),
    [({"num_train": 0}, "number of views"), ({"width": 0}, "^width: "), ({"height": 1_000_000}, "^height: ")],
)
def test_bad_options_say_what_is_wrong_and_write_nothing(tmp_path: Path, options: dict, field: str) -> None:
    with pytest.raises(ThermoxelsError, match=field):
        write_scene(make_scene("sphere"), tmp_path / "new", **{**SMALL, **options})
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", [field.name for field in fields(Imperfections)])
def test_impossible_imperfections_are_refused_by_name(name: str) -> None:
    with pytest.raises(ThermoxelsError, match=name):
        Imperfections(**{name: np.nan})


SHAPE = (60, 80)
POSES = np.stack([np.eye(4)] * 200)
POSES[:, 2, 3] = 5.0


def drawn(**flaws) -> DrawnFlaws:
    return DrawnFlaws(Imperfections(**flaws), 0, POSES, (0.0, 0.0, 0.0))


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


def test_noise_of_photographs_changes_photographs_alone():
    flaws, warm = drawn(noise_counts=2.0), np.full(SHAPE, 20.0)
    seen = np.random.default_rng(0).uniform(0.2, 0.6, (*SHAPE, 3)).astype(np.float32)
    assert np.abs(flaws.photograph(0, seen) - 255.0 * seen).mean() > 1.0
    np.testing.assert_array_equal(flaws.thermogram(0, warm), warm)


def test_who_walks_by_is_in_the_same_place_of_both_images():
    flaws = drawn(passers_by=1.0)
    dark = flaws.photograph(0, np.full((*SHAPE, 3), 0.5, np.float32))[..., 0] < 60
    assert 0.03 < dark.mean() < 0.3
    np.testing.assert_array_equal(flaws.thermogram(0, np.full(SHAPE, 20.0)) > 25.0, dark)


def test_the_folder_gives_wrong_poses_and_tells_the_truth(tmp_path: Path):
    scene, flaws = make_scene("sphere"), Imperfections(pose_error_deg=1.0, focal_error=0.01)
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
