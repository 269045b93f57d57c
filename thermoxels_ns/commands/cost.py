"""The command ``thermoxels cost``: what accuracy costs on a scene, from real training runs."""

from __future__ import annotations

import csv
import hashlib
import math
import os
import re
import shlex
import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from thermoxels_ns import __version__
from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING, run_command
from thermoxels_ns.core.checks import check_positive, remedy_of, replace_when_done, writable_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import read_json
from thermoxels_ns.reports.cost_report import (
    FIGURES,
    CostRun,
    CostSetting,
    draw_plot,
    figure_text,
    markdown_table,
    median_rows,
    shown_figures,
    verdict,
    write_csv,
    write_page,
)

if TYPE_CHECKING:
    from rich.console import Console

_RUNS, _TABLE, _PLOT, _PAGE = "runs.csv", "cost.csv", "cost.png", "cost.md"
_EVALUATED = tuple(name for name in FIGURES if name not in ("seconds", "training_seconds", "peak_memory_gb"))
_KEYS = ("setting", "repeat", "scene", "version", "training")
_GROUPS = ("density", "sh", "temperature", "background", "corrections")


@dataclass
class Cost:
    """Train a scene at several settings and report what accuracy costs: seconds and memory against image, temperature
    and surface errors, as csv, plot and a table for a README.

    Finished runs are kept in runs.csv in the output folder; a start that was interrupted goes on where it stopped.
    Run it on an otherwise idle machine."""

    scene: tyro.conf.Positional[Path]
    """Scene folder. For a synthetic scene the surface is compared with the exact one."""
    output_dir: Path = Path("cost")
    """Folder for runs.csv (single runs), cost.csv (medians), cost.png, cost.md and logs."""
    settings: tuple[str, ...] = ("32:400", "128:800")
    """What to train, as resolution:steps, voxels along the longest side of the scene box and training steps; the
    schedule in between is made to fit. May be empty."""
    qualities: tuple[str, ...] = ("draft", "standard", "fine")
    """Named qualities of ns-train to train as well. May be empty."""
    methods: tuple[str, ...] = ("thermoxels",)
    """The first trains all settings and qualities; each further one, such as plenoxels-t, adds a row: the baseline
    with that method."""
    recipes: tuple[str, ...] = ("default",)
    """Loss recipes: the first is that of all rows (default: the method's own); each further one, such as paper, adds a
    row: the baseline with that recipe."""
    baseline: str | None = None
    """Setting or quality that times are related to and that further methods and recipes are trained at. Default:
    standard, or else the one named last."""
    repeats: int = 1
    """Runs of each setting; the table shows medians."""
    target_mae: float | None = None
    """Name the cheapest setting whose thermal MAE is at most this, [degrees Celsius]."""
    target_psnr: float | None = None
    """Name the cheapest setting whose RGB PSNR is at least this, [dB]. With --target-mae both must hold."""
    train_options: str = ""
    """Further options of every ns-train, as one quoted text after an equals sign, for instance
    --train-options="--pipeline.model.near-plane 0.05"."""
    warm_up: bool = True
    """Train the first setting once before anything counts, so that no run pays for compiling kernels."""
    keep_models: bool = False
    """Keep the trained models in the folder models."""
    again: bool = False
    """Measure again what runs.csv already holds, for instance after a change of the program."""

    def main(self) -> None:
        """Measure and report; raises `ThermoxelsError` if an option or the scene cannot be used, or a run failed."""
        from rich.console import Console

        run_cost(self, Console(highlight=False))


