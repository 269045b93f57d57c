import json
import re
import shutil
from dataclasses import fields
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import yaml
from nerfstudio.configs.method_configs import all_methods

import thermoxels_ns
from tests.integration.commands import SHORT_TRAINING, Trained, fail, succeed
from tests.support.docs_code import code_in
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.mesh.files.vtu import any_mesh, read_mesh
from thermoxels_ns.synthetic.scene_folder import LayoutName, make_scene, write_scene


def test_the_five_lines_of_the_docs_on_a_run_that_was_moved(trained: Trained, tmp_path, monkeypatch):
    """Run and photographs are elsewhere, the path in config.yml is that of no folder; commands and Python agree."""
    run = tmp_path / "outputs" / "house" / "thermoxels" / "run"
    shutil.copytree(trained.run_folder, run)
    written = (run / "config.yml").read_text()
    from_run = re.search(r"^scene_from_run: (.*)$", written, re.MULTILINE)[1]
    (run / "config.yml").write_text(written.replace(f"- {trained.scene.parent.name}\n", "- gone\n"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(thermoxels_ns.ThermoxelsError, match=re.escape(f"{trained.scene.name}, or at {from_run}")):
        thermoxels_ns.load(run)
    shutil.copytree(trained.scene, run / from_run)
    shutil.copy(configs_folder() / "conditions-example.yaml", "conditions.yaml")

    names: dict = {}
    five = code_in("python.md")[0].replace('interior="hollow"', 'interior="hollow", density_percentile=90.0')
    exec(five, names)
    scene, heat, found = names["scene"], names["heat"], names["found"]
    assert scene.trained.scene_folder.samefile(run / from_run) and scene.metres_per_unit == 1.0
    assert scene.points.shape == (*scene.temperature_c.shape, 3) == (*scene.density.shape, 3)
    assert np.linalg.norm(scene.points[1, 1, 1] - scene.points[0, 1, 1]) == pytest.approx(scene.spacing)
    assert heat.results.balance.into_body > 0.0 and found.whole.loss_w.low < found.whole.loss_w.high
    assert len(repr(scene)) + len(repr(heat)) + len(repr(found)) < 400

    options = ("--density-percentile", "90", "--interior", "hollow", "--pictures", "False")
    where = ("--load-config", str(run / "config.yml"), "--output-dir", str(tmp_path / "export"))
    succeed("ns-export", "thermoxels-mesh", *where, *options)
    ours, theirs = any_mesh(names["mesh"])[0], read_mesh(tmp_path / "export" / "mesh.vtu")
    for field in fields(ours):
        if isinstance(getattr(ours, field.name), np.ndarray):
            assert np.array_equal(getattr(ours, field.name), getattr(theirs, field.name)), field.name
    evaluated = tmp_path / "e.json"
    succeed("ns-eval", "--load-config", str(run / "config.yml"), "--output-path", str(evaluated))
    assert evaluated.is_file()


def test_damaged_scene(tiny_scene, tmp_path):
    """What else may be wrong with a scene is tested without a command, in tests/data."""
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    path = next((scene / "images").glob("frame_train_00002*"))
    path.write_bytes(path.read_bytes()[:400])
    said = fail(
        *("ns-train", "thermoxels", "--output-dir", str(tmp_path / "out"), *SHORT_TRAINING),
        *("thermal-data", "--data", str(scene)),
    )
    assert "expected" in said and "frame_train_00002" in said


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


@pytest.mark.parametrize("layout", sorted({*get_args(LayoutName)} - {"thermoscenes"}))
def test_a_layout_is_trained_evaluated_and_exported(layout, tmp_path):
    scene, folder, warm = make_scene("hot-object"), tmp_path / "scene", layout != "rgb"
    options = {"photo_format": "png", "progress": False, "own_thermal_camera": layout == "thermalnerf"}
    write_scene(scene, folder, 10, 2, 64, 48, layout=layout, **options)
    said = succeed(
        *("ns-train", "thermoxels", "--output-dir", str(tmp_path), "--experiment-name", "tiny", "--timestamp", "run"),
        *(*SHORT_TRAINING, "thermal-data", "--data", str(folder)),
        *("--scene-box", *(str(value) for corner in scene.scene_box for value in corner)),
    )
    assert f"Layout {layout}: " in said
    config, results = str(tmp_path / "tiny" / "thermoxels" / "run" / "config.yml"), tmp_path / "eval.json"
    succeed("ns-eval", "--load-config", config, "--output-path", str(results))
    found = json.loads(results.read_text())["results"]
    assert found["psnr"] > 15 and "fscore" in found
    assert any(name.startswith("thermal") for name in found) == warm
    out = tmp_path / "mesh"
    succeed(
        *("ns-export", "thermoxels-mesh", "--load-config", config, "--output-dir", str(out)),
        *("--metres-per-unit", "1", "--formats", "vtu", "xdmf", "msh", "glb", "--pictures", "False"),
    )
    mesh, summary = read_mesh(out / "mesh.vtu"), json.loads((out / "summary.json").read_text())
    assert mesh.has_temperatures == (summary["mesh"]["temperature_c"] is not None) == warm and mesh.colour is not None
    for suffix in ("glb", "msh", "xdmf"):
        assert (b"temperature_c" in (out / f"mesh.{suffix}").read_bytes().lower()) == warm, suffix
    if warm:
        return
    command = "thermoxels", "heat", str(out / "mesh.vtu"), "--output-dir", str(tmp_path / "heat"), "--scene"
    assert "initial: {temperature_c: 15}" in fail(*command, "concrete")
    own = tmp_path / "own.yaml"
    concrete = (configs_folder() / "scene-concrete.yaml").read_text()
    own.write_text(concrete.replace("initial: photographs", "initial: {temperature_c: 15}"))
    succeed(*command, str(own))
    export = "ns-export", "thermoxels-mesh", "--load-config", config, "--output-dir", str(tmp_path / "inp")
    export = (*export, "--metres-per-unit", "1", "--formats", "inp", "--pictures", "False")
    assert "Leave inp out of --formats" in fail(*export) and not (tmp_path / "inp" / "mesh.inp").exists()
