from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tyro
import yaml
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils import writer

from tests.support.short_training import write_boxed_scene
from tests.support.unreadable import files_end_after
from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.errors import CheckpointError, OutputError, ThermoxelsError
from thermoxels_ns.synthetic.scene_folder import make_scene
from thermoxels_ns.training.schedule import QUALITIES, schedule_for
from thermoxels_ns.training.trainer import ThermoxelsTrainer

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
    made = configured(scene, folder, *options).setup(local_rank=0, world_size=1)
    made.setup()
    return made


def configured(scene: Path, folder: Path, *options: str) -> Any:
    fixed = ["--vis", "tensorboard", "--machine.device-type", "cpu"]
    fixed += ["--output-dir", str(folder), "--experiment-name", "e", "--timestamp", "run", "--data", str(scene)]
    before = deepcopy(thermoxels.config)
    settings = (tyro.conf.FlagConversionOff,)
    config = tyro.cli(type(before), default=before, args=[*fixed, *options], config=settings)
    config.pipeline.datamanager.data = config.data
    config.pipeline.model.voxel_pixels = 0.0  # photographs as small as these ask for a few voxels
    return config


@pytest.fixture(scope="module")
def checkpoints(scene, tmp_path_factory) -> Path:
    """Checkpoints on the first lattice of a draft, of 32 voxels, as if from different steps."""
    folder = tmp_path_factory.mktemp("checkpoints")
    made = trainer(scene, folder, *DRAFT, "--save-only-latest-checkpoint", "False")
    for step in (99, 499, 799):
        made.save_checkpoint(step)
    return made.checkpoint_dir


def words(capsys) -> str:
    return " ".join(capsys.readouterr().out.split())


FIRST_LATTICE = ("--pipeline.model.resolutions", "32", "--pipeline.model.refine-at")


@pytest.mark.parametrize(
    ("options", "resumed", "steps", "said"),
    [
        ((*DRAFT, "--max-num-iterations", "2"), False, (0, 800), "800 steps, in place of about 128 voxels and 2 steps"),
        (DRAFT, True, (100, 700), "goes on from step 100 to step 800, where quality draft ends"),
        (
            (*FIRST_LATTICE, "--max-num-iterations", "150"),
            True,
            (100, 150),
            "goes on from step 100 for 150 more; to end at step 150 pass --max-num-iterations 50",
        ),
        ((*FIRST_LATTICE, "--max-num-iterations", "50"), True, (100, 50), "goes on from step 100 for 50 more"),
    ],
)
def test_where_a_training_begins_and_ends_is_said(scene, checkpoints, tmp_path, capsys, options, resumed, steps, said):
    file = ("--load-checkpoint", str(checkpoints / "step-000000099.ckpt")) if resumed else ()
    made = trainer(scene, tmp_path, *options, *file)
    assert (made._start_step, made.config.max_num_iterations) == steps
    assert said in words(capsys)


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
        trainer(scene, tmp_path, *options, "--load-dir", str(checkpoints))


@pytest.mark.parametrize("again", [DRAFT, ("--max-num-iterations", "300")])
def test_what_was_found_for_a_scene_holds_when_its_training_goes_on(scene, tmp_path, again):
    """A refinement was left out; the resolutions are still none that somebody typed, so later ones may be, too."""
    made = trainer(scene, tmp_path, *DRAFT)
    made.config.pipeline.model.voxel_pixels = 1.6
    made.pipeline.model.config = replace(made.pipeline.model.config, resolutions=(32,), refine_at=())
    made.save_found_settings()
    made.save_checkpoint(499)
    found = trainer(scene, tmp_path / "again", *again, "--load-dir", str(made.checkpoint_dir)).pipeline.model.config
    assert found.resolutions == (32,) and found.refine_at == () and found.voxel_pixels == 1.6
    assert found.suited_to(1000.0) == found, "photographs are not asked again"


