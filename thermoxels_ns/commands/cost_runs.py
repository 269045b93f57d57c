"""Train and evaluate one setting with the real commands, and remember in a csv what it costs and gives."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from thermoxels_ns import __version__
from thermoxels_ns.commands.cost_process import ProcessCost, Watch, run_measured
from thermoxels_ns.commands.demo_commands import command_line
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError

FIGURES: Mapping[str, str] = {
    "seconds": "wall time of the whole ns-train command, from its start to its end",
    "training_seconds": "from the first training step to the last checkpoint",
    "peak_memory_gb": "largest resident memory of the ns-train process, 1e9 bytes",
    "psnr": "RGB PSNR of the held-out views, dB",
    "ssim": "RGB SSIM of the held-out views",
    "thermal_mae_c": "mean absolute temperature error of the held-out views, degrees Celsius",
    "half_transparent": "share of rays that are neither through nor stopped",
    "fscore": "surface F-score at 1.5 voxels of the setting's own lattice",
    "precision": "precision of the same",
    "recall": "recall of the same",
    "fscore_128": "surface F-score at 1.5 voxels of a lattice of 128 voxels",
    "surface_distance_voxels": "mean distance of the surface to the true one, voxels of the setting's own lattice",
    "surface_distance_m": "the same in metres",
}
"""What is measured, by the name of its column."""

_EVALUATED = tuple(FIGURES)[3:]
_KEYS = ("setting", "repeat", "scene", "version", "training")
_GROUPS = ("density", "sh", "temperature", "background", "thermal_offset")


@dataclass(frozen=True)
class CostSetting:
    """One way to train."""

    name: str
    """What the user calls it, for instance ``64:800``, ``standard`` or ``standard, recipe paper``."""
    method: str
    """Method of ns-train."""
    options: tuple[str, ...]
    """Options of ns-train."""
    work: float = math.inf
    """Roughly how much there is to do, to find the cheapest before anything ran; infinite if not known."""
    beside: bool = False
    """Another method or recipe at the baseline, for comparison."""

    @property
    def training(self) -> str:
        """The words that make it what it is, as typed in a shell."""
        return command_line(["ns-train", self.method, *self.options])

    def command(self, scene: Path | str) -> str:
        """How to train a scene with it, as typed in a shell."""
        return command_line(["ns-train", self.method, "--data", scene, *self.options])

    @property
    def file_name(self) -> str:
        """The name as part of a path."""
        return re.sub(r"[^0-9A-Za-z.-]+", "-", self.name)


@dataclass(frozen=True)
class CostRun:
    """One finished run of a setting."""

    setting: str
    """Name of the setting."""
    repeat: int
    """Number of the run, from 1."""
    scene: str
    """Fingerprint of the scene."""
    version: str
    """Version of this package."""
    training: str
    """The words of ns-train."""
    figures: Mapping[str, float]
    """What was measured, by the names in `FIGURES`; NaN where there is nothing to measure."""

    @property
    def key(self) -> tuple[str, int, str, str, str]:
        """Two runs with the same key measured the same thing."""
        return (self.setting, self.repeat, self.scene, self.version, self.training)


def parse_setting(text: str) -> tuple[int, int]:
    """Read ``resolution:steps``.

    Raises:
        ThermoxelsError: It is something else.

    >>> parse_setting("64:800")
    (64, 800)
    """
    match = re.fullmatch(r"([1-9]\d*):([1-9]\d*)", text)
    if match is None:
        raise ThermoxelsError(
            "settings",
            expected="voxels and steps, such as 64:800",
            got=repr(text),
            remedy="Pass --settings 64:800 128:1500.",
        )
    return int(match[1]), int(match[2])


def training_options(resolution: int, steps: int) -> list[str]:
    """Options of ns-train for a final resolution and a number of steps.

    Raises:
        ThermoxelsError: There is no schedule for them.
    """
    from thermoxels_ns.training.schedule import schedule_for

    schedule = schedule_for(resolution, steps)
    words = ["--max-num-iterations", str(schedule.steps)]
    for group in _GROUPS:
        words += [f"--optimizers.{group}.scheduler.max-steps", str(schedule.steps)]
    for name in ("resolutions", "refine_at", "prune_at", "thin_at", "distortion_ramp"):
        words += [f"--pipeline.model.{name.replace('_', '-')}", *map(str, getattr(schedule, name))]
    words += ["--pipeline.model.view-dependence-from", str(schedule.view_dependence_from)]
    return words


def scene_fingerprint(scene: Path) -> str:
    """Tell scenes apart: names and sizes of all files, and the contents of the json files beside the photographs."""
    digest = hashlib.sha256()
    for path in sorted(path for path in scene.rglob("*") if path.is_file()):
        digest.update(f"{path.relative_to(scene).as_posix()} {path.stat().st_size}\n".encode())
        if path.parent == scene and path.suffix == ".json":
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def read_runs(path: Path) -> list[CostRun]:
    """Read the finished runs; none if there is no file yet.

    Raises:
        ThermoxelsError: The file is not one that `write_runs` made.
    """
    if not path.is_file():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, strict=True)
            if missing := {*_KEYS, *FIGURES} - set(reader.fieldnames or ()):
                raise ValueError(f"no column {', '.join(sorted(missing))}")
            rows = list(reader)
        return [
            CostRun(
                **{key: row[key] for key in _KEYS if key != "repeat"},
                repeat=int(row["repeat"]),
                figures={name: float(row[name] or "nan") for name in FIGURES},
            )
            for row in rows
        ]
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as problem:
        raise ThermoxelsError(
            str(path),
            expected="the finished runs of an earlier start",
            got=f"{type(problem).__name__}: {problem}",
            remedy="Remove the file to measure again, or choose another --output-dir.",
        ) from problem


def write_runs(path: Path, runs: Iterable[CostRun]) -> None:
    """Write the finished runs; an interrupted write leaves the old file."""
    with replace_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*_KEYS, *FIGURES])
        for run in runs:
            figures = [run.figures[name] for name in FIGURES]
            writer.writerow([getattr(run, key) for key in _KEYS] + ["" if math.isnan(v) else repr(v) for v in figures])


class Bench:
    """Runs settings on one scene, each in a folder of its own that goes when it is done."""

    def __init__(self, scene: Path, folder: Path, keep_models: bool = False) -> None:
        """Remember where things go.

        Args:
            scene: The scene folder.
            folder: Where logs, figures and models go.
            keep_models: Leave the trained models in ``folder/models``.

        Raises:
            SceneError: There is no such scene folder.
        """
        if not scene.is_dir():
            raise SceneError("scene", expected="a scene folder", got=f"none at {scene}", remedy="Correct the path.")
        self.scene = scene
        self.fingerprint = scene_fingerprint(scene)
        self._folder = folder
        self._keep = keep_models

    def planned(self, setting: CostSetting, repeat: int) -> CostRun:
        """The run as it will be remembered, still without figures."""
        return CostRun(setting.name, repeat, self.fingerprint, __version__, setting.training, {})

    def train(self, setting: CostSetting, name: str, watch: Watch) -> tuple[Path, ProcessCost]:
        """Train a setting anew.

        Args:
            setting: How.
            name: Of the run's folder and log.
            watch: Called now and then.

        Returns:
            The run's folder, as nerfstudio makes it, and what the command took.
        """
        models = writable_folder(self._folder / "models")
        shutil.rmtree(models / name, ignore_errors=True)
        words = [
            *("ns-train", setting.method, "--data", str(self.scene), "--output-dir", str(models)),
            *("--experiment-name", name, "--timestamp", "run", "--vis", "tensorboard"),
            # One line every fifty steps instead of a block that is drawn over and over.
            *("--logging.steps-per-log", "50", "--logging.local-writer.max-log-size", "0"),
            *("--logging.profiler", "none", *setting.options),
        ]
        cost = run_measured(words, self._log(name, "train"), watch)
        return models / name / setting.method / "run", cost

    def measure(self, setting: CostSetting, repeat: int, watch: Watch) -> CostRun:
        """Train and evaluate a setting.

        Raises:
            ThermoxelsError: A command failed, or did not write what it should.
        """
        name = f"{setting.file_name}-{repeat}"
        try:
            run_folder, cost = self.train(setting, name, watch)
            figures = {
                "seconds": cost.seconds,
                "training_seconds": training_seconds(run_folder),
                "peak_memory_gb": cost.peak_memory_gb,
            }
            output = writable_folder(self._folder / "eval") / f"{name}.json"
            words = ["ns-eval", "--load-config", str(run_folder / "config.yml"), "--output-path", str(output)]
            run_measured(words, self._log(name, "eval"), lambda _: watch(None))
            figures |= read_evaluation(output)
        finally:
            if not self._keep:
                self.discard(name)
        planned = self.planned(setting, repeat)
        return CostRun(*planned.key, figures=figures)

    def discard(self, name: str) -> None:
        """Remove a run's model."""
        shutil.rmtree(self._folder / "models" / name, ignore_errors=True)

    def _log(self, name: str, what: str) -> Path:
        return writable_folder(self._folder / "logs") / f"{name}-{what}.log"


