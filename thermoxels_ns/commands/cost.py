"""The command ``thermoxels cost``: what accuracy costs on a scene, from real training runs."""

from __future__ import annotations

import csv
import hashlib
import math
import os
import re
import shlex
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from thermoxels_ns import __version__
from thermoxels_ns.commands.installed_commands import ProcessCost, Watch, run_command
from thermoxels_ns.core.checks import check_positive, remedy_of, replace_when_done, writable_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import read_json
from thermoxels_ns.reports.cost_report import (
    FIGURES,
    CostRun,
    CostSetting,
    Targets,
    draw_plot,
    markdown_table,
    median_rows,
    verdict,
    write_csv,
)

if TYPE_CHECKING:
    from rich.console import Console

_RUNS, _TABLE, _PLOT, _PAGE = "runs.csv", "cost.csv", "cost.png", "cost.md"
_QUIET_S = 60.0
_EVALUATED = tuple(FIGURES)[3:]
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
    """Train the quickest setting once before anything counts, so that no run pays for compiling kernels."""
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
    targets = _targets(cost)
    settings, baseline = planned_settings(cost)
    if cost.repeats < 1:
        raise ThermoxelsError("repeats", expected="1 or more", got=cost.repeats, remedy="Pass --repeats 3.")
    folder = writable_folder(cost.output_dir)
    bench = Bench(cost.scene, folder, cost.keep_models)

    # Repeats of a setting lie apart in time, so that a slow spell of the machine does not fall on one setting.
    plan = [(setting, repeat) for repeat in range(1, cost.repeats + 1) for setting in settings]
    keys = {bench.planned(*pair).key for pair in plan}
    runs = [run for run in read_runs(folder / _RUNS) if not (cost.again and run.key in keys)]
    known = {run.key for run in runs}
    pending = [pair for pair in plan if bench.planned(*pair).key not in known]
    if len(pending) < len(plan):
        kept = len(plan) - len(pending)
        console.print(f"{kept} of {len(plan)} runs are in {folder / _RUNS} already; --again True measures them again.")
    failed: list[str] = []
    if pending:
        display = _Display(console, len(pending))
        if cost.warm_up:
            _warm_up(bench, [setting for setting, _ in pending], display)
        for setting, repeat in pending:
            title = setting.name if cost.repeats == 1 else f"{setting.name}, run {repeat}"
            try:
                with display.run(title) as watch:
                    run = bench.measure(setting, repeat, watch)
            except ThermoxelsError as problem:
                failed.append(f"{title}: {problem}")
                display.say(f"{title} failed: {problem}")
                continue
            runs.append(run)
            write_runs(folder / _RUNS, runs)
            display.say(f"{title}: {_in_words(run)}")
    counted = [run for run in runs if run.key in keys]
    if counted:
        _report(cost, folder, settings, counted, baseline, targets, console)
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

    words: dict[str, tuple[str, ...]] = {}
    work: dict[str, float] = {}
    for text in cost.settings:
        resolution, steps = parse_setting(text)
        words[text] = tuple(training_options(resolution, steps))
        work[text] = float(resolution**2 * steps)
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
        options = (*words[of], *recipe_words, *further)
        return CostSetting(f"{of}{kind}", method, options, work.get(of, math.inf), beside=bool(kind))

    (method, *methods), (recipe, *recipes) = dict.fromkeys(cost.methods), dict.fromkeys(cost.recipes)
    rows = [row(name, method, recipe) for name in words]
    rows += [row(baseline, other, recipe, f", {other}") for other in methods]
    rows += [row(baseline, method, other, f", recipe {other}") for other in recipes]
    return rows, baseline


def _targets(cost: Cost) -> Targets:
    for name in ("target_mae", "target_psnr"):
        value = getattr(cost, name)
        if value is not None:
            check_positive(name, value, f"Correct --{name.replace('_', '-')}, or leave it out.")
    return Targets(cost.target_mae, cost.target_psnr)


def _warm_up(bench: Bench, settings: Sequence[CostSetting], display: _Display) -> None:
    """Train the quickest setting once and forget it; if it fails, its counted run will say why."""
    setting = min(settings, key=lambda setting: setting.work)
    name = "warm-up"
    with display.run(f"warm-up with {setting.name}, not counted", counts=False) as watch:
        try:
            bench.train(setting, name, watch)
        except ThermoxelsError:
            display.say("The warm-up failed.")
        finally:
            bench.discard(name)


def _in_words(run: CostRun) -> str:
    figures = run.figures
    parts = (
        ("{:.1f} s", figures["seconds"]),
        ("training {:.1f} s", figures["training_seconds"]),
        ("{:.2f} GB", figures["peak_memory_gb"]),
        ("{:.2f} dB", figures["psnr"]),
        ("{:.3f} °C", figures["thermal_mae_c"]),
        ("F-score {:.3f}", figures["fscore_128"]),
    )
    return ", ".join(form.format(value) for form, value in parts if value == value)


