import json
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import pyvista
import torch
from PIL import Image

from tests.integration.commands import SHORT_TRAINING, Trained, fail, run, started, succeed
from tests.support.audited_wall import STATED, audited_wall, photographed, solve_wall, true_draws
from tests.support.heat_bodies import room
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.mesh.files.formats import write_mesh

METRICS = (
    *("psnr", "psnr_8", "ssim", "thermal_psnr", "thermal_ssim", "thermal_hssim"),
    *("thermal_mae_c", "thermal_mae_hit_c", "thermal_mae_roi_c", "thermal_mae_debiased_c"),
    *("psnr_box", "thermal_mae_box_c", "half_transparent", "fscore", "precision", "recall", "fscore_128"),
    *("depth_error", "depth_off_share", "sky_filled"),
)


def test_training_reports_evaluation_batches(trained: Trained, tmp_path):
    """nerfstudio's own evaluation during training, which is off by default."""
    said = succeed(
        *("ns-train", "thermoxels", "--output-dir", str(tmp_path), *SHORT_TRAINING, "--max-num-iterations", "3"),
        *("--steps-per-eval-batch", "1", "--steps-per-eval-image", "2", "thermal-data", "--data", str(trained.scene)),
    )
    assert "the run ends before step 3: no refinement or pruning at 15, 30, 35" in said


def test_a_training_says_little_and_nothing_that_a_user_cannot_act_on(trained: Trained):
    lines = trained.log.splitlines()
    warned = [line for line in lines if "Warning" in line]
    assert all("torch.jit.script" in line for line in warned)  # before nerfstudio loads any plugin
    assert len(lines) < 70 and not any("TrainerConfig(" in line for line in lines)
    assert sum("of 40 (" in line for line in lines) == 20 and any(line.startswith("step 40 of 40") for line in lines)
    assert f"ns-export thermoxels-mesh --load-config {trained.config}" in lines[-1]


def test_eval_reports_every_metric(trained: Trained, tmp_path):
    output = tmp_path / "eval.json"
    pictures = tmp_path / "pictures"
    said = succeed(
        *("ns-eval", "--load-config", str(trained.config), "--output-path", str(output)),
        *("--render-output-path", str(pictures)),
    )
    results = json.loads(output.read_text())["results"]
    assert set(METRICS) <= set(results) and "lpips" not in results
    assert all(np.isfinite(results[name]) for name in METRICS)
    assert results["psnr"] > 15 and results["thermal_mae_c"] < 15
    assert "box from the option scene_box" in said  # the run keeps what training found
    assert len(list(pictures.glob("*thermal*.png"))) == 2


def test_render_dataset_writes_thermal_pictures(trained: Trained, tmp_path):
    names = ["rgb", "thermal", "gt-thermal", "depth", "raw-temperature_c"]
    succeed(
        *("ns-render", "dataset", "--load-config", str(trained.config), "--output-path", str(tmp_path)),
        *("--split", "test", "--image-format", "png", "--rendered-output-names", *names),
    )
    for name in names[:4]:
        files = sorted((tmp_path / "test" / name).rglob("*.png"))
        assert len(files) == 2, name
        assert np.asarray(Image.open(files[0])).std() > 1, name  # not one flat colour
    assert len(list((tmp_path / "test" / "raw-temperature_c").rglob("*.npy.gz"))) == 2


def test_stock_exports_still_work(trained: Trained, tmp_path):
    """One that lists cameras, one that renders."""
    for name, *options in (
        ["cameras"],
        ["pointcloud", "--num-points", "300", "--remove-outliers", "False", "--normal-method", "open3d"],
    ):
        export = ("ns-export", name, "--load-config", str(trained.config), "--output-dir", str(tmp_path))
        succeed(*export, *options)
    assert len(json.loads((tmp_path / "transforms_train.json").read_text())) == 10
    assert (tmp_path / "point_cloud.ply").stat().st_size > 300


