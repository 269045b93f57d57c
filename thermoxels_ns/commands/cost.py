"""The command ``thermoxels cost``: what accuracy costs on a scene, from real training runs."""

from __future__ import annotations

import csv
import hashlib
import html
import math
import os
import re
import shlex
import shutil
import statistics
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import tyro

from thermoxels_ns import __version__
from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING, run_command
from thermoxels_ns.core.checks import check_positive, remedy_of, replace_when_done, writable_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import read_json

if TYPE_CHECKING:
    from rich.console import Console


class Figure(NamedTuple):
    """How a measured figure is shown."""

    heading: str = ""  # Of its column in the table; a figure without one is in the csv file alone
    form: str = ""
    higher_is_better: bool = False
    panel: str = ""  # Title of its panel in the plot; a figure without one has no panel
    short: str = ""  # Its name in the column of Pareto fronts; a figure without one has no front


FIGURES: Mapping[str, Figure] = {
    # From the first training step to the last checkpoint.
    "training_seconds": Figure("training", "{:.0f} s"),
    # Wall time of the whole ns-train command, from its start to its end.
    "seconds": Figure("ns-train", "{:.0f} s"),
    # Of the held-out views: RGB PSNR [dB] and SSIM, and mean absolute temperature error [degrees Celsius].
    "psnr": Figure("RGB PSNR", "{:.1f} dB", True, "RGB PSNR [dB], higher is better", "PSNR"),
    "ssim": Figure(),
    "thermal_mae_c": Figure("thermal MAE", "{:.2f} °C", False, "thermal MAE [°C], lower is better", "MAE"),
    # Of the surface: F-score at 1.5 voxels of a lattice of 128 voxels, and of the setting's own lattice.
    "fscore_128": Figure(
        *("F-score, 1.5 of 128 voxels", "{:.2f}", True, "surface F-score at 1.5 of 128 voxels, higher is better")
    ),
    "fscore": Figure("F-score, 1.5 own voxels", "{:.2f}"),
    "precision": Figure(),
    "recall": Figure(),
    # Mean distance of the surface to the true one, voxels of the setting's own lattice, and metres.
    "surface_distance_voxels": Figure("surface distance", "{:.2f} voxels"),
    "surface_distance_m": Figure(),
    # Share of rays that are neither through nor stopped.
    "half_transparent": Figure("half-transparent rays", "{:.1%}"),
    # Largest resident memory of the ns-train process, 1e9 bytes.
    "peak_memory_gb": Figure("memory", "{:.1f} GB", False, "peak memory [GB], lower is better"),
}
"""What is measured, by the name of its column."""
FRONTS = tuple(name for name, figure in FIGURES.items() if figure.short)
_EVALUATED = tuple(name for name in FIGURES if name not in ("seconds", "training_seconds", "peak_memory_gb"))
_TARGETS = {"thermal_mae_c": "a thermal MAE of at most {:g} °C", "psnr": "an RGB PSNR of at least {:g} dB"}
_RUNS, _TABLE, _PLOT, _PAGE = "runs.csv", "cost.csv", "cost.png", "cost.md"
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


class CostSetting(NamedTuple):
    """One way to train."""

    name: str  # What the user calls it, for instance ``64:800``, ``standard`` or ``standard, recipe paper``
    method: str
    options: tuple[str, ...]

    def command(self, *scene: str) -> str:
        """Write how to train with it as typed in a shell; `scene` are the words that say on what, if any."""
        return shlex.join(["ns-train", self.method, *scene, *self.options])


class RunKey(NamedTuple):
    """What a run measures: two runs with equal keys measure the same."""

    setting: str
    repeat: int  # From 1
    scene: str  # Fingerprint of the scene
    version: str  # Of this package
    training: str  # The words of ns-train


Figures = dict[str, float]
"""Measured figures by the names in `FIGURES`; NaN where the scene or the method has none."""


class CostRow(NamedTuple):
    """A setting, and the medians of its runs."""

    setting: CostSetting
    repeats: int
    figures: Figures
    time_ratio: float  # Median wall time over that of the baseline; NaN if the baseline has no run
    fronts: tuple[str, ...]  # Those of `FRONTS` in which no other setting is better without being slower


