"""The command ``thermoxels cost``: train a scene at several settings and say what accuracy costs in time and memory."""

from __future__ import annotations

import math
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import tyro

from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING, run_command
from thermoxels_ns.core.checks import check_positive, hold_folder, writable_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import read_json_object, write_json
from thermoxels_ns.core.version import __version__

FIGURES = {
    "seconds": ("ns-train", "{:.0f} s"),
    "peak_memory_gb": ("memory", "{:.1f} GB"),
    "psnr": ("RGB PSNR", "{:.1f} dB"),
    "thermal_mae_c": ("thermal MAE", "{:.2f} °C"),
    "fscore_128": ("F-score, 1.5 of 128 voxels", "{:.2f}"),
    "surface_distance_m": ("surface distance", "{:.3f} m"),
    "half_transparent": ("half-transparent rays", "{:.1%}"),
}
"""Measured figures by their name in cost.json, with the heading and form that the table shows. Time and memory are
those of ns-train; the others are what ns-eval says of held-out views and, for drawn scenes, of the surface."""
_RUNS = "cost.json"
_GROUPS = ("density", "sh", "temperature", "background", "corrections")

Row = Mapping[str, Any]
"""Figures of a run by the names of `FIGURES`, None if not measured, and under "training" the command that trains it."""


@dataclass
class Cost:
    """Train a scene at several settings and say what accuracy costs: a table of seconds and memory against errors of
    image, temperature and, for drawn scenes, surface.

    Finished runs are kept in cost.json in the output folder, so that an interrupted command continues where it stopped;
    remove the file to measure again. The machine should do nothing else, and have trained once before."""

    scene: tyro.conf.Positional[Path]
    """Scene folder."""
    output_dir: Path = Path("cost")
    """Folder for cost.json and logs."""
    settings: tuple[str, ...] = ("32:400", "128:800")
    """Settings to train, each as resolution:steps: voxels along the longest side of the scene box, and training steps;
    the training schedule is scaled to both. May be empty."""
    qualities: tuple[str, ...] = ("draft", "standard", "fine")
    """Named qualities of ns-train to train as well. May be empty."""
    methods: tuple[str, ...] = ("thermoxels",)
    """Training methods, such as plenoxels-t; each trains all settings and qualities."""
    target_mae: float | None = None
    """Name the cheapest setting whose thermal MAE is at most this, [degrees Celsius]."""

    def main(self) -> None:
        """Measure and report; raises `ThermoxelsError` if an option or the scene cannot be used, or a run failed."""
        if self.target_mae is not None:
            check_positive("target_mae", self.target_mae, "Correct --target-mae, or leave it out.")
        options = {text: training_options(text) for text in self.settings}
        options |= {quality: ("--quality", quality) for quality in self.qualities}
        if not options:
            remedy = "Pass --settings 64:800."
            raise ThermoxelsError("settings", expected="a setting or a quality", got="none", remedy=remedy)
        if not self.methods:
            raise ThermoxelsError("methods", expected="a method", got="none", remedy="Pass --methods thermoxels.")
        if not self.scene.is_dir():
            raise SceneError(
                "scene", expected="a scene folder", got=f"none at {self.scene}", remedy="Correct the path."
            )
        folder, scene, rows, failed = writable_folder(self.output_dir), str(self.scene.resolve()), dict[str, Row](), []
        path, remedy = folder / _RUNS, "Remove the file to measure again, or choose another --output-dir."
        with hold_folder(folder / ".lock", "Wait for it, or pass another --output-dir.", print):
            runs = read_json_object(path, remedy) if path.is_file() else {}
            for method in self.methods:
                for setting, words in options.items():
                    name = setting if method == self.methods[0] else f"{setting}, {method}"
                    training = shlex.join(["ns-train", method, *words, "--data", scene])
                    run = f"Thermoxels {__version__}: {training}"
                    if run in runs:
                        print(f"{name} is in {path} already; remove the file to measure again.")
                    else:
                        try:
                            runs[run] = _measure(self.scene, method, words, name, folder)
                        except ThermoxelsError as problem:
                            failed.append(f"{name}: {problem}")
                            print(f"{name} failed: {problem}")
                            continue
                        write_json(path, runs)
                    rows[name] = {"training": training, **runs[run]}
        for line in [*table_of(rows), "", *([] if self.target_mae is None else [cheapest(rows, self.target_mae)])]:
            print(line)
        if failed:
            remedy = "Start the command again to repeat them. " + "\n".join(failed)
            raise ThermoxelsError(
                "cost", expected="every run to finish", got=f"{len(failed)} that did not", remedy=remedy
            )


