"""Flaws of cameras and a plain backdrop, which a training finds, against their truth."""

import json
from pathlib import Path

import numpy as np

from tests.support.short_training import Training, train
from thermoxels_ns.nerfstudio_bridge import compare_with_truth
from thermoxels_ns.synthetic.imperfections import Imperfections
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

FLAWS = Imperfections(exposure_stops=0.3, white_balance=0.03, noise_counts=2.0, drift_k=1.0, noise_k=0.1)
ASKED = {"photo_depth": "on"}


def scene(folder: Path, flaws: Imperfections, own_thermal_camera: bool = False) -> Path:
    options = {"imperfections": flaws, "own_thermal_camera": own_thermal_camera, "progress": False}
    return write_scene(make_scene("house-corner"), folder / "scene", 16, 2, 240, 180, **options)


def truth_of(folder: Path, key: str, names) -> np.ndarray:
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    values = dict(
        zip((Path(frame["file_path"]).name for frame in frames), json.loads((folder / "truth.json").read_text())[key])
    )
    return np.array([values[name] for name in names])


def agree(folder: Path, found: dict) -> None:
    """Corrections are those of the truth."""
    assert set(found) == {"gains", "thermal_offsets_c"}
    names = list(found["gains"])
    true, seen = np.log(truth_of(folder, "gains", names)), np.log(list(found["gains"].values()))
    assert np.sqrt(np.mean((seen - (true - true.mean(0))) ** 2)) < 0.02
    true, seen = truth_of(folder, "drift_k", names), np.array(list(found["thermal_offsets_c"].values()))
    assert np.sqrt(np.mean((seen - (true - true.mean())) ** 2)) < 0.1


def test_exposure_and_drift_are_found_by_a_thermal_camera_of_its_own(tmp_path):
    folder = scene(tmp_path, FLAWS, own_thermal_camera=True)
    agree(folder, train(folder, 3, ASKED).corrections())


def test_exposure_and_drift_are_found_and_survive_a_checkpoint(tmp_path):
    folder = scene(tmp_path, FLAWS)
    plain = {"resolutions": [16], "refine_at": [], "prune_at": [], "thin_at": []}
    data = {"data": folder, "train_num_rays_per_batch": 512, "thermal_num_rays_per_batch": 512}
    settings = {"cpu_threads": 1, "datamanager": data, "model": plain | ASKED}
    first = Training(settings, 4).advance(2)
    agree(folder, first.pipeline.corrections())
    again = Training(settings, 4, saved=first.save())
    assert again.pipeline.corrections() == first.pipeline.corrections()


def test_nothing_is_corrected_in_a_clean_scene(tmp_path):
    pipeline = train(scene(tmp_path, Imperfections()), 3, ASKED)
    assert pipeline.corrections() == {}
    off = train(tmp_path / "scene", 3, {**ASKED, "exposure": "off", "per_image_offset": "off"})
    own, other = pipeline.state_dict(), off.state_dict()
    for name in set(own) & set(other):
        np.testing.assert_array_equal(own[name].numpy(), other[name].numpy(), err_msg=name)


def test_a_grey_sky_does_not_become_a_grey_cloud(tmp_path):
    """Without what photographs say about it, every image fits, most of the surface is cloud, and F is below 0.6."""
    write_scene(make_scene("house-corner+sky=0.55,0.57,0.60"), tmp_path, 20, 1, width=128, height=96, progress=False)
    path = tmp_path / "transforms.json"
    wide = {"scene_box": [[-6.7, -8.0, -5.3], [7.7, 6.4, 9.1]]}
    path.write_text(json.dumps(json.loads(path.read_text()) | wide))
    course = {"resolutions": [16, 32], "refine_at": [120], "prune_at": [220], "photo_depth": "on"}
    assert compare_with_truth(train(tmp_path, 300, course, rays=1024))["fscore"] > 0.95
