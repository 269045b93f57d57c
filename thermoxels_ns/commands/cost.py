"""The command ``thermoxels cost``: measure time and memory against accuracy on a scene, in real training runs."""

from __future__ import annotations

import csv
import hashlib
import html
import math
import os
import re
import shlex
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import tyro

from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING, run_command
from thermoxels_ns.core.checks import check_positive, remedy_of, replace_when_done, writable_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import read_json
from thermoxels_ns.core.version import __version__

if TYPE_CHECKING:
    from rich.console import Console


class Figure(NamedTuple):
    """How one measured figure is shown; empty texts leave the figure out."""

    heading: str = ""  # Heading of the figure's column in the table; empty: the figure is in the csv file alone
    form: str = ""  # Format of the value with its unit
    panel: str = ""  # Title of the figure's panel in the plot; empty: no panel


FIGURES: Mapping[str, Figure] = {
    # Wall time of the whole ns-train command, from its start to its end.
    "seconds": Figure("ns-train", "{:.0f} s"),
    # RGB PSNR [dB] and SSIM, and mean absolute temperature error [degrees Celsius], on held-out views.
    "psnr": Figure("RGB PSNR", "{:.1f} dB", "RGB PSNR [dB], higher is better"),
    "ssim": Figure(),
    "thermal_mae_c": Figure("thermal MAE", "{:.2f} °C", "thermal MAE [°C], lower is better"),
    # F-score of the surface at 1.5 voxels of a lattice of 128 voxels, and at 1.5 voxels of the setting's own lattice.
    "fscore_128": Figure(
        *("F-score, 1.5 of 128 voxels", "{:.2f}", "surface F-score at 1.5 of 128 voxels, higher is better")
    ),
    "fscore": Figure("F-score, 1.5 own voxels", "{:.2f}"),
    "precision": Figure(),
    "recall": Figure(),
    # Mean distance between the surface and the true surface, in voxels of the setting's own lattice, and in metres.
    "surface_distance_voxels": Figure("surface distance", "{:.2f} voxels"),
    "surface_distance_m": Figure(),
    # Share of rays that neither pass through the scene nor are stopped.
    "half_transparent": Figure("half-transparent rays", "{:.1%}"),
    # Largest resident memory of the ns-train process, 1e9 bytes.
    "peak_memory_gb": Figure("memory", "{:.1f} GB", "peak memory [GB], lower is better"),
}
"""All measured figures, by the names of their columns in csv files."""
_EVALUATED = tuple(name for name in FIGURES if name not in ("seconds", "peak_memory_gb"))
_RUNS, _TABLE, _PLOT, _PAGE = "runs.csv", "cost.csv", "cost.png", "cost.md"
_GROUPS = ("density", "sh", "temperature", "background", "corrections")


@dataclass
class Cost:
    """Train a scene at several settings and report what accuracy costs: seconds and memory against image, temperature
    and surface errors, as csv, plot and a table for a README.

    Finished runs are kept in runs.csv in the output folder; if the command was interrupted, start it again and it goes
    on where it stopped. Remove the file to measure again. The machine should do nothing else, and have trained once
    before, because the first training compiles kernels."""

    scene: tyro.conf.Positional[Path]
    """Scene folder. In a synthetic scene the trained surface is compared with the exact surface."""
    output_dir: Path = Path("cost")
    """Folder for runs.csv (finished runs), cost.csv, cost.png, cost.md and logs."""
    settings: tuple[str, ...] = ("32:400", "128:800")
    """Settings to train, each as resolution:steps: voxels along the longest side of the scene box, and training steps;
    the training schedule is scaled to both. May be empty."""
    qualities: tuple[str, ...] = ("draft", "standard", "fine")
    """Named qualities of ns-train to train as well. May be empty."""
    methods: tuple[str, ...] = ("thermoxels",)
    """Training methods. The first method trains all settings and qualities; each further method, such as plenoxels-t,
    adds a row: the baseline (standard, or else the last quality or setting) with that method."""
    recipes: tuple[str, ...] = ("default",)
    """Loss recipes. All rows use the first recipe (default: the method's own); each further recipe, such as paper, adds
    a row: the baseline with that recipe."""
    target_mae: float | None = None
    """Name the cheapest setting whose thermal MAE is at most this, [degrees Celsius]."""

    def main(self) -> None:
        """Measure and report; raises `ThermoxelsError` if an option or the scene cannot be used, or a run failed."""
        from rich.console import Console

        run_cost(self, Console(highlight=False))


