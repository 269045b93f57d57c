"""Nerfstudio's trainer, with named qualities, checked options, and checkpoints written wholly or not at all."""

from __future__ import annotations

import os
import shlex
import shutil
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
import yaml
from filelock import FileLock
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.core.checks import check_ranges, hold_folder, plain_os_errors, replace_when_done, writable_folder
from thermoxels_ns.core.config_loader import ConfigLoader, scene_of_run, typed, typed_value
from thermoxels_ns.core.errors import CheckpointError, OutputError, ThermoxelsError
from thermoxels_ns.training.schedule import QUALITIES, Quality, Schedule, schedule_for

LOCAL_HOST = "127.0.0.1"
_HELD: list[FileLock] = []
"""Locks of the folders into which trainings of this process write; kept while the process lives."""
_SCHEDULE = tuple(field.name for field in fields(Schedule))
"""Names of the fields of `Schedule`, each of which is also an option of the model."""


@dataclass
class ThermoxelsTrainerConfig(TrainerConfig):
    """Settings of a training run."""

    _target: type = field(default_factory=lambda: ThermoxelsTrainer)
    quality: Quality | None = None
    """Named setting of resolution and length: draft (voxels of 3.2 pixels, up to 192 along the longest side, 800
    steps: a first look, a minute or two on two cores), standard (1.6 pixels, up to 384, fewer where rays are few, 1500
    steps, the default: one to some minutes) or fine (1.6 pixels, up to 512, 4000 steps: many minutes); `thermoxels
    cost` measures all three.
    A quality replaces max-num-iterations, the lengths of the learning rate schedules, and the model's resolutions,
    refine-at, voxel-pixels, steps, prune-at, thin-at, distortion-ramp and view-dependence-from."""
    show_settings: bool = False
    """Print all settings before training begins; config.yml in the folder of the run has them, too."""
    replaced: tyro.conf.Suppress[str] = ""
    """Voxels and steps that the quality replaced, as text for the log."""
    scene_from_run: tyro.conf.Suppress[str] = ""
    """Path of the scene seen from the folder of the run, so that both may be moved together."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Set a field; the viewer gets `LOCAL_HOST` as its host unless another host was typed on the command line."""
        if name == "viewer":
            value = replace(value, websocket_host=typed_value("--viewer.websocket-host") or LOCAL_HOST)
        super().__setattr__(name, value)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the known fields of a config.yml; replace the viewer's host by the typed host, or by `LOCAL_HOST`."""
        known = {each.name for each in fields(self)}
        self.__dict__.update({name: value for name, value in state.items() if name in known})
        if "viewer" in state:
            self.viewer = state["viewer"]

    def __post_init__(self) -> None:
        if self.quality is None:
            return
        model: Any = self.pipeline.model
        self.replaced = f"about {max(model.resolutions)} voxels and {self.max_num_iterations} steps"
        self.follow_schedule(schedule_for(*QUALITIES[self.quality]))

    def set_experiment_name(self) -> None:
        """If no name is given, name the run after the folder of its scene, also for ``--data ..``."""
        manager: Any = self.pipeline.datamanager
        data = manager.data
        if data is None and manager.dataparser.data != Path():  # --data behind thermal-data
            data = manager.dataparser.data
        if self.experiment_name is None and data is not None:
            self.experiment_name = Path(os.path.abspath(data.parent if data.is_file() else data)).stem
        super().set_experiment_name()

    def moved_to(self, folder: Path) -> None:
        """Use `folder` as the run's folder, and the scene at its old place relative to this folder if it is there."""
        manager: Any = self.pipeline.datamanager
        scene = scene_of_run(folder, manager.data or manager.dataparser.data, self.scene_from_run)
        manager.dataparser.data = scene
        manager.data = scene if manager.data is not None else None
        self.__dict__["_folder"] = folder  # no field: it is not written to config.yml

    def get_base_dir(self) -> Path:
        """Return the folder of the run: the argument of `moved_to`, if it was called, else a folder in `output_dir`.
        Raises `OutputError` if the name of a folder in the path contains a separator, or is ``.`` or ``..``."""
        if "_folder" in vars(self):
            return vars(self)["_folder"]
        self.set_experiment_name()
        names = {name: str(getattr(self, name)) for name in ("experiment_name", "method_name", "timestamp")}
        names |= {"relative_model_dir": Path(self.relative_model_dir).as_posix()}
        if (logs := Path(self.logging.relative_log_dir).as_posix()) != ".":
            names["logging.relative_log_dir"] = logs
        for name, text in names.items():
            if text in (".", "..") or set(text) & {"/", "\\", "\0"}:
                expected, remedy = "one name of a folder", f"Pass --{name.replace('_', '-')} with a plain name."
                raise OutputError(name, expected=expected, got=repr(text), remedy=remedy)
        return super().get_base_dir()

    def print_to_terminal(self) -> None:
        """Print all settings, some 300 lines, if they were asked for."""
        if self.show_settings:
            super().print_to_terminal()

    def save_config(self) -> None:
        """Check all options, lock the run's folder while this process lives, and write config.yml. Raises
        `ThermoxelsError` if an option is out of range, or if the folder is not writable or already in use."""
        self.follow_checkpoint()
        model: Any = self.pipeline.model
        if typed("--pipeline.model.resolutions") and not typed("--pipeline.model.voxel-pixels"):
            model.voxel_pixels = 0.0
        self.check()
        first = (model.resolutions[0] + 1) ** 3 * 4 * model.row_channels(model.resolutions[0])
        with plain_os_errors(self.output_dir):
            # Room for two checkpoints, each with values and two moments of the first lattice.
            folder = writable_folder(self.get_base_dir(), min(6 * first, 1e9 * model.memory_budget_gb))
            manager: Any = self.pipeline.datamanager
            with suppress(ValueError):  # on another drive
                self.scene_from_run = Path(os.path.relpath(manager.data or manager.dataparser.data, folder)).as_posix()
            _HELD.append(hold_folder(folder / ".lock", "Wait until it ends, or pass another --timestamp.", CONSOLE.log))
            super().save_config()

    def check(self) -> None:
        """Raise `ThermoxelsError` if an option is out of range or PyTorch does not find the device."""
        manager: Any = self.pipeline.datamanager
        model: Any = self.pipeline.model
        rays = [f"{stream}_num_rays_per_batch" for stream in ("train", "thermal", "eval")]
        counts = {"max_num_iterations": self.max_num_iterations, "machine.num_devices": self.machine.num_devices}
        counts |= {f"pipeline.datamanager.{name}": getattr(manager, name) for name in rays}
        rates = {f"optimizers.{name}.optimizer.lr": group["optimizer"].lr for name, group in self.optimizers.items()}
        for name, group in self.optimizers.items():
            if (scheduler := group.get("scheduler")) is not None:
                counts[f"optimizers.{name}.scheduler.max_steps"] = scheduler.max_steps
                if scheduler.lr_final is not None:
                    rates[f"optimizers.{name}.scheduler.lr_final"] = scheduler.lr_final
        seeds = {"machine.seed": self.machine.seed, "pipeline.datamanager.seed": manager.seed}
        for values, (low, high, words) in (
            (counts, (1, 1e9, "1 or more")),
            (seeds, (0, 2**32 - 1, "from 0 to 2^32 - 1")),
            (rates, (1e-30, 1e6, "above 0")),
        ):
            check_ranges("--", {name: (value, low, high, words) for name, value in values.items()})
        model.check()
        there = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
        if not there[self.machine.device_type]:
            expected = f"one of {', '.join(name for name in there if there[name])}, which PyTorch finds here"
            remedy = "Pass --machine.device-type cpu, or install the driver and a PyTorch that is built for it."
            raise ThermoxelsError("device_type", expected=expected, got=self.machine.device_type, remedy=remedy)

    def follow_checkpoint(self) -> None:
        """Take resolutions and schedules from the run that is resumed, unless they or another quality were typed."""
        folder = self.load_dir or (self.load_checkpoint.parent if self.load_checkpoint else None)
        if folder is None or not (folder.parent / "config.yml").is_file():
            return
        earlier = yaml.load((folder.parent / "config.yml").read_text(encoding="utf-8"), Loader=ConfigLoader)
        if not isinstance(earlier, ThermoxelsTrainerConfig) or self.quality not in (None, earlier.quality):
            return
        if not any(typed_value(f"--pipeline.model.{item.replace('_', '-')}") for item in _SCHEDULE):
            for item in (*_SCHEDULE, "suited"):
                setattr(self.pipeline.model, item, getattr(earlier.pipeline.model, item))
        for name, group in self.optimizers.items():
            before = earlier.optimizers.get(name, {}).get("scheduler")
            if before is not None and not typed(f"--optimizers.{name}.scheduler"):
                group["scheduler"] = before

    def follow_schedule(self, schedule: Schedule) -> None:
        """Set the number of steps, the lengths of learning rate schedules, and the model's options by `schedule`."""
        self.max_num_iterations = schedule.steps
        for group in self.optimizers.values():
            if group.get("scheduler") is not None:
                group["scheduler"].max_steps = schedule.steps
        model: Any = self.pipeline.model
        for item in _SCHEDULE:
            setattr(model, item, getattr(schedule, item))


