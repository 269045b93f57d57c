"""Runs in turns, csv files and logarithmic panels for the other benchmarks, which may then import tests.support."""

import csv
import sys
import time
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from thermoxels_ns.core.checks import replace_when_done

if "tests" not in sys.modules:  # Another distribution may have installed a package of this name.
    sys.modules["tests"] = types.ModuleType("tests")
    sys.modules["tests"].__path__ = [str(Path(__file__).parents[1])]


def take_turns(
    sides: dict[str, Callable[[], Any]], repeats: int, clock: Callable[[], float] = time.process_time
) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Run all sides in turns after one run that does not count; seconds of each run and last results."""
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    results = {}
    for run in range(repeats + 1):
        for name, side in sides.items():
            begin = clock()
            results[name] = side()
            if run:
                seconds[name].append(clock() - begin)
    return seconds, results


def write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def logarithmic_panels(lines: int, columns: int, **options: Any) -> tuple[Any, Any]:
    """A figure and its panels, shape (lines, columns), both axes logarithmic with plain numbers beside them."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, panels = pyplot.subplots(lines, columns, squeeze=False, layout="constrained", **options)
    for panel in panels.ravel():
        panel.set(xscale="log", yscale="log")
        panel.grid(True, which="both", alpha=0.25)
        for axis in (panel.xaxis, panel.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
    return figure, panels


def save(figure: Any, path: Path, dpi: int = 110) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_when_done(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