def training_seconds(run_folder: Path) -> float:
    """Seconds from the start of nerfstudio's training loop, when it writes its transform, to the last checkpoint.

    Raises:
        ThermoxelsError: The run has not written them.
    """
    start = run_folder / "dataparser_transforms.json"
    checkpoints = sorted((run_folder / "nerfstudio_models").glob("step-*.ckpt"))
    if not (start.is_file() and checkpoints):
        raise ThermoxelsError(
            str(run_folder),
            expected="dataparser_transforms.json and a checkpoint of a finished run",
            got="a folder without them",
            remedy="Look into the run's log.",
        )
    return checkpoints[-1].stat().st_mtime - start.stat().st_mtime


def read_evaluation(path: Path) -> dict[str, float]:
    """The figures that ns-eval wrote; NaN for those that the scene or the method does not have.

    Raises:
        ThermoxelsError: The file is missing or not ns-eval's.
    """
    try:
        results = json.loads(path.read_text(encoding="utf-8"))["results"]
        return {name: float(results.get(name, math.nan)) for name in _EVALUATED}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as problem:
        raise ThermoxelsError(
            str(path),
            expected="the results of ns-eval",
            got=f"{type(problem).__name__}: {problem}",
            remedy="Start the command again; finished runs are kept.",
        ) from problem
