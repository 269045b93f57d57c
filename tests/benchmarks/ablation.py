"""What each mechanism that says something about geometry is worth: trainings with all of them, and without each.

    python tests/benchmarks/ablation.py --output RUNS
    python tests/benchmarks/ablation.py --output RUNS --quality draft --scenes wild-20 saharov32 --without carve planes

Scenes are synthetic ones by name, or `saharov32` (see real_depths.py) and `arco` from ../shared/data beside the
checkout. A synthetic scene's name may go on with flaws of its photographs and the seed that draws them, as in
`house-corner:all:5` (`FLAWS` in measuring.py): with `--without` and no mechanism, rows say what flaws cost, and logs
what was corrected. Each is trained and evaluated by the commands that a user types; what follows `--options`, which
comes last, is handed to `ns-train` in all runs. Each run is a row of ``ablation.csv`` in the output folder, written as
it ends. A row that is there is not measured again: a benchmark that was interrupted goes on, and more scenes, seeds or
mechanisms may follow. Logs stay, checkpoints go. A run that fails is said and left out; the next call tries it again.
Rows of earlier code are not told from those of today's: begin with an empty folder.

In the end a table says for each mechanism the median over the scenes of each figure with everything on minus without
the mechanism, the scenes where that is least and most for F, and the noise: of the figures of different seeds with
everything on, the largest minus the smallest, the median over the scenes. Seconds need an otherwise idle machine to
mean anything.

`MECHANISMS` names them. To add or remove one is one entry: options of ns-train, or what to put in the place of
functions and constants (module, attribute, replacement) before `ns-train` and `ns-eval` begin. A name that was imported
elsewhere by `from ... import` has to be replaced there, where it is used; constants of compiled kernels cannot be
replaced. An attribute that does not exist is an error before anything runs.
"""

import importlib
import json
import math
import shutil
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from measuring import (
    SHARED_DATA,
    append_row,
    read_rows,
    run_of,
    run_quietly,
    run_with_options,
    synthetic_scene,
    train_and_evaluate,
)

from thermoxels_ns.core.errors import ThermoxelsError

_MODEL, _LOSS = "--pipeline.model.", "--pipeline.model.loss-overrides"
_CALLBACKS = "thermoxels_ns.training.callbacks"


@dataclass(frozen=True)
class Without:
    """How a mechanism is switched off."""

    options: tuple[str, ...] = ()
    """Options of ns-train."""
    replaced: tuple[tuple[str, str, Any], ...] = ()
    """Module, attribute in it (dots lead into classes), and what takes its place."""


def _without_ends(*given: Any) -> Any:
    """Weights of voxels none of which is kept because rays end in it."""
    from thermoxels_ns.training.ray_statistics import voxel_weights

    largest, ends = voxel_weights(*given)
    return largest, ends & False


MECHANISMS: Mapping[str, Without] = {
    "photo-depth": Without((f"{_MODEL}photo-depth", "off")),
    "backdrop-rays": Without((_LOSS, "backdrop", "0")),
    "plain-backdrop": Without(
        replaced=(
            ("thermoxels_ns.multiview.stereo", "plain_backdrop", lambda _, depth: 3 * (np.zeros(len(depth), bool),)),
        )
    ),
    "ceilings": Without(replaced=(("thermoxels_ns.multiview.backdrop", "what_is_above", lambda *four: "sky"),)),
    "carve": Without((f"{_MODEL}carve", "off")),
    "opened-rays": Without(replaced=((_CALLBACKS, "MOST_OPENED_RAYS", 1.0),)),
    "opaque-neighbours": Without(replaced=((_CALLBACKS, "OPAQUE_DEPTH", math.inf),)),
    "keep-ends": Without(replaced=((_CALLBACKS, "voxel_weights", _without_ends),)),
    "thinning": Without((f"{_MODEL}thin-threshold", "0")),
    "box-shown-well": Without(replaced=(("thermoxels_ns.core.snapshot", "SHOWN_WELL", 0.0),)),
    "front": Without(replaced=(("thermoxels_ns.mesh.solid.free_space", "REACH", -2.0),)),
    "surroundings": Without((f"{_MODEL}surroundings", "off")),
    "bend": Without((_LOSS, "bend", "0")),
    "distortion": Without((_LOSS, "distortion", "0")),
    "mean-colours": Without(
        replaced=((_CALLBACKS, "mean_colours", lambda *three: np.full((len(three[2]), 3), 0.5, np.float32)),)
    ),
}


def _all_of(*names: str) -> Without:
    """Several mechanisms at once: where all of them gain less than the noise, so does each."""
    chosen = [MECHANISMS[name] for name in names]
    return Without(sum((one.options for one in chosen), ()), sum((one.replaced for one in chosen), ()))


