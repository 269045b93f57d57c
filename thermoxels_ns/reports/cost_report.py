"""What accuracy costs, as table, csv and plot: medians, ratios, the Pareto front and the cheapest that will do."""

from __future__ import annotations

import csv
import html
import math
import re
import shlex
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from thermoxels_ns.core.checks import replace_when_done


class Figure(NamedTuple):
    """How a figure is shown."""

    heading: str = ""  # Of its column in the table; empty: it is in the csv file alone
    form: str = ""
    higher_is_better: bool = False
    panel: str = ""  # What a panel of the plot shows of it; empty: there is none
    short: str = ""  # Its name where the table says on which Pareto fronts against seconds a setting is; empty: on none


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
_TARGETS = {"thermal_mae_c": "a thermal MAE of at most {:g} °C", "psnr": "an RGB PSNR of at least {:g} dB"}


@dataclass(frozen=True)
class CostSetting:
    """One way to train."""

    name: str  # What the user calls it, for instance ``64:800``, ``standard`` or ``standard, recipe paper``
    method: str
    options: tuple[str, ...]

    @property
    def training(self) -> str:
        """The words that make it what it is, as typed in a shell."""
        return shlex.join(["ns-train", self.method, *self.options])

    def command(self, scene: Path | str) -> str:
        """How to train a scene with it, as typed in a shell."""
        return shlex.join(["ns-train", self.method, "--data", str(scene), *self.options])

    @property
    def file_name(self) -> str:
        """The name as part of a path."""
        return re.sub(r"[^0-9A-Za-z.-]+", "-", self.name)


@dataclass(frozen=True)
class CostRun:
    """One finished run of a setting: its number from 1, fingerprint of the scene, our version, words of ns-train."""

    setting: str
    repeat: int
    scene: str
    version: str
    training: str
    figures: Mapping[str, float]  # What was measured, by the names in `FIGURES`; NaN where there is nothing to measure

    @property
    def key(self) -> tuple[str, int, str, str, str]:
        """Two runs with the same key measured the same thing."""
        return (self.setting, self.repeat, self.scene, self.version, self.training)


@dataclass(frozen=True)
class CostRow:
    """A setting and the medians of its runs, so many."""

    setting: CostSetting
    repeats: int
    figures: Mapping[str, float]  # Medians by the names in `FIGURES`; NaN where there is nothing to measure
    time_ratio: float  # Median wall time over that of the baseline; NaN if the baseline has none
    fronts: frozenset[str]  # Those of `FRONTS` in which no other setting is better without being slower

    def text(self, name: str) -> str:
        """A figure as the table shows it."""
        return figure_text(name, self.figures[name])


def figure_text(name: str, value: float) -> str:
    """Write a figure with its unit; NaN is a dash."""
    return "-" if math.isnan(value) else FIGURES[name].form.format(value)


def shown_figures(figures: Iterable[Mapping[str, float]]) -> list[str]:
    """The names of the figures that the table shows, without those that nobody has."""
    every = list(figures)
    return [name for name, one in FIGURES.items() if one.heading and not all(math.isnan(f[name]) for f in every)]


def pareto_front(cost: Sequence[float], value: Sequence[float], higher_is_better: bool) -> list[bool]:
    """Mark the points that no other point beats: one that costs no more and is no worse, and differs.

    A point without a value (NaN) is not on the front and beats none.

    >>> pareto_front([1, 2, 3, 4], [5, 7, 6, 8], higher_is_better=True)
    [True, True, False, True]
    """
    sign = -1.0 if higher_is_better else 1.0
    points = [(c, sign * v) for c, v in zip(cost, value, strict=True)]
    valid = [p for p in points if not any(map(math.isnan, p))]
    return [p in valid and not any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in valid) for p in points]


def front_of(rows: Sequence[Mapping[str, float]], name: str) -> list[bool]:
    """Mark the rows of figures that are on the Pareto front of a figure against seconds."""
    return pareto_front([row["seconds"] for row in rows], [row[name] for row in rows], FIGURES[name].higher_is_better)


def median_rows(settings: Iterable[CostSetting], runs: Iterable[CostRun], baseline: str) -> list[CostRow]:
    """Make a row of every setting that has a run; seconds are related to those of the setting `baseline`."""
    by_name: dict[str, list[CostRun]] = {}
    for run in runs:
        by_name.setdefault(run.setting, []).append(run)
    measured = [setting for setting in settings if setting.name in by_name]
    medians: list[dict[str, float]] = []
    for setting in measured:
        own = [run.figures for run in by_name[setting.name]]
        known = {name: [figures[name] for figures in own if not math.isnan(figures[name])] for name in FIGURES}
        medians.append({name: statistics.median(values) if values else math.nan for name, values in known.items()})
    base = next((m["seconds"] for m, setting in zip(medians, measured) if setting.name == baseline), math.nan)
    marks = {name: front_of(medians, name) for name in FRONTS}
    return [
        CostRow(
            *(setting, len(by_name[setting.name]), median, median["seconds"] / base),
            frozenset(name for name in FRONTS if marks[name][number]),
        )
        for number, (setting, median) in enumerate(zip(measured, medians))
    ]