def test_a_mesh_takes_the_scale_of_the_scene_and_heat_refuses_it_without_one(trained: Trained, tmp_path):
    command = ("ns-export", "thermoxels-mesh", "--load-config", str(trained.config), "--output-dir", str(tmp_path))
    command += ("--density-percentile", "90")
    heat = ("thermoxels", "heat", str(tmp_path / "mesh.vtu"), "--scene", "concrete", "--pictures", "False")
    heat += ("--output-dir", str(tmp_path / "heat"))
    scene = trained.scene / "transforms.json"
    known = scene.read_text()
    succeed(*command)
    mesh = pyvista.read(tmp_path / "mesh.vtu")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert mesh.n_cells == summary["mesh"]["tets"] > 0
    low, high = np.array(json.loads(known)["scene_box"])
    slack = 0.06 * (high - low).max()  # the lattice covers the box with whole voxels
    assert (mesh.points.min(0) > low - slack).all() and (mesh.points.max(0) < high + slack).all()
    assert 0 <= summary["truth"]["fscore"] <= 1 and summary["scale"]["metres_per_unit"] == 1.0
    assert sum(summary["mesh"]["share_of_area_by_support"].values()) == pytest.approx(1.0)  # photographs were asked
    assert (tmp_path / "mesh.png").stat().st_size > 5000
    succeed(*heat)
    assert abs(json.loads((tmp_path / "heat" / "answers.json").read_text())["balance"]["relative_residual"]) < 1e-9
    try:
        scene.write_text(json.dumps({key: value for key, value in json.loads(known).items() if "metres" not in key}))
        said = succeed(*command)
    finally:
        scene.write_text(known)
    assert "--metres-per-unit" in said and "scale of the mesh: expected" in fail(*heat)


def test_resume_goes_on_from_the_checkpoint(trained: Trained, tmp_path):
    """Stopped at step 20 and resumed, the run ends with the parameters of the run that was never stopped."""
    early = tmp_path / "early"
    early.mkdir()
    shutil.copy(trained.checkpoints / "step-000000020.ckpt", early)
    succeed(
        *("ns-train", "thermoxels", "--output-dir", str(tmp_path), "--experiment-name", "again"),
        *("--timestamp", "run", *SHORT_TRAINING, "--max-num-iterations", "19", "--load-dir", str(early)),
        *("thermal-data", "--data", str(trained.scene)),
    )
    again = tmp_path / "again" / "thermoxels" / "run" / "nerfstudio_models"
    whole, resumed = (
        torch.load(at / "step-000000039.ckpt", weights_only=False)["pipeline"] for at in (trained.checkpoints, again)
    )
    assert set(whole) == set(resumed)
    for name, tensor in whole.items():
        assert torch.equal(tensor, resumed[name]), name


def test_thermal_images_alone(thermal_trained: Trained, tmp_path):
    """The baseline evaluates without colour."""
    succeed("ns-eval", "--load-config", str(thermal_trained.config), "--output-path", str(tmp_path / "eval.json"))
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    assert np.isfinite(results["thermal_psnr"]) and "psnr" not in results


@pytest.mark.real_data
def test_real_photographs_with_a_thermal_camera_of_its_own(shared_data, tmp_path):
    said = succeed(
        *("ns-train", "thermoxels-arco", "--output-dir", str(tmp_path), "--experiment-name", "a", "--timestamp", "run"),
        *(*SHORT_TRAINING, "--pipeline.model.prune-threshold", "0"),
        *("thermal-data", "--data", str(shared_data / "arco"), "--downscale-factor", "8"),
    )
    assert "35 train" in said and "thermal cameras of their own" in said
    config = str(tmp_path / "a" / "thermoxels-arco" / "run" / "config.yml")
    succeed(
        *("ns-export", "thermoxels-mesh", "--load-config", config),
        *("--output-dir", str(tmp_path / "mesh"), "--metres-per-unit", "1", "--density-percentile", "90"),
        *("--pictures", "False"),
    )

    # What is known of that room: it was photographed from inside, by a camera that may be 2 K off; no air was measured.
    (tmp_path / "conditions.yaml").write_text(
        "{side: inside, inside: {air: 14 +- 3 C}, surroundings: {reflected: 14 +- 3 C}, "
        "film: {model: iso-6946, factor: 1.0 +- 0.3}, camera: {offset: 0 +- 2 K, repeatability: 0 +- 0.5 K}, "
        "surfaces: [{emissivity: 0.93 +- 0.03}]}"
    )
    result = run(
        *("thermoxels", "audit", str(tmp_path / "mesh" / "mesh.vtu"), "--pictures", "False"),
        *("--conditions", str(tmp_path / "conditions.yaml"), "--output-dir", str(tmp_path / "audit")),
    )
    assert result.returncode == 0, result.stdout
    page = (tmp_path / "audit" / "audit.html").read_text(encoding="utf-8")
    assert "No U-value, psi or temperature factor can be told, because the air outside is not known." in page
    whole = json.loads((tmp_path / "audit" / "answers.json").read_text())["whole"]
    assert whole["u_w_m2k"]["value"] is None and whole["loss_w"]["low"] <= 0.0  # an upper bound, if anything


