"""What accuracy costs, as table, csv and plot: medians, ratios, the Pareto front and the cheapest that will do."""

from __future__ import annotations

import csv
import math
import re
import shlex
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from thermoxels_ns.core.checks import replace_when_done

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
FRONTS = ("thermal_mae_c", "psnr")  # Figures whose Pareto front against seconds is marked

_HIGHER_IS_BETTER = frozenset({"psnr", "fscore", "fscore_128"})
_SHORT = {"thermal_mae_c": "MAE", "psnr": "PSNR"}
# Heading, figure and form of the table's columns; figures of which there are none are left out.
_COLUMNS = (
    ("training", "training_seconds", "{:.0f} s"),
    ("ns-train", "seconds", "{:.0f} s"),
    ("RGB PSNR", "psnr", "{:.1f} dB"),
    ("thermal MAE", "thermal_mae_c", "{:.2f} °C"),
    ("F-score, 1.5 of 128 voxels", "fscore_128", "{:.2f}"),
    ("F-score, 1.5 own voxels", "fscore", "{:.2f}"),
    ("surface distance", "surface_distance_voxels", "{:.2f} voxels"),
    ("half-transparent rays", "half_transparent", "{:.1%}"),
    ("memory", "peak_memory_gb", "{:.1f} GB"),
)
_PANELS = (
    ("psnr", "RGB PSNR [dB], higher is better"),
    ("thermal_mae_c", "thermal MAE [°C], lower is better"),
    ("fscore_128", "surface F-score at 1.5 of 128 voxels, higher is better"),
    ("peak_memory_gb", "peak memory [GB], lower is better"),
)
_MAIN, _OTHER, _FRONT_LINE = "#1f5fa8", "#b8571b", "#8fb3d9"

NamedPoint = tuple[str, float, float]  # A name, seconds and a figure


@dataclass(frozen=True)
class CostSetting:
    """One way to train."""

    name: str  # What the user calls it, for instance ``64:800``, ``standard`` or ``standard, recipe paper``
    method: str
    options: tuple[str, ...]
    work: float = math.inf
    """Roughly how much there is to do, to find the cheapest before anything ran; infinite if not known."""
    beside: bool = False  # Another method or recipe at the baseline, for comparison

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


@dataclass(frozen=True)
class Targets:
    """Bounds that a setting should keep; None: any value will do."""

    thermal_mae_c: float | None = None  # Largest thermal MAE, [degrees Celsius]
    psnr: float | None = None  # Smallest RGB PSNR, [dB]

    def met(self, figures: Mapping[str, float]) -> bool:
        """Whether the figures keep all bounds; NaN keeps none."""
        mae = self.thermal_mae_c is None or figures["thermal_mae_c"] <= self.thermal_mae_c
        return mae and (self.psnr is None or figures["psnr"] >= self.psnr)

    @property
    def words(self) -> str:
        """The bounds in words; empty if there are none."""
        parts = []
        if self.thermal_mae_c is not None:
            parts.append(f"a thermal MAE of at most {self.thermal_mae_c:g} °C")
        if self.psnr is not None:
            parts.append(f"an RGB PSNR of at least {self.psnr:g} dB")
        return " and ".join(parts)


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


def median_rows(settings: Iterable[CostSetting], runs: Iterable[CostRun], baseline: str) -> list[CostRow]:
    """Make a row of every setting that has a run; seconds are related to those of the setting `baseline`."""
    by_name: dict[str, list[CostRun]] = {}
    for run in runs:
        by_name.setdefault(run.setting, []).append(run)
    measured = [(setting, by_name[setting.name]) for setting in settings if setting.name in by_name]
    medians = []
    for _, own in measured:
        known = {name: [run.figures[name] for run in own if not math.isnan(run.figures[name])] for name in FIGURES}
        medians.append({name: statistics.median(values) if values else math.nan for name, values in known.items()})
    seconds = [median["seconds"] for median in medians]
    base = next((s for s, (setting, _) in zip(seconds, measured) if setting.name == baseline), math.nan)
    marks = {
        name: pareto_front(seconds, [median[name] for median in medians], name in _HIGHER_IS_BETTER) for name in FRONTS
    }
    return [
        CostRow(
            setting,
            len(own),
            median,
            median["seconds"] / base,
            frozenset(name for name in FRONTS if marks[name][index]),
        )
        for index, ((setting, own), median) in enumerate(zip(measured, medians))
    ]


def cheapest(rows: Iterable[CostRow], targets: Targets) -> CostRow | None:
    """The row that keeps the bounds in the least wall time; None if none does."""
    return min((row for row in rows if targets.met(row.figures)), key=lambda row: row.figures["seconds"], default=None)


def verdict(rows: Sequence[CostRow], targets: Targets, scene: Path | str) -> str:
    """Say in a sentence which setting meets the targets for the least time, or how far the best are from it."""
    best = cheapest(rows, targets)
    if best is not None:
        figures = ", ".join(_figure(best, name) for name in ("seconds", "thermal_mae_c", "psnr"))
        found = f"Cheapest setting with {targets.words}: {best.setting.name} ({figures})."
        return f"{found} Train with: {best.setting.command(scene)}"
    nearest = []
    for name in FRONTS:
        known = [row for row in rows if not math.isnan(row.figures[name])]
        if known:
            sign = -1.0 if name in _HIGHER_IS_BETTER else 1.0
            row = min(known, key=lambda row: sign * row.figures[name])
            nearest.append(f"{_SHORT[name]} {_figure(row, name)} ({row.setting.name})")
    return (
        f"No measured setting has {targets.words}. The best: {', '.join(nearest)}. "
        "Measure more steps or voxels with --settings, or relax the target."
    )


