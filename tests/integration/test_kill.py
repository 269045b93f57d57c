import time
from pathlib import Path

import pytest
import torch

from tests.integration.commands import SHORT_TRAINING, Trained, started, succeed
from tests.support.audited_wall import STATED, audited_wall, photographed, solve_wall, true_draws
from tests.support.scene_bodies import room
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.mesh.files.formats import write_mesh


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
        'materials: {"*": concrete}\ninitial: {temperature_c: 15.0}\ntime: {duration_s: 3600.0, steps: 4}\n'
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