MECHANISMS = {
    **MECHANISMS,
    "hole-rules": _all_of("opened-rays", "opaque-neighbours", "keep-ends"),
    "pruning-rules": _all_of("opened-rays", "opaque-neighbours", "keep-ends", "thinning"),
    "colours-and-distortion": _all_of("mean-colours", "distortion"),
}
EVERYTHING = "everything"

SAHAROV, ARCO = "saharov32", "arco"
_METHODS = {SAHAROV: "thermoxels", ARCO: "thermoxels-arco"}
_SKIES = ("0.55,0.57,0.60", "0.30,0.45,0.70", "0.86,0.87,0.88", "0.12,0.13,0.16")  # overcast, blue, bright, dusk
_SCENES = (
    *(f"wild-{seed}" for seed in range(20, 30)),
    "house-corner+white",
    *(f"house-corner+sky={sky}" for sky in _SKIES),
    SAHAROV,
)
_KEY = ("mechanism", "scene", "seed", "quality", "options")
FIGURES = {
    "fscore_128_seen": "{:+.3f}",
    "psnr": "{:+.2f}",
    "psnr_8": "{:+.2f}",
    "depth_off_share": "{:+.3f}",
    "sky_filled": "{:+.4f}",
    "half_transparent": "{:+.4f}",
    "seconds": "{:+.0f}",
}
"""Figures of the table and how they are written; those of depth_off_share and what follows are better if smaller."""
_KEPT = (
    *("fscore_128_seen", "fscore_128", "fscore", "precision", "recall", "psnr", "psnr_8", "psnr_box"),
    *("psnr_fitted", "thermal_psnr", "thermal_mae_c", "thermal_mae_debiased_c", "half_transparent"),
    "surface_distance_m",
    *("depth_error", "depth_off_share", "opaque_share", "sky_filled", "seconds"),
)
_COMMAND = "--run-without"  # First word of this script's command line in processes that it starts
_DEPTHS = "real-depths"  # What real_depths.py finds out about a run, as a command of such a process

Row = dict[str, str]


@dataclass
class Ablation:
    """Train with and without each mechanism. `--options ...`, last, goes to ns-train as it is."""

    output: Path
    """Folder for scenes, logs, ablation.csv and ablation.md."""
    scenes: tuple[str, ...] = _SCENES
    """Synthetic scenes by name, perhaps with flaws, saharov32, arco."""
    without: tuple[str, ...] = tuple(MECHANISMS)
    """Mechanisms that are switched off, one at a time; with everything on comes first."""
    quality: Literal["draft", "standard"] = "standard"
    """Resolution and length of the trainings."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings with everything on; what differs between them is the noise. 0 is that of ns-train."""
    seeds_without: tuple[int, ...] = (0,)
    """Seeds of the trainings without a mechanism."""

    def main(self, options: Sequence[str]) -> None:
        """Print a line per run as it is done, then the table; it is written to ``ablation.md`` too."""
        for name in self.without:
            check_replaced(name)
        path, wanted = self.output / "ablation.csv", list[Row]()
        known = {tuple(row[key] for key in _KEY): row for row in read_rows(path)}
        for mechanism, scene, seed in self.runs():
            key = (mechanism, scene, str(seed), self.quality, " ".join(options))
            if key not in known:
                try:
                    figures = self.measure(mechanism, scene, seed, options)
                except ThermoxelsError as problem:
                    print(f"{mechanism}, {scene}, seed {seed}: failed and left out: {problem}", flush=True)
                    continue
                given = {name: f"{figures[name]:.6g}" for name in _KEPT if name in figures}
                row = known[key] = dict.fromkeys((*_KEY, *_KEPT), "") | dict(zip(_KEY, key)) | given
                append_row(path, row)
                shown = ", ".join(f"{name} {row[name]}" for name in FIGURES if row[name])
                print(f"{mechanism}, {scene}, seed {seed}: {shown}", flush=True)
            wanted.append(known[key])
        table = "\n".join(table_of(wanted))
        (self.output / "ablation.md").write_text(table + "\n", encoding="utf-8")
        print(f"\n{table}")

    def runs(self) -> Iterator[tuple[str, str, int]]:
        """Mechanism that is off, scene and seed of each run, in order."""
        for mechanism in (EVERYTHING, *self.without):
            for seed in self.seeds if mechanism == EVERYTHING else self.seeds_without:
                for scene in self.scenes:
                    yield mechanism, scene, seed

    def measure(self, mechanism: str, scene: str, seed: int, options: Sequence[str]) -> dict[str, float]:
        """Train and evaluate once; the folder keeps logs alone."""
        method, data = _METHODS.get(scene, "thermoxels"), SHARED_DATA / scene
        if scene not in _METHODS:
            data = self.output / "scenes" / scene
            synthetic_scene(scene, data)
        folder = self.output / "runs" / f"{mechanism} {scene} {seed} {self.quality}"
        shutil.rmtree(folder, ignore_errors=True)
        launcher = (Path(sys.executable).name, str(Path(__file__).resolve()), _COMMAND, mechanism)
        off = MECHANISMS[mechanism].options if mechanism != EVERYTHING else ()
        words = ["--quality", self.quality, f"{_MODEL}seed", str(seed), "--pipeline.datamanager.seed", str(42 + seed)]
        seconds, figures = train_and_evaluate(data, folder, [*words, *off, *options], method, launcher)
        if scene == SAHAROV:
            found = folder / "depths.json"
            command = [*launcher, _DEPTHS, str(run_of(folder) / "config.yml"), str(data), str(found)]
            run_quietly(command, folder / "depths.log")
            figures |= json.loads(found.read_text(encoding="utf-8"))
        shutil.rmtree(folder / "outputs")
        return figures | {"seconds": seconds}