@pytest.mark.parametrize("steps", [10, 33, 400, 20_000])
@pytest.mark.parametrize("resolution", [1, 20, 32, 33, 50, 64, 96, 100, 128, 256, 512, 1024])
def test_a_schedule_is_one_that_a_model_accepts(resolution, steps):
    schedule = schedule_for(resolution, steps)
    assert schedule.resolutions[-1] == resolution and schedule.steps == steps
    assert len(schedule.refine_at) == len(schedule.resolutions) - 1
    assert all(fine == 2 * coarse for coarse, fine in zip(schedule.resolutions, schedule.resolutions[1:]))
    assert schedule.resolutions[0] < 64 or len(schedule.resolutions) == 3
    everything = (*schedule.refine_at, *schedule.prune_at, *schedule.thin_at, *schedule.distortion_ramp)
    assert all(1 <= step < steps for step in everything)
    assert list(schedule.refine_at) == sorted(schedule.refine_at)
    if steps >= 400:
        config = deepcopy(thermoxels.config)
        config.follow_schedule(schedule)
        config.pipeline.model.check()
        assert max(everything) == schedule.thin_at[0]


@pytest.mark.parametrize(
    ("typed", "pixels"),
    [
        ((), 1.6),
        (("--pipeline.model.resolutions", "32", "64", "128"), 0.0),
        (("--pipeline.model.resolutions", "32", "64", "128", "--pipeline.model.voxel-pixels", "1.6"), 1.6),
    ],
)
def test_typed_resolutions_stay_whatever_the_photographs_ask_for(scene, tmp_path, monkeypatch, typed, pixels):
    config = configured(scene, tmp_path, *typed)
    config.pipeline.model.voxel_pixels = 1.6
    monkeypatch.setattr("sys.argv", ["ns-train", "thermoxels", *typed])
    config.save_config()
    assert config.pipeline.model.voxel_pixels == pixels


@pytest.mark.parametrize("quality", QUALITIES)
def test_a_quality_sets_resolution_and_length_and_leaves_the_defaults_alone(quality):
    before = deepcopy(thermoxels.config)
    config = tyro.cli(type(before), default=before, args=["--quality", quality])
    resolution, steps, pixels = QUALITIES[quality]
    assert config.max_num_iterations == steps and config.pipeline.model.resolutions[-1] == resolution
    assert config.pipeline.model.voxel_pixels == pixels
    assert {group["scheduler"].max_steps for group in config.optimizers.values()} == {steps}
    assert config.pipeline.model.thin_at == schedule_for(resolution, steps).thin_at
    assert thermoxels.config.max_num_iterations == QUALITIES["standard"][1]
    assert thermoxels.config.pipeline.model.resolutions[-1] == QUALITIES["standard"][0]


@pytest.mark.parametrize(
    ("words", "host"),
    [
        ((), "127.0.0.1"),
        (("--vis",), "127.0.0.1"),
        (("--viewer.websocket-host", "192.168.0.1"), "192.168.0.1"),
        (("--viewer.websocket_host=192.168.0.1",), "192.168.0.1"),
    ],
)
def test_neither_a_config_nor_ns_viewer_opens_the_viewer(monkeypatch, words, host):
    """ns-viewer replaces the viewer of a training by that of its own command line."""
    monkeypatch.setattr("sys.argv", ["ns-train", "--load-config", "config.yml", *words])
    text = yaml.dump(thermoxels.config).replace("websocket_host: 127.0.0.1", "websocket_host: 0.0.0.0")
    config = yaml.load(text, Loader=yaml.Loader)
    assert "0.0.0.0" in text and config.viewer.websocket_host == host
    config.viewer = ViewerConfig()
    assert config.viewer.websocket_host == host


