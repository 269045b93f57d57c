"""How a training goes on from a checkpoint, and what a quality replaces."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import pytest
import tyro

from tests.support.boxed_scene import write_boxed_scene
from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.errors import CheckpointError
from thermoxels_ns.synthetic.scene_folder import make_scene
from thermoxels_ns.training.schedule import QUALITIES, schedule_for
from thermoxels_ns.training.trainer import ThermoxelsTrainer, writer

DRAFT = ("--quality", "draft")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trainer") / "scene"
    return write_boxed_scene(make_scene("sphere"), folder, 6, 1, width=40, height=30)


@pytest.fixture(autouse=True)
def one_writer_at_a_time(monkeypatch) -> None:
    for name in ("EVENT_WRITERS", "EVENT_STORAGE"):
        monkeypatch.setattr(writer, name, [])
    monkeypatch.setattr(writer, "GLOBAL_BUFFER", {})


def trainer(scene: Path, folder: Path, *options: str) -> ThermoxelsTrainer:
    """The trainer that ns-train would make."""
    fixed = ["--vis", "tensorboard", "--machine.device-type", "cpu"]
    fixed += ["--output-dir", str(folder), "--experiment-name", "e", "--timestamp", "run", "--data", str(scene)]
    before = deepcopy(thermoxels.config)
    settings = (tyro.conf.FlagConversionOff,)
    config = tyro.cli(type(before), default=before, args=[*fixed, *options], config=settings)
    config.pipeline.datamanager.data = config.data
    return config.setup(local_rank=0, world_size=1)


@pytest.fixture(scope="module")
def checkpoints(scene, tmp_path_factory) -> Path:
    """Checkpoints on the first lattice of a draft, of 32 voxels, as if from different steps."""
    folder = tmp_path_factory.mktemp("checkpoints")
    made = trainer(scene, folder, *DRAFT, "--save-only-latest-checkpoint", "False")
    made.setup()
    for step in (99, 499, 799):
        made.save_checkpoint(step)
    return made.checkpoint_dir


def words(capsys) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_a_number_of_steps_that_a_quality_replaces_is_named(scene, tmp_path, capsys):
    made = trainer(scene, tmp_path, *DRAFT, "--max-num-iterations", "2")
    made.setup()
    assert made.config.max_num_iterations == 800 and made._start_step == 0
    said = words(capsys)
    assert "quality draft: 64 voxels and 800 steps, in place of 128 voxels and 2 steps" in said
    assert "goes on from" not in said and writer.GLOBAL_BUFFER["max_iter"] == 800


def test_a_quality_ends_where_it_ends_also_in_a_resumed_training(scene, checkpoints, tmp_path, capsys):
    made = trainer(scene, tmp_path, *DRAFT, "--load-dir", str(checkpoints), "--load-step", "99")
    made.setup()
    assert (made._start_step, made.config.max_num_iterations) == (100, 700)
    assert "goes on from step 100 to step 800, where quality draft ends" in words(capsys)
    assert writer.GLOBAL_BUFFER["max_iter"] == 800


def test_steps_are_counted_from_the_checkpoint_and_it_is_said(scene, checkpoints, tmp_path, capsys):
    options = ["--pipeline.model.resolutions", "32", "--pipeline.model.refine-at"]
    file = str(checkpoints / "step-000000099.ckpt")
    made = trainer(scene, tmp_path, *options, "--load-checkpoint", file, "--max-num-iterations", "150")
    made.setup()
    assert (made._start_step, made.config.max_num_iterations) == (100, 150)
    assert "goes on from step 100 for 150 more; to end at step 150 pass --max-num-iterations 50" in words(capsys)
    assert writer.GLOBAL_BUFFER["max_iter"] == 250
    trainer(scene, tmp_path, *options, "--load-checkpoint", file, "--max-num-iterations", "50").setup()
    said = words(capsys)
    assert "goes on from step 100 for 50 more" in said and "to end at" not in said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((*DRAFT, "--load-step", "799"), "expected one from before step 800, where quality draft ends, got step 800"),
        ((*DRAFT, "--load-step", "499"), "expected at least 64 voxels at step 500, .* got 32 voxels"),
        (("--quality", "standard", "--load-step", "499"), "expected at least 64 voxels at step 500"),
        ((*DRAFT, "--load-step", "7"), "a folder with step-.*, got no step-000000007.ckpt in "),
    ],
)
def test_checkpoints_that_a_training_cannot_go_on_from(scene, checkpoints, tmp_path, options, message):
    with pytest.raises(CheckpointError, match=message):
        trainer(scene, tmp_path, *options, "--load-dir", str(checkpoints)).setup()


@pytest.mark.parametrize("where", ["run", "nowhere", "empty"])
def test_folders_without_checkpoints(scene, checkpoints, tmp_path, where):
    """The run's own folder, whose name stands in nerfstudio's log, holds them one level below."""
    (tmp_path / "empty").mkdir()
    folder = checkpoints.parent if where == "run" else tmp_path / where
    with pytest.raises(CheckpointError, match=r"no step-\*.ckpt in .* Pass the folder nerfstudio_models"):
        trainer(scene, tmp_path, "--load-dir", str(folder)).setup()


@pytest.mark.parametrize("steps", [10, 33, 400, 20_000])
@pytest.mark.parametrize("resolution", [1, 20, 32, 33, 50, 64, 96, 100, 128, 256, 512, 1024])
def test_a_schedule_is_one_that_a_model_accepts(resolution, steps):
    schedule = schedule_for(resolution, steps)
    assert schedule.resolutions[-1] == resolution and schedule.steps == steps
    assert len(schedule.refine_at) == len(schedule.resolutions) - 1
    assert all(fine == 2 * coarse for coarse, fine in zip(schedule.resolutions, schedule.resolutions[1:]))
    assert schedule.resolutions[0] < 64 or resolution >= 1024
    everything = (*schedule.refine_at, *schedule.prune_at, *schedule.thin_at, *schedule.distortion_ramp)
    assert all(1 <= step < steps for step in everything)
    assert list(schedule.refine_at) == sorted(schedule.refine_at)
    if steps >= 400:
        config = deepcopy(thermoxels.config)
        config.follow_schedule(schedule)
        config.pipeline.model.check()
        assert max(everything) == schedule.thin_at[0]


@pytest.mark.parametrize("quality", QUALITIES)
def test_a_quality_sets_resolution_and_length_and_leaves_the_defaults_alone(quality):
    before = deepcopy(thermoxels.config)
    config = tyro.cli(type(before), default=before, args=["--quality", quality])
    resolution, steps = QUALITIES[quality]
    assert config.max_num_iterations == steps and config.pipeline.model.resolutions[-1] == resolution
    assert {group["scheduler"].max_steps for group in config.optimizers.values()} == {steps}
    assert config.pipeline.model.thin_at == schedule_for(resolution, steps).thin_at
    assert thermoxels.config.max_num_iterations == QUALITIES["standard"][1]
    assert thermoxels.config.pipeline.model.resolutions[-1] == QUALITIES["standard"][0]