def test_kill_9_while_saving_loses_at_most_the_work_since_the_last_checkpoint(tiny_scene: Path, tmp_path: Path):
    """Every step saves; the signal is sent when a checkpoint is being written."""
    words = [
        *("thermoxels", "--output-dir", str(tmp_path), "--experiment-name", "killed", "--timestamp", "run"),
        *SHORT_TRAINING,
        *("--steps-per-save", "1", "--max-num-iterations", "100000", "--pipeline.model.resolutions", "32", "64"),
    ]
    scene = ("thermal-data", "--data", str(tiny_scene))
    folder = tmp_path / "killed" / "thermoxels" / "run" / "nerfstudio_models"
    with started("ns-train", *words, *scene, log=tmp_path / "log") as process:
        end = time.monotonic() + 200
        while len(list(folder.glob("*.ckpt"))) < 4 or not any(folder.parent.glob(".step-*.part")):
            assert process.is_alive() and time.monotonic() < end, "no checkpoint was written"
            time.sleep(0.0005)
    steps = []
    for checkpoint in folder.iterdir():
        steps.append(torch.load(checkpoint, weights_only=False)["step"])
        assert checkpoint.name == f"step-{steps[-1]:09d}.ckpt"
    assert sorted(steps) == list(range(1, max(steps) + 1)) and len(steps) >= 4
    again = [*words, "--load-dir", str(folder), "--max-num-iterations", "3", "--steps-per-save", "1000"]
    succeed("ns-train", *again, *scene)
    last = folder / f"step-{max(steps) + 3:09d}.ckpt"
    assert last.is_file(), sorted(path.name for path in folder.iterdir())


@pytest.fixture(scope="module")
def meshes(tmp_path_factory) -> Path:
    """A room to heat and a wall to audit, as exported, with scene and conditions."""
    folder = tmp_path_factory.mktemp("meshes")
    write_mesh(folder / "room.vtu", room())
    (folder / "hour.yaml").write_text(
        'materials: {"*": concrete}\ninitial: {temperature_c: 15.0}\ntime: {step_seconds: 900.0, steps: 4}\n'
        "inside_air: {air_c: 20.0, coefficient: iso-6946-combined}\n"
        "outside_air: {air_c: -5.0, coefficient: iso-6946-combined}\n"
    )
    mesh = photographed(solve_wall(audited_wall(), STATED, true_draws(STATED, None)), STATED, 2)
    write_mesh(folder / "wall.vtu", mesh)
    (folder / "conditions.yaml").write_text((configs_folder() / "conditions-example.yaml").read_text())
    return folder


@pytest.mark.parametrize(
    ("words", "first", "last"),
    [
        ("thermoxels heat {meshes}/room.vtu --scene {meshes}/hour.yaml", "series.csv", "answers.json"),
        ("thermoxels audit {meshes}/wall.vtu --conditions {meshes}/conditions.yaml", "surface.vtp", "answers.json"),
        ("ns-export thermoxels-mesh --load-config {config}", "mesh.vtu", "summary.json"),
    ],
)
def test_kill_9_while_results_are_written_leaves_nothing_half_done(
    trained: Trained, meshes: Path, tmp_path: Path, words: str, first: str, last: str
):
    """Killed when the first result is there: the last one, which says that all is there, is not; run again, all is."""
    command = words.format(meshes=meshes, config=trained.config).split()
    killed, alone = tmp_path / "killed", tmp_path / "alone"
    with started(*command, "--output-dir", str(killed), log=tmp_path / "log") as process:
        end = time.monotonic() + 200
        while not (killed / first).is_file():
            assert process.is_alive() and time.monotonic() < end, (tmp_path / "log").read_text()
            time.sleep(0.0005)
    assert not (killed / last).exists()
    for folder in (killed, alone):
        succeed(*command, "--output-dir", str(folder))
    names = [sorted(path.relative_to(folder) for path in folder.rglob("*")) for folder in (killed, alone)]
    assert names[0] == names[1] and Path(last) in names[0]
    assert (killed / first).read_bytes() == (alone / first).read_bytes()