def run_cost(cost: Cost, console: Console) -> None:
    """Train and evaluate every setting that runs.csv does not hold, and write table, plot and page; see `Cost`."""

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
    plan = {
        RunKey(setting.name, repeat, fingerprint, __version__, setting.command()): setting
        for repeat in range(1, cost.repeats + 1)
        for setting in settings
    }
    runs = {key: found for key, found in read_runs(folder / _RUNS).items() if not (cost.again and key in plan)}
    pending = [key for key in plan if key not in runs]
    if len(pending) < len(plan):
        kept = len(plan) - len(pending)
        say(f"{kept} of {len(plan)} runs are in {folder / _RUNS} already; --again True measures them again.")
    if pending and cost.warm_up:
        first = plan[pending[0]]
        say(f"Warm-up with {first.name}, not counted ...")
        with suppress(ThermoxelsError):  # its counted run will say why it failed
            measure(cost.scene, first, "warm-up", folder, False, console)
    failed: list[str] = []
    for number, key in enumerate(pending, start=1):
        title = key.setting if cost.repeats == 1 else f"{key.setting}, run {key.repeat}"
        say(f"[{number}/{len(pending)}] {title} ...")
        try:
            name = re.sub(r"[^0-9A-Za-z.-]+", "-", f"{key.setting}-{key.repeat}")
            runs[key] = measure(cost.scene, plan[key], name, folder, cost.keep_models, console)
        except ThermoxelsError as problem:
            failed.append(f"{title}: {problem}")
            say(f"{title} failed: {problem}")
            continue
        write_runs(folder / _RUNS, runs)
        shown = (f"{FIGURES[of].heading} {_text(runs[key], of)}" for of in shown_figures([runs[key]]))
        say(f"{title}: {', '.join(shown)}")
    rows = median_rows(settings, {key: runs[key] for key in plan if key in runs}, baseline)
    if rows:
        counts = sorted({row.repeats for row in rows})
        medians = "one run each" if counts == [1] else f"medians of {' or '.join(map(str, counts))} runs"
        scene, machine = cost.scene.resolve().name, f"a machine with {os.cpu_count()} processors"
        words = [markdown_table(rows, baseline)]
        words.append(f"{scene}: {medians} on {machine}; memory is that of the ns-train process.")
        words += [verdict(rows, targets, cost.scene)] if targets else []
        write_table(folder / _TABLE, rows, baseline)
        draw_plot(folder / _PLOT, rows, targets, f"What accuracy costs: {scene}")
        with replace_when_done(folder / _PAGE) as temporary:  # markup in names stays words
            temporary.write_text(html.escape("\n\n".join(words), quote=False) + "\n", encoding="utf-8")
        for text in ("", *words, f"Written to {folder}: {', '.join((_TABLE, _PLOT, _PAGE, _RUNS))}"):
            say(text)
    if failed:
        remedy = "Start the command again to repeat them. " + "\n".join(failed)
        raise ThermoxelsError("cost", expected="every run to finish", got=f"{len(failed)} that did not", remedy=remedy)


def planned_settings(cost: Cost) -> tuple[list[CostSetting], str]:
    """Give the rows of the table, and the name of the baseline among them."""
    try:
        further = tuple(shlex.split(cost.train_options))
    except ValueError as problem:
        expected, remedy = "words as in a shell", "Close the quotes."
        raise ThermoxelsError("train_options", expected=expected, got=str(problem), remedy=remedy) from problem

    words = {text: training_options(text) for text in cost.settings}
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

    method, *methods = dict.fromkeys(cost.methods or ("thermoxels",))
    recipe, *recipes = dict.fromkeys(cost.recipes or ("default",))
    rows = [row(name, method, recipe) for name in words]
    rows += [row(baseline, other, recipe, f", {other}") for other in methods]
    rows += [row(baseline, method, other, f", recipe {other}") for other in recipes]
    return rows, baseline


def _targets(cost: Cost) -> dict[str, float]:
    """Check the bounds that were given, and give them by the names of figures."""
    bounds = {"thermal_mae_c": ("target_mae", cost.target_mae), "psnr": ("target_psnr", cost.target_psnr)}
    return {
        figure: check_positive(name, value, f"Correct --{name.replace('_', '-')}, or leave it out.")
        for figure, (name, value) in bounds.items()
        if value is not None
    }


def training_options(setting: str) -> tuple[str, ...]:
    """Give the options of ns-train for a setting ``resolution:steps``, or raise a `ThermoxelsError`."""
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


def scene_fingerprint(scene: Path) -> str:
    """Hash the names and sizes of all files of a scene, and the contents of the json files beside the photographs."""
    digest = hashlib.sha256()
    for path in sorted(path for path in scene.rglob("*") if path.is_file()):
        digest.update(f"{path.relative_to(scene).as_posix()} {path.stat().st_size}\n".encode())
        if path.parent == scene and path.suffix == ".json":
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def read_runs(path: Path) -> dict[RunKey, Figures]:
    """Read the finished runs, none if there is no file yet; raises `ThermoxelsError` for a file that is damaged."""
    if not path.is_file():
        return {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, strict=True)
            if missing := {*RunKey._fields, *FIGURES} - set(reader.fieldnames or ()):
                raise ValueError(f"no column {', '.join(sorted(missing))}")
            return {
                RunKey(**{**{name: row[name] for name in RunKey._fields}, "repeat": int(row["repeat"])}): {
                    name: float(row[name] or "nan") for name in FIGURES
                }
                for row in reader
            }
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as problem:
        expected = "the finished runs of an earlier start"
        got = f"{type(problem).__name__}: {problem}"
        remedy = remedy_of(problem, "Remove the file to measure again, or choose another --output-dir.")
        raise ThermoxelsError(str(path), expected=expected, got=got, remedy=remedy) from problem


