"""Every layout through the real commands; that of ThermoScenes is the one of most other tests."""

import json
from typing import get_args

import pytest

from tests.integration.commands import SHORT_TRAINING, fail, succeed
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.mesh.files.vtu import read_mesh
from thermoxels_ns.synthetic.scene_folder import LayoutName, make_scene, write_scene


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