def run_cost(cost: Cost, console: Console) -> None:
    """Measure and report, see `Cost`."""

    def say(line: str) -> None:
        console.print(line, markup=False, soft_wrap=True)

    targets = _targets(cost)
    settings, baseline = planned_settings(cost)
    if cost.repeats < 1:
        raise ThermoxelsError("repeats", expected="1 or more", got=cost.repeats, remedy="Pass --repeats 3.")
    if not cost.scene.is_dir():
        raise SceneError("scene", expected="a scene folder", got=f"none at {cost.scene}", remedy="Correct the path.")
    folder, fingerprint = writable_folder(cost.output_dir), scene_fingerprint(cost.scene)

    # Repeats of a setting lie apart in time, so that a slow spell of the machine does not fall on one setting.
    plan = [
        (setting, CostRun(setting.name, repeat, fingerprint, __version__, setting.training, {}))
        for repeat in range(1, cost.repeats + 1)
        for setting in settings
    ]
    keys = {run.key for _, run in plan}
    runs = [run for run in read_runs(folder / _RUNS) if not (cost.again and run.key in keys)]
    known = {run.key for run in runs}
    pending = [(setting, run) for setting, run in plan if run.key not in known]
    if len(pending) < len(plan):
        kept = len(plan) - len(pending)
        say(f"{kept} of {len(plan)} runs are in {folder / _RUNS} already; --again True measures them again.")
    if pending and cost.warm_up:
        first = pending[0][0]
        say(f"Warm-up with {first.name}, not counted ...")
        with suppress(ThermoxelsError):  # its counted run will say why it failed
            measure(cost.scene, first, "warm-up", folder, False, console)
    failed: list[str] = []
    for number, (setting, run) in enumerate(pending, start=1):
        title = setting.name if cost.repeats == 1 else f"{setting.name}, run {run.repeat}"
        say(f"[{number}/{len(pending)}] {title} ...")
        try:
            name = f"{setting.file_name}-{run.repeat}"
            figures = measure(cost.scene, setting, name, folder, cost.keep_models, console)
        except ThermoxelsError as problem:
            failed.append(f"{title}: {problem}")
            say(f"{title} failed: {problem}")
            continue
        runs.append(replace(run, figures=figures))
        write_runs(folder / _RUNS, runs)
        shown = (f"{FIGURES[name].heading} {figure_text(name, figures[name])}" for name in shown_figures([figures]))
        say(f"{title}: {', '.join(shown)}")
    counted = [run for run in runs if run.key in keys]
    if counted:
        rows = median_rows(settings, counted, baseline)
        counts = sorted({row.repeats for row in rows})
        medians = "one run each" if counts == [1] else f"medians of {' or '.join(map(str, counts))} runs"
        scene, machine = cost.scene.resolve().name, f"a machine with {os.cpu_count()} processors"
        words = [markdown_table(rows, baseline)]
        words.append(f"{scene}: {medians} on {machine}; memory is that of the ns-train process.")
        words += [verdict(rows, targets, cost.scene)] if targets else []
        write_csv(folder / _TABLE, rows, baseline)
        draw_plot(folder / _PLOT, rows, targets, f"What accuracy costs: {scene}")
        write_page(folder / _PAGE, words)
        for text in ("", *words, f"Written to {folder}: {', '.join((_TABLE, _PLOT, _PAGE, _RUNS))}"):
            say(text)
    if failed:
        remedy = "Start the command again to repeat them. " + "\n".join(failed)
        raise ThermoxelsError("cost", expected="every run to finish", got=f"{len(failed)} that did not", remedy=remedy)


def planned_settings(cost: Cost) -> tuple[list[CostSetting], str]:
    """The rows of the table, and the name of the baseline among them."""
    for name in ("methods", "recipes"):
        if not getattr(cost, name):
            remedy = f"Leave out --{name} for the default."
            raise ThermoxelsError(name, expected="at least one", got="none", remedy=remedy)
    try:
        further = tuple(shlex.split(cost.train_options))
    except ValueError as problem:
        expected, remedy = "words as in a shell", "Close the quotes."
        raise ThermoxelsError("train_options", expected=expected, got=str(problem), remedy=remedy) from problem

    words = {text: tuple(training_options(*parse_setting(text))) for text in cost.settings}
    words |= {quality: ("--quality", quality) for quality in cost.qualities}
    if not words:
        remedy = "Pass --settings 64:800."
        raise ThermoxelsError("settings", expected="a setting or a quality", got="none", remedy=remedy)
    baseline = cost.baseline or ("standard" if "standard" in words else [*words][-1])
    if baseline not in words:
        expected = f"one of {', '.join(words)}"
        raise ThermoxelsError("baseline", expected=expected, got=baseline, remedy="Name one of them.")

    def row(of: str, method: str, recipe: str, kind: str = "") -> CostSetting:
        # The default is the method's own recipe, which needs no option.
        recipe_words = () if recipe == "default" else ("--pipeline.model.recipe", recipe)
        return CostSetting(f"{of}{kind}", method, (*words[of], *recipe_words, *further))

    (method, *methods), (recipe, *recipes) = dict.fromkeys(cost.methods), dict.fromkeys(cost.recipes)
    rows = [row(name, method, recipe) for name in words]
    rows += [row(baseline, other, recipe, f", {other}") for other in methods]
    rows += [row(baseline, method, other, f", recipe {other}") for other in recipes]
    return rows, baseline