@pytest.mark.parametrize("name", ["experiment_name", "timestamp", "method_name", "relative_model_dir", "log"])
@pytest.mark.parametrize("text", ["../../out", "..", "a/b", "/tmp", "a\\b"])
def test_a_run_stays_in_the_output_folder(name, text):
    """Typed options and a config.yml set the same fields."""
    config = deepcopy(thermoxels.config)
    if name == "log":
        config.logging.relative_log_dir = Path(text)
    else:
        setattr(config, name, Path(text) if name == "relative_model_dir" else text)
    with pytest.raises(OutputError, match="^logging.relative_log_dir: " if name == "log" else f"^{name}: "):
        config.get_checkpoint_dir()


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize(("data", "name"), [(".", "scene"), ("../scene", "scene"), ("..", "above")])
def test_a_run_is_named_by_the_folder_of_its_scene(tmp_path, monkeypatch, data, name, behind):
    (tmp_path / "above" / "scene").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "above" / "scene")
    config = deepcopy(thermoxels.config)
    manager = config.pipeline.datamanager
    (manager.dataparser if behind else manager).data = Path(data)
    expected = "unnamed" if behind and data == "." else name  # "." is what the dataparser has if nothing is typed
    assert config.get_base_dir().parts[:3] == ("outputs", expected, "thermoxels")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("--max-num-iterations 0", "max_num_iterations: .*Correct --max-num-iterations"),
        ("--machine.seed -1", "seed: .*Correct --machine.seed"),
        ("--pipeline.model.seed -1", "seed: .*Correct --pipeline.model.seed"),
        ("--pipeline.datamanager.train-num-rays-per-batch 0", "train_num_rays_per_batch: "),
        ("--pipeline.datamanager.thermal-num-rays-per-batch -1", "thermal_num_rays_per_batch: "),
        ("--optimizers.density.optimizer.lr -0.3", "lr: .*Correct --optimizers.density"),
        ("--optimizers.sh.scheduler.lr-final 0", "lr_final: "),
        ("--optimizers.sh.scheduler.max-steps 0", "max_steps: "),
        ("--pipeline.model.loss-overrides rgb nan", "loss_overrides rgb: "),
        ("--machine.device-type cuda", "device_type: .*Pass --machine.device-type cpu"),
        ("--experiment-name " + "e" * 300, "File name too long"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(scene, tmp_path, monkeypatch, options, named):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ThermoxelsError, match=named):
        configured(scene, tmp_path / "out", *options.split()).save_config()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_two_trainings_into_one_folder_are_refused(scene, tmp_path):
    configured(scene, tmp_path).save_config()
    with pytest.raises(
        OutputError, match=r"no other command is working in, got .*where process \d+ is at work.*--time"
    ):
        configured(scene, tmp_path, "--max-num-iterations", "7").save_config()
    assert "max_num_iterations: 7" not in (tmp_path / "e" / "thermoxels" / "run" / "config.yml").read_text()


def test_a_finished_training_goes_on_as_it_was_without_its_options(scene, tmp_path, monkeypatch):
    """The remedy of a finished quality: leave it out and pass a number of steps."""
    options = ("--max-num-iterations", "800", "--optimizers.sh.scheduler.max-steps", "800")
    made = trainer(scene, tmp_path, *FIRST_LATTICE, *options)
    made.config.save_config()
    made.save_checkpoint(799)
    again = trainer(scene, tmp_path / "again", "--load-dir", str(made.checkpoint_dir), "--max-num-iterations", "400")
    assert again.config.pipeline.model.resolutions == (32,) and again._start_step == 800
    assert again.config.optimizers["sh"]["scheduler"].max_steps == 800
    monkeypatch.setattr("sys.argv", ["ns-train", "--pipeline.model.resolutions", "32", "64", "128"])
    with pytest.raises(CheckpointError, match="expected at least 128 voxels at step 800"):
        trainer(scene, tmp_path / "other", "--load-dir", str(made.checkpoint_dir))


def test_a_full_disk_is_one_line_and_loses_no_checkpoint(scene, tmp_path):
    made = trainer(scene, tmp_path)
    made.save_checkpoint(10)
    said = r"step-000000020.ckpt: expected room for it, got .*MB of free space. Free space, then .*--load-dir"
    with files_end_after(10_000), pytest.raises(OutputError, match=said):
        made.save_checkpoint(20)
    assert [path.name for path in made.checkpoint_dir.iterdir()] == ["step-000000010.ckpt"]
    assert not list(made.checkpoint_dir.parent.glob(".*.part"))


def test_a_disk_that_fills_up_while_training_is_one_line(scene, tmp_path):
    made = trainer(scene, tmp_path, "--steps-per-save", "1", "--max-num-iterations", "3")
    said = r"checkpoint .*: expected room for it, got .* Free space, then train again"
    with files_end_after(200_000), pytest.raises(OutputError, match=said):
        made.train()
    assert not list(tmp_path.rglob("*.ckpt")) and not list(tmp_path.rglob("*.part"))


def test_a_disk_without_room_for_a_checkpoint_is_refused_first(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1_000_000}))
    with pytest.raises(
        OutputError, match=r"output folder: expected .* MB of space for results in .*, got 1 MB of free"
    ):
        configured(scene, tmp_path).save_config()