def write_runs(path: Path, runs: Mapping[RunKey, Figures]) -> None:
    """Write the finished runs; an interrupted write leaves the old file."""
    _write_csv(path, [*RunKey._fields, *FIGURES], ([*key, *_cells(figures)] for key, figures in runs.items()))


def write_table(path: Path, rows: Iterable[CostRow], baseline: str) -> None:
    """Write the rows with all figures."""
    fronts = [f"front_{name}" for name in FRONTS]
    lines = []
    for row in rows:
        ratio = "" if math.isnan(row.time_ratio) else f"{row.time_ratio:.6g}"
        marks = [int(name in row.fronts) for name in FRONTS]
        one = row.setting
        lines.append([one.name, row.repeats, *_cells(row.figures), ratio, baseline, *marks, one.command()])
    _write_csv(path, ["setting", "repeats", *FIGURES, "time_ratio", "baseline", *fronts, "training"], lines)


def _cells(figures: Figures) -> list[str]:
    """Write all figures in their order; cells are empty where there is nothing to measure."""
    return ["" if math.isnan(figures[name]) else f"{figures[name]:.6g}" for name in FIGURES]


def _write_csv(path: Path, head: Sequence[str], lines: Iterable[Sequence[object]]) -> None:
    with replace_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([head, *lines])


def measure(scene: Path, setting: CostSetting, name: str, folder: Path, keep_model: bool, console: Console) -> Figures:
    """Train a setting anew and evaluate it, under a name of its own."""
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
    """Give the seconds from the start of nerfstudio's loop, when it writes its transform, to the last checkpoint."""
    start = run_folder / "dataparser_transforms.json"
    checkpoints = sorted((run_folder / "nerfstudio_models").glob("step-*.ckpt"))
    if not (start.is_file() and checkpoints):
        expected = "dataparser_transforms.json and a checkpoint of a finished run"
        remedy = "Look into the run's log."
        raise ThermoxelsError(str(run_folder), expected=expected, got="a folder without them", remedy=remedy)
    return checkpoints[-1].stat().st_mtime - start.stat().st_mtime


def read_evaluation(path: Path) -> Figures:
    """Read the figures that ns-eval wrote; NaN for those that the scene or the method does not have."""
    expected, remedy = "the results of ns-eval", "Start the command again; finished runs are kept."
    content = read_json(path, expected, remedy)
    try:
        return {name: float(content["results"].get(name, math.nan)) for name in _EVALUATED}
    except (ValueError, KeyError, TypeError, AttributeError) as problem:
        got = f"{type(problem).__name__}: {problem}"
        raise ThermoxelsError(str(path), expected=expected, got=got, remedy=remedy) from problem


def _text(figures: Figures, name: str) -> str:
    """Write a figure with its unit; NaN is a dash."""
    return "-" if math.isnan(figures[name]) else FIGURES[name].form.format(figures[name])


def shown_figures(figures: Sequence[Figures]) -> list[str]:
    """Name the figures that the table shows, without those that no run has."""
    return [name for name, one in FIGURES.items() if one.heading and not all(math.isnan(f[name]) for f in figures)]


def pareto_front(figures: Sequence[Figures], name: str) -> list[bool]:
    """Mark the points, seconds against a figure, that no other point beats: one that is no slower and no worse.

    A point whose figure is NaN is not on the front and beats none.
    """
    sign = -1.0 if FIGURES[name].higher_is_better else 1.0
    points = [(one["seconds"], sign * one[name]) for one in figures]
    valid = [p for p in points if not any(map(math.isnan, p))]
    return [p in valid and not any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in valid) for p in points]