def _report(
    cost: Cost,
    folder: Path,
    settings: Sequence[CostSetting],
    runs: Sequence[CostRun],
    baseline: str,
    targets: Targets,
    console: Console,
) -> None:
    """Write and print the table, the plot and which setting will do."""
    rows = median_rows(settings, runs, baseline)
    counts = sorted({row.repeats for row in rows})
    medians = "one run each" if counts == [1] else f"medians of {' or '.join(map(str, counts))} runs"
    scene = cost.scene.resolve().name
    note = f"{scene}: {medians} on a machine with {os.cpu_count()} processors; memory is that of the ns-train process."
    words = [markdown_table(rows, baseline), note]
    if targets.words:
        words.append(verdict(rows, targets, cost.scene))
    write_csv(folder / _TABLE, rows, baseline)
    draw_plot(folder / _PLOT, rows, targets, f"What accuracy costs: {scene}")
    with replace_when_done(folder / _PAGE) as temporary:
        temporary.write_text("\n\n".join(words) + "\n", encoding="utf-8")
    for text in ("", *words):
        console.print(text, markup=False, soft_wrap=True)
    console.print(f"Written to {folder}: {', '.join((_TABLE, _PLOT, _PAGE, _RUNS))}", markup=False, soft_wrap=True)


class _Display:
    """Says which run is at work: in the last line of a terminal, in a line a minute elsewhere."""

    def __init__(self, console: Console, total: int) -> None:
        self._console, self._total, self._done = console, total, 0

    def say(self, line: str) -> None:
        self._console.print(line, markup=False, soft_wrap=True)

    @contextmanager
    def run(self, title: str, counts: bool = True) -> Iterator[Watch]:
        """Show a run; gives what is to be called with the share that is done."""
        start = told = time.monotonic()
        name = f"[{self._done + 1}/{self._total}] {title}" if counts else title
        self.say(f"{name} ...")
        with self._console.status("at work") as status:

            def watch(share: float | None) -> None:
                nonlocal told
                done = "" if share is None else f", {share:.0%} of the training done"
                line = f"... at work for {time.monotonic() - start:.0f} s{done}"
                status.update(line)
                if not self._console.is_terminal and time.monotonic() - told > _QUIET_S:
                    told = time.monotonic()
                    self.say(line)

            self._done += counts
            yield watch


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


class Bench:
    """Runs settings on one scene, each in a folder of its own that goes when it is done."""

    def __init__(self, scene: Path, folder: Path, keep_models: bool = False) -> None:
        """Remember where things go; refuse a scene folder that is not there."""
        if not scene.is_dir():
            raise SceneError("scene", expected="a scene folder", got=f"none at {scene}", remedy="Correct the path.")
        self.scene, self.fingerprint = scene, scene_fingerprint(scene)
        self._folder, self._keep = folder, keep_models

    def planned(self, setting: CostSetting, repeat: int) -> CostRun:
        """The run as it will be remembered, still without figures."""
        return CostRun(setting.name, repeat, self.fingerprint, __version__, setting.training, {})

    def train(self, setting: CostSetting, name: str, watch: Watch) -> tuple[Path, ProcessCost]:
        """Train a setting anew; returns the run's folder, as nerfstudio makes it, and what the command took."""
        models = writable_folder(self._folder / "models")
        shutil.rmtree(models / name, ignore_errors=True)
        words = [
            *("ns-train", setting.method, "--data", str(self.scene), "--output-dir", str(models)),
            *("--experiment-name", name, "--timestamp", "run", "--vis", "tensorboard"),
            # One line every fifty steps instead of a block that is drawn over and over.
            *("--logging.steps-per-log", "50", "--logging.local-writer.max-log-size", "0"),
            *("--logging.profiler", "none", *setting.options),
        ]
        cost = run_command(words, self._log(name, "train"), watch=watch)
        return models / name / setting.method / "run", cost

    def measure(self, setting: CostSetting, repeat: int, watch: Watch) -> CostRun:
        """Train and evaluate a setting."""
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
            run_command(words, self._log(name, "eval"), watch=lambda _: watch(None))
            figures |= read_evaluation(output)
        finally:
            if not self._keep:
                self.discard(name)
        return CostRun(*self.planned(setting, repeat).key, figures=figures)

    def discard(self, name: str) -> None:
        """Remove a run's model."""
        shutil.rmtree(self._folder / "models" / name, ignore_errors=True)

    def _log(self, name: str, what: str) -> Path:
        return writable_folder(self._folder / "logs") / f"{name}-{what}.log"


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