class CostSetting(NamedTuple):
    """A method and options of ns-train, which make up one row of the table."""

    name: str  # Name of the row, for instance ``64:800``, ``standard`` or ``standard, recipe paper``
    method: str
    options: tuple[str, ...]

    def command(self, *scene: str) -> str:
        """Return the ns-train command as typed in a shell; `scene` are words that name the scene, such as --data."""
        return shlex.join(["ns-train", self.method, *scene, *self.options])


class RunKey(NamedTuple):
    """Identity of a run: runs with equal keys measure the same, so a run in runs.csv is not repeated."""

    setting: str  # `CostSetting.name`
    scene: str  # Result of `scene_fingerprint`
    version: str  # Version of this package
    training: str  # The ns-train command, without the scene


Figures = dict[str, float]
"""Values of measured figures by the names in `FIGURES`; NaN if the scene or the method has no such figure."""


class CostRow(NamedTuple):
    """A row of the table: a setting with the figures of its run."""

    setting: CostSetting
    figures: Figures
    time_ratio: float  # Wall time divided by the baseline's; NaN if the baseline has no run


def run_cost(cost: Cost, console: Console) -> None:
    """Train and evaluate every setting that runs.csv does not hold; then write table, plot and page. See `Cost`."""

    def say(line: str) -> None:
        console.print(line, markup=False, soft_wrap=True)

    if cost.target_mae is not None:
        check_positive("target_mae", cost.target_mae, "Correct --target-mae, or leave it out.")
    settings, baseline = planned_settings(cost)
    if not cost.scene.is_dir():
        raise SceneError("scene", expected="a scene folder", got=f"none at {cost.scene}", remedy="Correct the path.")
    folder, fingerprint = writable_folder(cost.output_dir), scene_fingerprint(cost.scene)

    plan = {RunKey(one.name, fingerprint, __version__, one.command()): one for one in settings}
    runs = read_runs(folder / _RUNS)
    pending = [key for key in plan if key not in runs]
    if len(pending) < len(plan):
        kept = len(plan) - len(pending)
        say(f"{kept} of {len(plan)} runs are in {folder / _RUNS} already; remove it to measure them again.")
    failed: list[str] = []
    for number, key in enumerate(pending, start=1):
        title = key.setting
        say(f"[{number}/{len(pending)}] {title} ...")
        try:
            name = re.sub(r"[^0-9A-Za-z.-]+", "-", title)
            runs[key] = measure(cost.scene, plan[key], name, folder, console)
        except ThermoxelsError as problem:
            failed.append(f"{title}: {problem}")
            say(f"{title} failed: {problem}")
            continue
        _write_csv(folder / _RUNS, [*RunKey._fields, *FIGURES], ([*one, *_cells(runs[one])] for one in runs))
        shown = (f"{FIGURES[of].heading} {_text(runs[key], of)}" for of in shown_figures([runs[key]]))
        say(f"{title}: {', '.join(shown)}")
    measured = {plan[key]: runs[key] for key in plan if key in runs}
    base = next((found["seconds"] for one, found in measured.items() if one.name == baseline), math.nan)
    rows = [CostRow(one, found, found["seconds"] / base) for one, found in measured.items()]
    if rows:
        scene, machine = cost.scene.resolve().name, f"a machine with {os.cpu_count()} processors"
        words = [markdown_table(rows, baseline)]
        words.append(f"{scene}: one run each on {machine}; memory is that of the ns-train process.")
        words += [verdict(rows, cost.target_mae, cost.scene)] if cost.target_mae else []
        write_table(folder / _TABLE, rows, baseline)
        draw_plot(folder / _PLOT, rows, cost.target_mae, f"What accuracy costs: {scene}")
        with replace_when_done(folder / _PAGE) as temporary:  # names may hold markup, which is escaped
            temporary.write_text(html.escape("\n\n".join(words), quote=False) + "\n", encoding="utf-8")
        for text in ("", *words, f"Written to {folder}: {', '.join((_TABLE, _PLOT, _PAGE, _RUNS))}"):
            say(text)
    if failed:
        remedy = "Start the command again to repeat them. " + "\n".join(failed)
        raise ThermoxelsError("cost", expected="every run to finish", got=f"{len(failed)} that did not", remedy=remedy)