def training_options(setting: str) -> tuple[str, ...]:
    """Return ns-train's options for a setting ``resolution:steps`` (voxels, steps); other texts: `ThermoxelsError`."""
    from thermoxels_ns.training.schedule import schedule_for

    match = re.fullmatch(r"([1-9]\d*):([1-9]\d*)", setting)
    if match is None:
        remedy = "Pass --settings 64:800 128:1500."
        raise ThermoxelsError("settings", expected="voxels and steps, such as 64:800", got=repr(setting), remedy=remedy)
    schedule = schedule_for(int(match[1]), int(match[2]))
    words = ["--max-num-iterations", str(schedule.steps)]
    for group in _GROUPS:
        words += [f"--optimizers.{group}.scheduler.max-steps", str(schedule.steps)]
    for name in ("resolutions", "refine_at", "prune_at", "thin_at", "distortion_ramp"):
        words += [f"--pipeline.model.{name.replace('_', '-')}", *map(str, getattr(schedule, name))]
    return (*words, "--pipeline.model.view-dependence-from", str(schedule.view_dependence_from))


def table_of(rows: Mapping[str, Row]) -> list[str]:
    """Return the lines of a Markdown table, one row per setting; columns that are empty in all rows are left out."""
    names = [name for name in FIGURES if any(row[name] is not None for row in rows.values())]
    lines = [" | ".join(["| setting", *(FIGURES[name][0] for name in names)]) + " |", "|---|" + "---:|" * len(names)]
    for setting, row in rows.items():
        cells = ["-" if row[name] is None else FIGURES[name][1].format(row[name]) for name in names]
        lines.append(" | ".join([f"| {setting}", *cells]) + " |")
    return lines


def cheapest(rows: Mapping[str, Row], target_mae: float) -> str:
    """Return a sentence that names the fastest setting whose thermal MAE is at most `target_mae`, [degrees Celsius]."""
    wanted = f"a thermal MAE of at most {target_mae:g} °C"
    able = [
        name for name, row in rows.items() if row["thermal_mae_c"] is not None and row["thermal_mae_c"] <= target_mae
    ]
    if not able:
        return f"No measured setting has {wanted}. Measure more steps or voxels with --settings, or relax the target."
    best = min(able, key=lambda name: rows[name]["seconds"])
    return f"Cheapest setting with {wanted}: {best}. Train with: {rows[best]['training']}"


def _measure(scene: Path, method: str, words: Sequence[str], name: str, folder: Path) -> dict[str, float | None]:
    """Train with the options `words`, evaluate, delete the model, and return all `FIGURES`; None: not measured.

    Logs go to the subfolder logs of `folder`. Raises `ThermoxelsError` if a command fails.
    """
    name, logs = re.sub(r"[^0-9A-Za-z.-]+", "-", name), writable_folder(folder / "logs")
    output = logs / f"{name}.json"
    with TemporaryDirectory(dir=folder) as models:
        train = ["ns-train", method, "--data", str(scene), "--output-dir", models, "--experiment-name", name]
        trained = run_command([*train, *PLAIN_TRAINING, *words], logs / f"{name}-train.log", sys.stdout)
        config = str(Path(models) / name / method / "run" / "config.yml")
        evaluate = ["ns-eval", "--load-config", config, "--output-path", str(output)]
        run_command(evaluate, logs / f"{name}-eval.log", sys.stdout)
    found = trained._asdict() | read_json_object(output, "Start the command again; finished runs are kept.")["results"]
    return {figure: value if math.isfinite(value := found.get(figure, math.nan)) else None for figure in FIGURES}