class ThermoxelsTrainer(Trainer):
    """Trainer of the voxel model; it writes a checkpoint completely or not at all."""

    config: ThermoxelsTrainerConfig

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Build the pipeline, load the checkpoint if one is named, and log which options a quality replaced. Raises
        `CheckpointError` if the named checkpoint does not exist or the training cannot go on from it."""
        quality, replaced = self.config.quality, self.config.replaced
        if quality is not None:
            said = "about {} voxels and {} steps".format(*QUALITIES[quality])
            instead = f", in place of {replaced}" if replaced not in ("", said) else ""
            CONSOLE.log(f"quality {quality}: {said}{instead}")
        self.config.follow_checkpoint()
        with plain_os_errors(self.base_dir):
            super().setup(test_mode)
        if self.local_rank == 0:
            self.save_found_settings()

    def save_found_settings(self) -> None:
        """Write the scene box and the resolutions that were found from the photographs into config.yml."""
        kept: Any = deepcopy(self.config)
        pipeline: Any = getattr(self.pipeline, "module", self.pipeline)
        model, parser = kept.pipeline.model, kept.pipeline.datamanager.dataparser
        found, model.suited = pipeline.model.config, True
        model.resolutions, model.refine_at, model.prune_at = found.resolutions, found.refine_at, found.prune_at
        parser.scene_box = pipeline.datamanager.train_dataparser_outputs.metadata["input_box"]
        with plain_os_errors(self.base_dir), replace_when_done(self.base_dir / "config.yml") as path:
            path.write_text(yaml.dump(kept), encoding="utf-8")

    def train(self) -> None:
        """Run the training and print the next command; raise `OutputError` if results cannot be written."""
        with plain_os_errors(self.base_dir):
            super().train()
        if self.local_rank == 0:
            config = shlex.quote(str(self.base_dir / "config.yml"))
            next_command = f"ns-export thermoxels-mesh --load-config {config} --output-dir export"
            CONSOLE.print(f"To make a mesh: {next_command}", markup=False, highlight=False, soft_wrap=True)

    def _check_viewer_warnings(self) -> None:
        """Say nothing: nerfstudio's note is about evaluations while training, which are off by default."""

    def _load_checkpoint(self) -> None:
        """Load the named checkpoint, if any, and log the steps to come; raise `CheckpointError` if it does not fit."""
        folder, step, file = self.config.load_dir, self.config.load_step, self.config.load_checkpoint
        missing = None if folder is not None or file is None or file.is_file() else f"no file {file}"
        if folder is not None:
            pattern = "step-*.ckpt" if step is None else f"step-{step:09d}.ckpt"
            missing = None if any(folder.glob(pattern)) else f"no {pattern} in {folder}"
        if missing is not None:
            expected = "a folder with step-*.ckpt for --load-dir, or such a file for --load-checkpoint"
            remedy = "Pass the folder nerfstudio_models of a training."
            raise CheckpointError("checkpoint", expected=expected, got=missing, remedy=remedy)
        super()._load_checkpoint()
        first, steps = self._start_step, self.config.max_num_iterations
        if first == 0:
            return
        quality = self.config.quality
        if quality is not None and first >= steps:
            expected = f"one from before step {steps}, where quality {quality} ends"
            remedy = "Leave --quality out and pass --max-num-iterations 400, how many more steps to take."
            raise CheckpointError("checkpoint", expected=expected, got=f"step {first}", remedy=remedy)
        model: Any = getattr(self.pipeline, "module", self.pipeline).model
        wanted = model.config.resolutions[sum(step < first for step in model.config.refine_at)]
        if (found := max(model.grid.lattice.cell_shape)) < wanted:  # the lattice would never be refined to it
            expected = f"at least {wanted} voxels at step {first}, which these options refine to before it"
            remedy = "Pass the quality, or the resolutions and refine-at, that the training began with."
            raise CheckpointError("checkpoint", expected=expected, got=f"{found} voxels", remedy=remedy)
        if quality is not None:
            CONSOLE.log(f"goes on from step {first} to step {steps}, where quality {quality} ends")
            self.config.max_num_iterations = steps - first
        else:
            end = "" if first >= steps else f"; to end at step {steps} pass --max-num-iterations {steps - first}"
            CONSOLE.log(f"goes on from step {first} for {steps} more{end}")

    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint into a temporary folder, rename the file, and only then delete older checkpoints.

        The folder lies outside the checkpoint folder, where nerfstudio takes each file for a checkpoint. Raises
        `OutputError` if the file cannot be written.
        """
        if self.local_rank != 0:
            return
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        final = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        self.checkpoint_dir = unfinished = final.parent.parent / f".{final.stem}.part"
        try:
            super().save_checkpoint(step)
            os.replace(unfinished / final.name, final)
        except (OSError, RuntimeError) as problem:
            free = shutil.disk_usage(final.parent).free
            got = f"{type(problem).__name__} with {free / 1e6:.3g} MB of free space"
            remedy = "Free space, then train again."
            if any(final.parent.glob("*.ckpt")):
                remedy = f"Free space, then go on from the one before it: --load-dir {shlex.quote(str(final.parent))}"
            raise OutputError(f"checkpoint {final}", expected="room for it", got=got, remedy=remedy) from problem
        finally:
            self.checkpoint_dir = final.parent
            shutil.rmtree(unfinished, ignore_errors=True)
        if self.config.save_only_latest_checkpoint:
            for other in self.checkpoint_dir.glob("*.ckpt"):
                if other != final:
                    other.unlink()