def median_rows(settings: Iterable[CostSetting], runs: Mapping[RunKey, Figures], baseline: str) -> list[CostRow]:
    """Make a row of every setting that has a run; seconds are related to those of the setting `baseline`."""
    of_setting = {one: [found for key, found in runs.items() if key.setting == one.name] for one in settings}
    of_setting = {setting: own for setting, own in of_setting.items() if own}
    medians: list[Figures] = []
    for own in of_setting.values():
        known = {name: [figures[name] for figures in own if not math.isnan(figures[name])] for name in FIGURES}
        medians.append({name: statistics.median(values) if values else math.nan for name, values in known.items()})
    base = next((m["seconds"] for m, setting in zip(medians, of_setting) if setting.name == baseline), math.nan)
    marks = {name: pareto_front(medians, name) for name in FRONTS}
    return [
        CostRow(setting, len(own), median, median["seconds"] / base, tuple(n for n in FRONTS if marks[n][number]))
        for number, ((setting, own), median) in enumerate(zip(of_setting.items(), medians))
    ]


def cheapest(rows: Iterable[CostRow], targets: Mapping[str, float]) -> CostRow | None:
    """Find the row that keeps the bounds of figures in the least wall time; None if no row does."""

    def kept(name: str, value: float) -> bool:
        return value >= targets[name] if FIGURES[name].higher_is_better else value <= targets[name]

    able = [row for row in rows if all(kept(name, row.figures[name]) for name in targets)]
    return min(able, key=lambda row: row.figures["seconds"], default=None)


def verdict(rows: Sequence[CostRow], targets: Mapping[str, float], scene: Path) -> str:
    """Say in a sentence which setting meets the targets in the least time, or how far the best are from it."""
    wanted = " and ".join(_TARGETS[name].format(bound) for name, bound in targets.items())
    best = cheapest(rows, targets)
    if best is not None:
        figures = ", ".join(_text(best.figures, name) for name in ("seconds", *_TARGETS))
        found = f"Cheapest setting with {wanted}: {best.setting.name} ({figures})."
        return f"{found} Train with: {best.setting.command('--data', str(scene))}"
    nearest = []
    for name in _TARGETS:
        known = [row for row in rows if not math.isnan(row.figures[name])]
        if known:
            choose = max if FIGURES[name].higher_is_better else min
            row = choose(known, key=lambda row: row.figures[name])
            nearest.append(f"{FIGURES[name].short} {_text(row.figures, name)} ({row.setting.name})")
    return (
        f"No measured setting has {wanted}. The best: {', '.join(nearest)}. "
        "Measure more steps or voxels with --settings, or relax the target."
    )


def markdown_table(rows: Sequence[CostRow], baseline: str) -> str:
    """Write the rows as a table for a README; columns without any figure are left out."""
    names = shown_figures([row.figures for row in rows])
    time_at = 1 + names.index("seconds")
    heading = [FIGURES[name].heading for name in names]
    heading.insert(time_at, f"time / {baseline}")
    lines = ["| setting | " + " | ".join(heading) + " | Pareto front |", "|---|" + "---:|" * len(heading) + "---|"]
    for row in rows:
        cells = [_text(row.figures, name) for name in names]
        cells.insert(time_at, "-" if math.isnan(row.time_ratio) else f"{row.time_ratio:.2f}")
        front = ", ".join(sorted(FIGURES[name].short for name in row.fronts))
        lines.append(f"| {row.setting.name} | " + " | ".join(cells) + f" | {front} |")
    return "\n".join(lines)


def draw_plot(path: Path, rows: Sequence[CostRow], targets: Mapping[str, float], title: str) -> None:
    """Draw figures against seconds, each that is known in a panel; filled marks are on a panel's Pareto front."""
    from matplotlib.figure import Figure as Canvas
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    every = [row.figures for row in rows]
    names = [name for name in shown_figures(every) if FIGURES[name].panel]
    lines = math.ceil(len(names) / 2)
    figure = Canvas(figsize=(11, 4.4 * lines + 1), layout="constrained")
    axes = figure.subplots(lines, 2, squeeze=False).ravel()
    for name, axis in zip(names, axes):
        points = [(one["seconds"], one[name]) for one in every]
        front = pareto_front(every, name)
        axis.plot(
            *zip(*sorted(point for point, on in zip(points, front) if on)),
            **{"color": "lightgrey", "drawstyle": "steps-post", "zorder": 1},
        )
        for number, (row, point, on) in enumerate(zip(rows, points, front)):
            look = {"color": f"C{number}", "markerfacecolor": f"C{number}" if on else "white"}
            axis.plot(*point, "osDv^"[number // 10 % 5], label=row.setting.name, **look)
        if name in targets:
            axis.axhline(targets[name], color="grey", linestyle=":", linewidth=1)
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.set(xlabel="ns-train, wall time [s]", title=FIGURES[name].panel)
        axis.grid(alpha=0.3, which="major")
    for axis in axes[len(names) :]:
        axis.set_visible(False)
    figure.suptitle(f"{title}\n(filled: Pareto front)", fontsize=11)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    with replace_when_done(path) as temporary:
        figure.savefig(temporary, dpi=130)