def check_replaced(mechanism: str) -> list[tuple[Any, str, Any]]:
    """Find what a mechanism's entry replaces: objects, the names of their attributes, and the replacements.

    Raises:
        ThermoxelsError: There is no such entry, or no such attribute; the message names them.
    """
    if mechanism == EVERYTHING:
        return []
    if mechanism not in MECHANISMS:
        remedy = "Choose among them, or add an entry."
        raise ThermoxelsError("mechanism", expected=f"one of {', '.join(MECHANISMS)}", got=mechanism, remedy=remedy)
    found = []
    for module, attribute, replacement in MECHANISMS[mechanism].replaced:
        path, _, name = attribute.rpartition(".")
        try:
            owner = importlib.import_module(module)
            owner = attrgetter(path)(owner) if path else owner
            getattr(owner, name)
        except (ImportError, AttributeError) as problem:
            what, expected = f"MECHANISMS[{mechanism!r}]", f"an attribute {attribute} of {module}"
            remedy = "Change the entry to what took its place, or remove it."
            raise ThermoxelsError(what, expected=expected, got=f"none ({problem})", remedy=remedy) from problem
        found.append((owner, name, replacement))
    return found


def run_without(mechanism: str, words: Sequence[str]) -> None:
    """Run a command of this installation in this process without a mechanism."""
    if words[0] == _DEPTHS:
        begin: Callable[[], None] = partial(write_depths, *map(Path, words[1:]))
    else:
        (command,) = entry_points(group="console_scripts", name=words[0])
        begin = command.load()  # before anything of ours, which prepares it while nerfstudio loads plugins
    for owner, name, replacement in check_replaced(mechanism):
        setattr(owner, name, replacement)
    sys.argv = list(words)
    begin()


def write_depths(config: Path, scene: Path, output: Path) -> None:
    """Compare a run's depths with the scene's and write the figures."""
    from real_depths import held_out_depths

    output.write_text(json.dumps(held_out_depths(config, scene)), encoding="utf-8")


def table_of(rows: Sequence[Row]) -> list[str]:
    """Lines of a table: what each mechanism adds to each figure, and the noise."""
    values: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        for name in FIGURES:
            if row.get(name):
                values.setdefault((row["mechanism"], row["scene"], name), []).append(float(row[name]))
    scenes = list(dict.fromkeys(row["scene"] for row in rows))

    def gains(mechanism: str, name: str) -> dict[str, float]:
        pairs = {scene: [values.get((which, scene, name)) for which in (EVERYTHING, mechanism)] for scene in scenes}
        return {scene: statistics.median(a) - statistics.median(b) for scene, (a, b) in pairs.items() if a and b}

    lines = [
        "Medians over the scenes of the figure with everything on minus without the mechanism.",
        "",
        f"| without | {' | '.join(FIGURES)} | scenes | least and most F |",
        f"|---|{'---:|' * len(FIGURES)}---:|---|",
    ]
    for mechanism in dict.fromkeys(row["mechanism"] for row in rows):
        if mechanism == EVERYTHING:
            continue
        cells = [_median(list(gains(mechanism, name).values()), name) for name in FIGURES]
        score = sorted((gain, scene) for scene, gain in gains(mechanism, "fscore_128_seen").items())
        ends = ", ".join(f"{scene} {gain:+.3f}" for gain, scene in (score[:1] + score[-1:] if score else []))
        lines.append(f"| {mechanism} | {' | '.join(cells)} | {len(gains(mechanism, 'seconds'))} | {ends} |")
    spreads = {
        name: [
            max(found) - min(found)
            for (mechanism, _, figure), found in values.items()
            if mechanism == EVERYTHING and figure == name and len(found) > 1
        ]
        for name in FIGURES
    }
    cells = [_median(spread, name).lstrip("+") for name, spread in spreads.items()]
    return [*lines, f"| noise, between seeds | {' | '.join(cells)} | {len(spreads['seconds'])} | |"]


def _median(found: Sequence[float], name: str) -> str:
    return FIGURES[name].format(statistics.median(found)) if found else ""


if __name__ == "__main__":
    if sys.argv[1:2] == [_COMMAND]:
        run_without(sys.argv[2], sys.argv[3:])
    else:
        run_with_options(Ablation)
