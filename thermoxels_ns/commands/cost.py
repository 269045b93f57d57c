"""The command ``thermoxels cost``: what accuracy costs on a scene, from real training runs.

Only light imports at the top, so that ``thermoxels --help`` answers at once.
"""

from __future__ import annotations

import math
import os
import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from thermoxels_ns.core.checks import check_positive, replace_when_done, writable_folder
from thermoxels_ns.core.errors import ThermoxelsError

if TYPE_CHECKING:
    from rich.console import Console

    from thermoxels_ns.commands.cost_process import Watch
    from thermoxels_ns.commands.cost_runs import Bench, CostRun, CostSetting
    from thermoxels_ns.reports.cost_report import Targets

_RUNS, _TABLE, _PLOT, _PAGE = "runs.csv", "cost.csv", "cost.png", "cost.md"
_QUIET_S = 60.0


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
        """Measure and report.

        Raises:
            ThermoxelsError: An option or the scene cannot be used, or a run failed.
        """
        from rich.console import Console

        run_cost(self, Console(highlight=False))


def run_cost(cost: Cost, console: Console) -> None:
    """Measure and report, see `Cost`."""
    from thermoxels_ns.commands.cost_runs import Bench, read_runs, write_runs

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
        with _Display(console, len(pending)).opened() as display:
            if cost.warm_up:
                _warm_up(bench, [setting for setting, _ in pending], display)
            for setting, repeat in pending:
                title = setting.name if cost.repeats == 1 else f"{setting.name}, run {repeat}"
                with display.run(title) as watch:
                    try:
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
        raise ThermoxelsError(
            "cost",
            expected="every run to finish",
            got=f"{len(failed)} that did not",
            remedy="Start the command again to repeat them. " + "\n".join(failed),
        )


def planned_settings(cost: Cost) -> tuple[list[CostSetting], str]:
    """The rows of the table, and the name of the baseline among them.

    Raises:
        ThermoxelsError: Nothing is to be trained, a setting is not one, or the baseline is none of them.
    """
    from thermoxels_ns.commands.cost_runs import CostSetting, parse_setting, training_options

    for name in ("methods", "recipes"):
        if not getattr(cost, name):
            raise ThermoxelsError(
                name, expected="at least one", got="none", remedy=f"Leave out --{name} for the default."
            )
    try:
        further = tuple(shlex.split(cost.train_options))
    except ValueError as problem:
        raise ThermoxelsError(
            "train_options", expected="words as in a shell", got=str(problem), remedy="Close the quotes."
        ) from problem

    words: dict[str, tuple[str, ...]] = {}
    work: dict[str, float] = {}
    for text in cost.settings:
        resolution, steps = parse_setting(text)
        words[text] = tuple(training_options(resolution, steps))
        work[text] = float(resolution**2 * steps)
    words |= {quality: ("--quality", quality) for quality in cost.qualities}
    if not words:
        raise ThermoxelsError(
            "settings", expected="a setting or a quality", got="none", remedy="Pass --settings 64:800."
        )
    baseline = cost.baseline or ("standard" if "standard" in words else [*words][-1])
    if baseline not in words:
        raise ThermoxelsError(
            "baseline", expected=f"one of {', '.join(words)}", got=baseline, remedy="Name one of them."
        )

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
    from thermoxels_ns.reports.cost_report import Targets

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
    from thermoxels_ns.reports.cost_report import draw_plot, markdown_table, median_rows, verdict, write_csv

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
    """Shows which run is at work: bars on a terminal, lines elsewhere."""

    def __init__(self, console: Console, total: int) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._console = console
        self._total = total
        self._done = 0
        self._bars = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._all = self._bars.add_task("all runs", total=total)

    @contextmanager
    def opened(self) -> Iterator[_Display]:
        """Show the bars as long as the block runs."""
        with self._bars:
            yield self

    def say(self, line: str) -> None:
        """Print a line above the bars."""
        self._console.print(line, markup=False, soft_wrap=True)

    @contextmanager
    def run(self, title: str, counts: bool = True) -> Iterator[Watch]:
        """Show a run; gives what is to be called with the share that is done."""
        start = told = time.monotonic()
        number = f"[{self._done + 1}/{self._total}] " if counts else ""
        bar = self._bars.add_task(f"{number}{title}", total=None)
        if not self._console.is_terminal:
            self.say(f"{number}{title} ...")

        def watch(share: float | None) -> None:
            nonlocal told
            if share is None:
                self._bars.update(bar, total=None)
            else:
                self._bars.update(bar, total=100, completed=round(100 * share))
            if not self._console.is_terminal and time.monotonic() - told > _QUIET_S:
                told = time.monotonic()
                done = "" if share is None else f", {share:.0%} of the training done"
                self.say(f"... at work for {told - start:.0f} s{done}")

        try:
            yield watch
        finally:
            self._bars.remove_task(bar)
            if counts:
                self._done += 1
                self._bars.update(self._all, completed=self._done)