def _targets(cost: Cost) -> dict[str, float]:
    """The bounds that were given, by the names of figures."""
    for name in ("target_mae", "target_psnr"):
        value = getattr(cost, name)
        if value is not None:
            check_positive(name, value, f"Correct --{name.replace('_', '-')}, or leave it out.")
    bounds = {"thermal_mae_c": cost.target_mae, "psnr": cost.target_psnr}
    return {name: bound for name, bound in bounds.items() if bound is not None}


def parse_setting(text: str) -> tuple[int, int]:
    """Read ``resolution:steps``, or raise a `ThermoxelsError`.

    >>> parse_setting("64:800")
    (64, 800)
    """
    match = re.fullmatch(r"([1-9]\d*):([1-9]\d*)", text)
    if match is None:
        remedy = "Pass --settings 64:800 128:1500."
        raise ThermoxelsError("settings", expected="voxels and steps, such as 64:800", got=repr(text), remedy=remedy)
    return int(match[1]), int(match[2])


def training_options(resolution: int, steps: int) -> list[str]:
    """Options of ns-train for a final resolution and a number of steps."""
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
    """Read the finished runs; none if there is no file yet."""
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
        expected = "the finished runs of an earlier start"
        got = f"{type(problem).__name__}: {problem}"
        remedy = remedy_of(problem, "Remove the file to measure again, or choose another --output-dir.")
        raise ThermoxelsError(str(path), expected=expected, got=got, remedy=remedy) from problem


def write_runs(path: Path, runs: Iterable[CostRun]) -> None:
    """Write the finished runs; an interrupted write leaves the old file."""
    with replace_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*_KEYS, *FIGURES])
        for run in runs:
            figures = [run.figures[name] for name in FIGURES]
            writer.writerow([getattr(run, key) for key in _KEYS] + ["" if math.isnan(v) else repr(v) for v in figures])


def measure(
    scene: Path, setting: CostSetting, name: str, folder: Path, keep_model: bool, console: Console
) -> dict[str, float]:
    """Train a setting anew and evaluate it, under a name of its own; returns figures by the names in `FIGURES`."""
    models, logs, evaluations = (writable_folder(folder / part) for part in ("models", "logs", "eval"))
    shutil.rmtree(models / name, ignore_errors=True)
    run_folder, output = models / name / setting.method / "run", evaluations / f"{name}.json"
    train = ["ns-train", setting.method, "--data", scene, "--output-dir", models, "--experiment-name", name]
    evaluate = ["ns-eval", "--load-config", run_folder / "config.yml", "--output-path", output]
    try:
        cost = run_command([*train, *PLAIN_TRAINING, *setting.options], logs / f"{name}-train.log", console)
        run_command(evaluate, logs / f"{name}-eval.log", console)
        figures = {"seconds": cost.seconds, "peak_memory_gb": cost.peak_memory_gb}
        return figures | {"training_seconds": training_seconds(run_folder), **read_evaluation(output)}
    finally:
        if not keep_model:
            shutil.rmtree(models / name, ignore_errors=True)


def training_seconds(run_folder: Path) -> float:
    """Seconds from the start of nerfstudio's training loop, when it writes its transform, to the last checkpoint."""
    start = run_folder / "dataparser_transforms.json"
    checkpoints = sorted((run_folder / "nerfstudio_models").glob("step-*.ckpt"))
    if not (start.is_file() and checkpoints):
        expected = "dataparser_transforms.json and a checkpoint of a finished run"
        remedy = "Look into the run's log."
        raise ThermoxelsError(str(run_folder), expected=expected, got="a folder without them", remedy=remedy)
    return checkpoints[-1].stat().st_mtime - start.stat().st_mtime


def read_evaluation(path: Path) -> dict[str, float]:
    """The figures that ns-eval wrote; NaN for those that the scene or the method does not have."""
    expected, remedy = "the results of ns-eval", "Start the command again; finished runs are kept."
    content = read_json(path, expected, remedy)
    try:
        return {name: float(content["results"].get(name, math.nan)) for name in _EVALUATED}
    except (ValueError, KeyError, TypeError, AttributeError) as problem:
        got = f"{type(problem).__name__}: {problem}"
        raise ThermoxelsError(str(path), expected=expected, got=got, remedy=remedy) from problem
