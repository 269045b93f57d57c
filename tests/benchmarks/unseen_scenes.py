"""The default training on scenes from seeds, on which nobody tuned anything: how many reach the quality promised.

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

from measuring import run_with_options, synthetic_scene, train_and_evaluate

from thermoxels_ns.synthetic.random_scene import FAMILIES
from thermoxels_ns.synthetic.scene_truth import SyntheticScene

_TARGETS = {"psnr_box": (">=", 30.0), "thermal_mae_box_c": ("<=", 0.4), "fscore_128": (">=", 0.85)}


@dataclass(frozen=True)
class Outcome:
    scene: SyntheticScene
    """The exact scene."""
    family: str
    """Kind of arrangement."""
    seconds: float
    """Wall time of `ns-train`."""
    figures: dict[str, float]
    """What `ns-eval` reports; of the whole image where it does not say what the box covers."""

    def met(self, name: str) -> bool:
        value, (relation, bound) = self.figures.get(name, math.nan), _TARGETS[name]
        return value >= bound if relation == ">=" else value <= bound

    @property
    def row(self) -> str:
        coldest, hottest = self.scene.temperature_bounds_c
        shown = {name: f"{value:.2f}" for name, value in self.figures.items()}
        bold = {name: f"**{shown[name]}**" for name in _TARGETS if name in shown and not self.met(name)}
        cells = [
            *(self.scene.name, self.family, f"{self.seconds:.0f}", f"{hottest - coldest:.0f} K"),
            *((shown | bold).get(name, "none") for name in (*_TARGETS, "precision", "recall")),
            f"{self.figures.get('half_transparent', math.nan):.1%}",
        ]
        return f"| {' | '.join(cells)} |"


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
        """Print a line per scene as it is done, then how many meet the targets."""
        print("| scene | shows | seconds | range | box PSNR, dB | box MAE, °C | F-score | precision | recall | half |")
        print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
        outcomes = []
        for seed in self.seeds:
            outcomes.append(self.measure(seed, options))
            print(outcomes[-1].row, flush=True)
        for name, (relation, bound) in _TARGETS.items():
            print(f"{name} {relation} {bound:g}: {sum(one.met(name) for one in outcomes)} of {len(outcomes)}")
        print(f"all three: {sum(all(map(one.met, _TARGETS)) for one in outcomes)} of {len(outcomes)}")

    def measure(self, seed: int, options: Sequence[str]) -> Outcome:
        folder = self.output / f"{self.family}-{seed}"
        scene = synthetic_scene(folder.name, folder / "scene")
        seconds, figures = train_and_evaluate(folder / "scene", folder, options)
        for name, whole in (("psnr_box", "psnr"), ("thermal_mae_box_c", "thermal_mae_c")):
            figures.setdefault(name, figures.get(whole, math.nan))
        return Outcome(scene, FAMILIES[seed % len(FAMILIES)].name, seconds, figures)


if __name__ == "__main__":
    run_with_options(UnseenScenes)