def planned_settings(cost: Cost) -> tuple[list[CostSetting], str]:
    """Return the rows of the table and the name of the baseline; raises `ThermoxelsError` for wrong options."""
    words = {text: training_options(text) for text in cost.settings}
    words |= {quality: ("--quality", quality) for quality in cost.qualities}
    if not words:
        remedy = "Pass --settings 64:800."
        raise ThermoxelsError("settings", expected="a setting or a quality", got="none", remedy=remedy)
    baseline = "standard" if "standard" in words else [*words][-1]

    def row(of: str, method: str, recipe: str, kind: str = "") -> CostSetting:
        # The recipe "default" is the method's own recipe, which needs no option.
        recipe_words = () if recipe == "default" else ("--pipeline.model.recipe", recipe)
        return CostSetting(f"{of}{kind}", method, (*words[of], *recipe_words))

    method, *methods = dict.fromkeys(cost.methods or ("thermoxels",))
    recipe, *recipes = dict.fromkeys(cost.recipes or ("default",))
    rows = [row(name, method, recipe) for name in words]
    rows += [row(baseline, other, recipe, f", {other}") for other in methods]
    rows += [row(baseline, method, other, f", recipe {other}") for other in recipes]
    return rows, baseline


def training_options(setting: str) -> tuple[str, ...]:
    """Return the options of ns-train for a setting ``resolution:steps``; raises `ThermoxelsError` for other texts."""
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
    """Return a hash of the names and sizes of all files of a scene and of the contents of the json files in `scene`."""
    digest = hashlib.sha256()
    for path in sorted(path for path in scene.rglob("*") if path.is_file()):
        digest.update(f"{path.relative_to(scene).as_posix()} {path.stat().st_size}\n".encode())
        if path.parent == scene and path.suffix == ".json":
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def read_runs(path: Path) -> dict[RunKey, Figures]:
    """Read the finished runs from runs.csv; none if there is no file. Raises `ThermoxelsError` for a damaged file."""
    if not path.is_file():
        return {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, strict=True)
            if missing := {*RunKey._fields, *FIGURES} - set(reader.fieldnames or ()):
                raise ValueError(f"no column {', '.join(sorted(missing))}")
            if "repeat" in (reader.fieldnames or ()):
                raise ValueError("a column 'repeat' of an earlier version, which ran settings several times")
            return {
                RunKey(*(row[name] for name in RunKey._fields)): {name: float(row[name] or "nan") for name in FIGURES}
                for row in reader
            }
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as problem:
        expected = "the finished runs of an earlier start"
        got = f"{type(problem).__name__}: {problem}"
        remedy = remedy_of(problem, "Remove the file to measure again, or choose another --output-dir.")
        raise ThermoxelsError(str(path), expected=expected, got=got, remedy=remedy) from problem


def write_table(path: Path, rows: Iterable[CostRow], baseline: str) -> None:
    """Write cost.csv: one line per row with all figures."""
    lines = []
    for row in rows:
        ratio = "" if math.isnan(row.time_ratio) else f"{row.time_ratio:.6g}"
        one = row.setting
        lines.append([one.name, *_cells(row.figures), ratio, baseline, one.command()])
    _write_csv(path, ["setting", *FIGURES, "time_ratio", "baseline", "training"], lines)


def _cells(figures: Figures) -> list[str]:
    """Return all figures as texts, in the order of `FIGURES`; NaN becomes an empty text."""
    return ["" if math.isnan(figures[name]) else f"{figures[name]:.6g}" for name in FIGURES]


def _write_csv(path: Path, head: Sequence[str], lines: Iterable[Sequence[object]]) -> None:
    with replace_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([head, *lines])


