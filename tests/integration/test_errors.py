"""Bad input through the real commands: one clear sentence and a non-zero exit, no traceback of ours."""

import json
import shutil
from pathlib import Path

import pytest
import yaml
from nerfstudio.configs.method_configs import all_methods

from tests.integration.commands import SHORT_TRAINING, Trained, fail


def lose_partner(scene: Path) -> None:
    next((scene / "thermal").glob("frame_train_00003*")).unlink()


def corrupt_image(scene: Path) -> None:
    path = next((scene / "images").glob("frame_train_00002*"))
    path.write_bytes(path.read_bytes()[:400])


@pytest.mark.parametrize("damage, word", [(lose_partner, "frame_train_00003"), (corrupt_image, "frame_train_00002")])
def test_damaged_scene(tiny_scene, tmp_path, damage, word):
    """What else may be wrong with a scene is tested without a command, in tests/data."""
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    damage(scene)
    said = fail(
        *("ns-train", "thermoxels", "--output-dir", str(tmp_path / "out"), *SHORT_TRAINING),
        *("thermal-data", "--data", str(scene)),
    )
    assert "expected" in said and word in said


def export(config: Path, output: Path, *options: str) -> str:
    return fail(
        *("ns-export", "thermoxels-mesh", "--load-config", str(config), "--output-dir", str(output)),
        *("--metres-per-unit", "1", "--pictures", "False", *options),
    )


def test_an_export_of_nothing_or_into_a_file(trained: Trained, tmp_path):
    assert "solid voxels: expected" in export(trained.config, tmp_path, "--density-threshold", "1e9")
    assert not (tmp_path / "mesh.vtu").exists()
    (tmp_path / "file").write_text("in the way")
    assert "output folder: expected" in export(trained.config, tmp_path / "file" / "export")


def test_checkpoint_of_another_method(trained: Trained, thermal_trained: Trained, tmp_path):
    """The config of the thermal baseline beside a checkpoint of thermoxels."""
    folder = tmp_path / "run"
    shutil.copytree(thermal_trained.run_folder, folder)
    shutil.copy(trained.checkpoints / "step-000000039.ckpt", folder / "nerfstudio_models")
    assert "checkpoint: expected a voxel grid" in export(folder / "config.yml", tmp_path / "export")
    evaluate = ("ns-eval", "--load-config", str(folder / "config.yml"), "--output-path", str(tmp_path / "e.json"))
    assert "Error: checkpoint:" in fail(*evaluate)


def test_poses_that_changed_since_the_training(trained: Trained, tmp_path):
    """The box is the one that the run keeps: it does not tell that a camera was moved."""
    scene = trained.scene / "transforms.json"
    known = scene.read_text()
    content = json.loads(known)
    moved = next(frame for frame in content["frames"] if "train" in frame["file_path"])
    moved["transform_matrix"][0][3] += 0.05
    try:
        scene.write_text(json.dumps(content))
        said = export(trained.config, tmp_path / "export")
    finally:
        scene.write_text(known)
    assert "poses and scene box: expected" in said


def test_config_of_a_stock_method(tmp_path):
    """nerfacto's config: a method without a voxel grid is named before anything is loaded."""
    config = tmp_path / "config.yml"
    config.write_text(yaml.dump(all_methods["nerfacto"]))
    assert "nerfacto" in export(config, tmp_path / "export")