def _figure(row: CostRow, name: str) -> str:
    value = row.figures[name]
    form = next(form for _, figure, form in _COLUMNS if figure == name)
    return "-" if math.isnan(value) else form.format(value)


def markdown_table(rows: Sequence[CostRow], baseline: str) -> str:
    """The rows as a table for a README; columns without any figure are left out."""
    columns = [column for column in _COLUMNS if not all(math.isnan(row.figures[column[1]]) for row in rows)]
    time_at = 1 + [name for _, name, _ in columns].index("seconds") if columns else 0
    heading = [heading for heading, _, _ in columns]
    heading.insert(time_at, f"time / {baseline}")
    lines = ["| setting | " + " | ".join(heading) + " | Pareto front |", "|---|" + "---:|" * len(heading) + "---|"]
    for row in rows:
        cells = [_figure(row, name) for _, name, _ in columns]
        cells.insert(time_at, "-" if math.isnan(row.time_ratio) else f"{row.time_ratio:.2f}")
        front = ", ".join(_SHORT[name] for name in FRONTS if name in row.fronts)
        lines.append(f"| {row.setting.name} | " + " | ".join(cells) + f" | {front} |")
    return "\n".join(lines)


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


def draw_plot(path: Path, rows: Sequence[CostRow], targets: Targets, title: str) -> None:
    """Draw seconds against what `_PANELS` names, as far as it is known; filled marks are on a panel's Pareto front."""
    from matplotlib.figure import Figure

    panels = [panel for panel in _PANELS if not all(math.isnan(row.figures[panel[0]]) for row in rows)]
    figure = Figure(figsize=(11, 4.4 * math.ceil(len(panels) / 2)), layout="constrained")
    axes = figure.subplots(math.ceil(len(panels) / 2), 2, squeeze=False).ravel()
    bounds = {"psnr": targets.psnr, "thermal_mae_c": targets.thermal_mae_c}
    points = [_draw_panel(axis, rows, name, label, bounds.get(name)) for axis, (name, label) in zip(axes, panels)]
    for axis in axes[len(panels) :]:
        axis.set_visible(False)
    others = "; orange: another method or recipe" if any(row.setting.beside for row in rows) else ""
    figure.suptitle(f"{title}\n(filled: Pareto front{others})", fontsize=11)
    figure.draw_without_rendering()  # fixes where points are on the picture
    for axis, named in zip(axes, points):
        _place_names(axis, named, figure.dpi / 72.0)
    with replace_when_done(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _draw_panel(axis: Axes, rows: Sequence[CostRow], name: str, label: str, bound: float | None) -> list[NamedPoint]:
    """Draw one panel and return its points, still without their names."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    points = [row for row in rows if not math.isnan(row.figures[name])]
    seconds = [row.figures["seconds"] for row in points]
    values = [row.figures[name] for row in points]
    front = pareto_front(seconds, values, name in _HIGHER_IS_BETTER)
    line = sorted((s, v) for s, v, on in zip(seconds, values, front) if on)
    axis.plot([s for s, _ in line], [v for _, v in line], color=_FRONT_LINE, drawstyle="steps-post", zorder=1)
    for row, s, v, on in zip(points, seconds, values, front):
        colour = _OTHER if row.setting.beside else _MAIN
        axis.plot(s, v, "o", color=colour, markerfacecolor=colour if on else "white", markersize=6, zorder=3)
    if bound is not None:
        axis.axhline(bound, color="grey", linestyle=":", linewidth=1)
    axis.set_xscale("log")
    axis.margins(x=0.12, y=0.14)
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_xlabel("ns-train, wall time [s]")
    axis.set_title(label, fontsize=10)
    axis.grid(alpha=0.3, which="major")
    return [(row.setting.name, s, v) for row, s, v in zip(points, seconds, values)]


def _place_names(axis: Axes, points: Sequence[NamedPoint], pixels_per_point: float) -> None:
    """Write names beside points, each where the least is in its way; lengths below are in points (1/72 inch)."""
    from matplotlib.transforms import Bbox

    at = axis.transData.transform([(x, y) for _, x, y in points]) / pixels_per_point
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in at]
    frame = axis.get_window_extent()
    left_end, right_end = frame.x0 / pixels_per_point, frame.x1 / pixels_per_point
    for (name, *where), (x, y) in zip(points, at):
        width = 4.6 * len(name)
        options = []
        left, middle = -6 - width, -width / 2
        beside = ((6, 4), (6, -11), (left, 4), (left, -11), (middle, 9), (middle, -17))
        for dx, dy in (*beside, (middle, 19), (middle, -27), (6, 14), (left, 14), (6, -21), (left, -21)):
            box = Bbox.from_bounds(x + dx, y + dy, width, 9)
            outside = box.x0 < left_end or box.x1 > right_end
            options.append((box.count_overlaps(taken) + 2 * outside, len(options), dx, dy, box))
        _, _, dx, dy, box = min(options)
        taken.append(box)
        side = "right" if dx == left else "center" if dx < 0 else "left"
        offset = ({"right": -6, "center": 0, "left": dx}[side], dy)
        name_drawn = axis.annotate(name, (where[0], where[1]), offset, textcoords="offset points", ha=side, fontsize=8)
        name_drawn.set_in_layout(False)
