"""Runs, tables and logarithmic panels for the other benchmarks, which may then import tests.support."""

import csv
import json
import multiprocessing
import os
import sys
import time
import types
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.synthetic.imperfections import Imperfections
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene
from thermoxels_ns.synthetic.scene_truth import SyntheticScene

SHARED_DATA = Path(os.environ.get("THERMOXELS_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
"""Folder of real photographs beside the checkout."""
VIEWS = (42, 6)  # Photographs of a synthetic scene that train, and that are held out
_EXPOSURE = Imperfections(exposure_stops=0.3, white_balance=0.03, noise_counts=2.0)
FLAWS = {
    "none": Imperfections(),
    "exposure": _EXPOSURE,
    "poses": Imperfections(pose_error_deg=0.15),
    "poses-x2": Imperfections(pose_error_deg=0.3),
    "walk": Imperfections(pose_error_deg=0.15, pose_correlation=0.95),
    "focal": Imperfections(focal_error=0.005),
    "thermal": Imperfections(thermal_blur_px=1.5, drift_k=1.0, noise_k=0.1),
    "passers-by": Imperfections(passers_by=0.2),
    "all": replace(_EXPOSURE, pose_error_deg=0.15, thermal_blur_px=1.5, drift_k=1.0, noise_k=0.1),
}
"""Flaws of cameras and poses; those without a number are as large as real captures were found to be off."""

if "tests" not in sys.modules:  # Another distribution may have installed a package of this name.
    sys.modules["tests"] = types.ModuleType("tests")
    sys.modules["tests"].__path__ = [str(Path(__file__).parents[1])]


def take_turns(
    sides: dict[Any, Callable[[], Any]], repeats: int, clock: Callable[[], float] = time.process_time
) -> tuple[dict[Any, list[float]], dict[Any, Any]]:
    """Run all sides in turns after one run that does not count; seconds of each run and last results."""
    seconds: dict[Any, list[float]] = {name: [] for name in sides}
    results = {}
    for run in range(repeats + 1):
        for name, side in sides.items():
            begin = clock()
            results[name] = side()
            if run:
                seconds[name].append(clock() - begin)
    return seconds, results


def in_own_process(work: Callable[..., Any], *given: Any) -> Any:
    """Call a function of a module in a process of its own, so that its peak memory is its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(work, given)


def peak_memory_bytes() -> int:
    """Most resident memory that this process ever had. Linux; what `resource` gives there includes the parent's."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def synthetic_scene(name: str, folder: Path) -> SyntheticScene:
    """Make a synthetic scene and write it, as benchmarks photograph it, unless the folder holds it already.

    The name may go on with flaws and the seed that draws them, as in ``house-corner:all:5``. A folder that holds the
    scene with other cameras or another box than it has now is written again.
    """
    name, flaws, seed = (*name.split(":"), *("none", "0")[name.count(":") :])
    scene = make_scene(name)
    path = folder / "truth.json"
    if path.is_file() and (folder / "transforms.json").is_file():  # written last
        truth = json.loads(path.read_text(encoding="utf-8"))
        poses, wanted = np.array(truth["poses"]), np.concatenate(scene.poses(*VIEWS))
        same = poses.shape == wanted.shape and np.allclose(poses, wanted)
        if same and np.allclose(truth["scene_box"], scene.scene_box):
            return scene
    write_scene(scene, folder, *VIEWS, progress=False, imperfections=FLAWS[flaws], seed=int(seed))
    return scene


def run_of(folder: Path, method: str = "thermoxels") -> Path:
    """Folder of the run that `train_and_evaluate` leaves, with its config.yml."""
    return folder / "outputs" / "scene" / method / "run"


def trained(
    scene: Path, folder: Path, options: Sequence[str] = (), method: str = "thermoxels", launcher: Sequence[str] = ()
) -> float:
    """Train a scene by the command that a user types, with `options`, and return the seconds of the whole `ns-train`.

    The log stays in `folder`. The words of a `launcher`, a command of this installation, stand before the command.
    """
    from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING

    command = [*launcher, "ns-train", method, "--output-dir", str(folder / "outputs"), "--experiment-name", "scene"]
    command += [*PLAIN_TRAINING, *options, "thermal-data", "--data", str(scene)]
    return run_quietly(command, folder / "train.log").seconds


def run_quietly(command: Sequence[str], log: Path) -> Any:
    """Run a command of this installation, whose words go to `log`, and return its time and memory."""
    from thermoxels_ns.commands.installed_commands import run_command

    log.parent.mkdir(parents=True, exist_ok=True)
    return run_command(list(command), log)


def train_and_evaluate(
    scene: Path, folder: Path, options: Sequence[str] = (), method: str = "thermoxels", launcher: Sequence[str] = ()
) -> tuple[float, dict[str, float]]:
    """Train a scene as `trained` does, evaluate it, and return the seconds of the training and what `ns-eval` says."""
    seconds = trained(scene, folder, options, method, launcher)
    config, results = run_of(folder, method) / "config.yml", folder / "eval.json"
    command = [*launcher, "ns-eval", "--load-config", str(config), "--output-path", str(results)]
    run_quietly(command, folder / "eval.log")
    figures = json.loads(results.read_text(encoding="utf-8"))["results"]
    return seconds, {name: float(value) for name, value in figures.items() if value is not None}


def run_with_options(benchmark: Callable[[], Any]) -> None:
    """Run the `main` of a benchmark from its command line; what follows `--options` goes to ns-train as it is."""
    import tyro

    words, passed_on = sys.argv[1:], []
    if "--options" in words:
        at = words.index("--options")
        words, passed_on = words[:at], words[at + 1 :]
    tyro.cli(benchmark, args=words).main(passed_on)


def print_row(*cells: Any) -> None:
    """Print a line of a Markdown table at once."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def print_head(*columns: str) -> None:
    """Print the head of a Markdown table."""
    print_row(*columns)
    print(len(columns) * "|---" + "|", flush=True)


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows that are there."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Add a row; the first one brings the names of the columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    first = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if first:
            writer.writeheader()
        writer.writerow(row)


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
