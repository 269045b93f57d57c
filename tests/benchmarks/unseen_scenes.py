"""The default training on scenes from seeds, on which nobody tuned anything.

    python tests/benchmarks/unseen_scenes.py --output RUNS
    python tests/benchmarks/unseen_scenes.py --output RUNS --seeds 3 17 --options --pipeline.model.photo-depth off
    python tests/benchmarks/unseen_scenes.py --output RUNS --family random --seeds 0 1 2 3 4 5 6 7 8 9

Each scene is written, trained and evaluated by the commands that a user types (`ns-train thermoxels`, `ns-eval`), with
their defaults and without the exact box; what follows `--options`, which comes last, is handed to `ns-train`. Logs and
results stay in the output folder. Seconds are those of the whole `ns-train`, which need an otherwise idle machine to
mean anything. F-scores are those at 1.5 voxels of 128 along the exact box.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from measuring import print_head, print_row, run_with_options, synthetic_scene, train_and_evaluate

from thermoxels_ns.synthetic.random_scene import FAMILIES

SHOWN = ("psnr_box", "thermal_mae_box_c", "fscore_128", "precision", "recall")


@dataclass
class UnseenScenes:
    """Train on scenes from seeds. `--options ...`, last, goes to ns-train as it is."""

    output: Path
    """Folder for scenes, runs, logs and results. A scene that is there already is not written again."""
    seeds: tuple[int, ...] = tuple(range(20))
    """Seeds; five in a row show each kind of body once, fifteen show each before each kind of surroundings."""
    family: Literal["wild", "random"] = "wild"
    """Scenes before all kinds of surroundings (wild), or before smooth gradients alone, without plain walls, mirrors
    and railings (random)."""

    def main(self, options: Sequence[str]) -> None:
        """Print a line per scene as it is done."""
        print_head(
            *("scene", "shows", "seconds", "range", "box PSNR, dB", "box MAE, °C", "F-score", "precision", "recall"),
            "half",
        )
        for seed in self.seeds:
            folder = self.output / f"{self.family}-{seed}"
            scene = synthetic_scene(folder.name, folder / "scene")
            seconds, figures = train_and_evaluate(folder / "scene", folder, options)
            for name, whole in (("psnr_box", "psnr"), ("thermal_mae_box_c", "thermal_mae_c")):
                figures.setdefault(name, figures.get(whole, math.nan))  # the whole image where nothing says the box
            coldest, hottest = scene.temperature_bounds_c
            shown = [f"{figures.get(name, math.nan):.2f}" for name in SHOWN]
            family, half = FAMILIES[seed % len(FAMILIES)].name, figures["half_transparent"]
            print_row(scene.name, family, f"{seconds:.0f}", f"{hottest - coldest:.0f} K", *shown, f"{half:.1%}")


if __name__ == "__main__":
    run_with_options(UnseenScenes)