def measure(scene: Path, setting: CostSetting, name: str, folder: Path, console: Console) -> Figures:
    """Train a setting, evaluate and remove the model, return all figures; logs and results are named `name`."""
    models, logs, evaluations = (writable_folder(folder / part) for part in ("models", "logs", "eval"))
    shutil.rmtree(models / name, ignore_errors=True)
    run_folder, output = models / name / setting.method / "run", evaluations / f"{name}.json"
    train = ["ns-train", setting.method, "--data", scene, "--output-dir", models, "--experiment-name", name]
    evaluate = ["ns-eval", "--load-config", run_folder / "config.yml", "--output-path", output]
    try:
        cost = run_command([*train, *PLAIN_TRAINING, *setting.options], logs / f"{name}-train.log", console)
        run_command(evaluate, logs / f"{name}-eval.log", console)
        return {"seconds": cost.seconds, "peak_memory_gb": cost.peak_memory_gb, **read_evaluation(output)}
    finally:
        shutil.rmtree(models / name, ignore_errors=True)


def read_evaluation(path: Path) -> Figures:
    """Read the figures that ns-eval wrote; NaN for missing figures. Raises `ThermoxelsError` for a damaged file."""
    expected, remedy = "the results of ns-eval", "Start the command again; finished runs are kept."
    content = read_json(path, expected, remedy)
    try:
        return {name: float(content["results"].get(name, math.nan)) for name in _EVALUATED}
    except (ValueError, KeyError, TypeError, AttributeError) as problem:
        got = f"{type(problem).__name__}: {problem}"
        raise ThermoxelsError(str(path), expected=expected, got=got, remedy=remedy) from problem


def _text(figures: Figures, name: str) -> str:
    """Return a figure as text with its unit; a dash for NaN."""
    return "-" if math.isnan(figures[name]) else FIGURES[name].form.format(figures[name])


def shown_figures(figures: Sequence[Figures]) -> list[str]:
    """Return the names of figures that have a heading and that are known in at least one run."""
    return [name for name, one in FIGURES.items() if one.heading and not all(math.isnan(f[name]) for f in figures)]


def verdict(rows: Sequence[CostRow], target_mae: float, scene: Path) -> str:
    """Return a sentence on the fastest setting whose thermal MAE is at most the target, [degrees Celsius]."""
    wanted = f"a thermal MAE of at most {target_mae:g} °C"
    able = [row for row in rows if row.figures["thermal_mae_c"] <= target_mae]
    if not able:
        return f"No measured setting has {wanted}. Measure more steps or voxels with --settings, or relax the target."
    best = min(able, key=lambda row: row.figures["seconds"])
    figures = ", ".join(_text(best.figures, name) for name in ("seconds", "thermal_mae_c", "psnr"))
    found = f"Cheapest setting with {wanted}: {best.setting.name} ({figures})."
    return f"{found} Train with: {best.setting.command('--data', str(scene))}"


def markdown_table(rows: Sequence[CostRow], baseline: str) -> str:
    """Return the rows as a Markdown table; columns in which all figures are NaN are left out."""
    names = shown_figures([row.figures for row in rows])
    time_at = 1 + names.index("seconds")
    heading = [FIGURES[name].heading for name in names]
    heading.insert(time_at, f"time / {baseline}")
    lines = ["| setting | " + " | ".join(heading) + " |", "|---|" + "---:|" * len(heading)]
    for row in rows:
        cells = [_text(row.figures, name) for name in names]
        cells.insert(time_at, "-" if math.isnan(row.time_ratio) else f"{row.time_ratio:.2f}")
        lines.append(f"| {row.setting.name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw_plot(path: Path, rows: Sequence[CostRow], target_mae: float | None, title: str) -> None:
    """Draw a panel for each known figure against seconds."""
    from matplotlib.figure import Figure as Canvas

    names = [name for name in shown_figures([row.figures for row in rows]) if FIGURES[name].panel]
    lines = math.ceil(len(names) / 2)
    figure = Canvas(figsize=(11, 4.4 * lines + 1), layout="constrained")
    axes = figure.subplots(lines, 2, squeeze=False).ravel()
    for name, axis in zip(names, axes):
        for number, row in enumerate(rows):
            axis.plot(row.figures["seconds"], row.figures[name], "osDv^"[number // 10 % 5], label=row.setting.name)
        if name == "thermal_mae_c" and target_mae is not None:
            axis.axhline(target_mae, color="grey", linestyle=":", linewidth=1)
        axis.set(xlabel="ns-train, wall time [s]", title=FIGURES[name].panel)
        axis.grid(alpha=0.3)
    for axis in axes[len(names) :]:
        axis.set_visible(False)
    figure.suptitle(title, fontsize=11)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    with replace_when_done(path) as temporary:
        figure.savefig(temporary, dpi=130)