def in_words(targets: Mapping[str, float]) -> str:
    """Bounds of figures in words; empty if there are none."""
    return " and ".join(_TARGETS[name].format(bound) for name, bound in targets.items())


def cheapest(rows: Iterable[CostRow], targets: Mapping[str, float]) -> CostRow | None:
    """The row that keeps the bounds of figures in the least wall time, NaN keeps none; None if no row does."""

    def kept(name: str, value: float) -> bool:
        return value >= targets[name] if FIGURES[name].higher_is_better else value <= targets[name]

    able = [row for row in rows if all(kept(name, row.figures[name]) for name in targets)]
    return min(able, key=lambda row: row.figures["seconds"], default=None)


def verdict(rows: Sequence[CostRow], targets: Mapping[str, float], scene: Path | str) -> str:
    """Say in a sentence which setting meets the targets for the least time, or how far the best are from it."""
    best = cheapest(rows, targets)
    if best is not None:
        figures = ", ".join(best.text(name) for name in ("seconds", "thermal_mae_c", "psnr"))
        found = f"Cheapest setting with {in_words(targets)}: {best.setting.name} ({figures})."
        return f"{found} Train with: {best.setting.command(scene)}"
    nearest = []
    for name in _TARGETS:
        known = [row for row in rows if not math.isnan(row.figures[name])]
        if known:
            choose = max if FIGURES[name].higher_is_better else min
            row = choose(known, key=lambda row: row.figures[name])
            nearest.append(f"{FIGURES[name].short} {row.text(name)} ({row.setting.name})")
    return (
        f"No measured setting has {in_words(targets)}. The best: {', '.join(nearest)}. "
        "Measure more steps or voxels with --settings, or relax the target."
    )


def markdown_table(rows: Sequence[CostRow], baseline: str) -> str:
    """The rows as a table for a README; columns without any figure are left out."""
    names = shown_figures(row.figures for row in rows)
    time_at = 1 + names.index("seconds") if "seconds" in names else 0
    heading = [FIGURES[name].heading for name in names]
    heading.insert(time_at, f"time / {baseline}")
    lines = ["| setting | " + " | ".join(heading) + " | Pareto front |", "|---|" + "---:|" * len(heading) + "---|"]
    for row in rows:
        cells = [row.text(name) for name in names]
        cells.insert(time_at, "-" if math.isnan(row.time_ratio) else f"{row.time_ratio:.2f}")
        front = ", ".join(sorted(FIGURES[name].short for name in row.fronts))
        lines.append(f"| {row.setting.name} | " + " | ".join(cells) + f" | {front} |")
    return "\n".join(lines)


def write_page(path: Path, paragraphs: Iterable[str]) -> None:
    """Write a page of markdown, in which markup in names stays words."""
    with replace_when_done(path) as temporary:
        temporary.write_text(html.escape("\n\n".join(paragraphs), quote=False) + "\n", encoding="utf-8")


def write_csv(path: Path, rows: Iterable[CostRow], baseline: str) -> None:
    """Write the rows with all figures; empty cells where there is nothing to measure."""
    with replace_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        fronts = [f"front_{name}" for name in FRONTS]
        writer.writerow(["setting", "repeats", *FIGURES, "time_ratio", "baseline", *fronts, "training"])
        for row in rows:
            numbers = [*(row.figures[name] for name in FIGURES), row.time_ratio]
            writer.writerow(
                [row.setting.name, row.repeats]
                + ["" if math.isnan(number) else f"{number:.6g}" for number in numbers]
                + [baseline, *(int(name in row.fronts) for name in FRONTS), row.setting.training]
            )


def draw_plot(path: Path, rows: Sequence[CostRow], targets: Mapping[str, float], title: str) -> None:
    """Draw figures against seconds, each that is known in a panel; filled marks are on a panel's Pareto front."""
    from matplotlib.figure import Figure as Canvas
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    names = [name for name in shown_figures(row.figures for row in rows) if FIGURES[name].panel]
    lines = math.ceil(len(names) / 2)
    figure = Canvas(figsize=(11, 4.4 * lines + 1), layout="constrained")
    axes = figure.subplots(lines, 2, squeeze=False).ravel()
    for name, axis in zip(names, axes):
        seconds, values = ([row.figures[of] for row in rows] for of in ("seconds", name))
        front = front_of([row.figures for row in rows], name)
        line = sorted((s, v) for s, v, on in zip(seconds, values, front) if on)
        axis.plot(*zip(*line), color="lightgrey", drawstyle="steps-post", zorder=1)
        for number, (s, v, on) in enumerate(zip(seconds, values, front)):
            look = {"color": f"C{number}", "markerfacecolor": f"C{number}" if on else "white"}
            axis.plot(s, v, "osDv^"[number // 10 % 5], label=rows[number].setting.name, **look)
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
