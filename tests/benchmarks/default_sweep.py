"""How the defaults were found: one candidate at a time against the default, on unlike scenes.

Run it on an otherwise idle machine; a row takes one to two minutes per scene:

    python tests/benchmarks/default_sweep.py --scenes house-corner courtyard
    python tests/benchmarks/default_sweep.py --scenes hot-object pipes --only default   # not tuned on
    python tests/benchmarks/default_sweep.py --folders ../shared/data/arco --only default

Each row differs from the default in what its name says. Times are training loops and relate to the default's in the
same run; depths of photographs, and the trials by which a start is chosen without them, come before the loop and are
not in them; the log of a real training has their seconds.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from nerfstudio.utils.rich_utils import CONSOLE
from training_run import TrainingRun

from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene
from thermoxels_ns.training.schedule import QUALITIES, schedule_for


@dataclass(frozen=True)
class Candidate:
    """A setting beside the default."""

    model: Mapping[str, Any]
    """Options of the model."""
    rates: Mapping[str, float]
    """Factors on learning rates by group."""
    rays: int | None = None
    """Rays per step."""


def _losses(**weights: float) -> Candidate:
    return Candidate({"loss_overrides": weights}, {})


CANDIDATES: Mapping[str, Candidate] = {
    "default": Candidate({}, {}),
    "recipe paper": Candidate({"recipe": "paper"}, {}),
    "no depths of photographs": Candidate({"photo_depth": "off"}, {}),
    "plain start": Candidate({"start": "plain"}, {}),
    "start from photographs": Candidate({"start": "photographs"}, {}),
    "activation relu": Candidate({"density_activation": "relu"}, {"density": 15.0}),
    "activation softplus": Candidate({"density_activation": "softplus"}, {}),
    "start density 0.01": Candidate({"start_density": 0.01}, {}),
    "density rate x 1/3": Candidate({}, {"density": 1 / 3}),
    "density rate x 2": Candidate({}, {"density": 2.0}),
    "colour rate x 1/2": Candidate({}, {"sh": 0.5}),
    "colour rate x 2": Candidate({}, {"sh": 2.0}),
    "no distortion": _losses(distortion=0.0),
    "distortion x 1/10": _losses(distortion=0.01),
    "distortion x 3": _losses(distortion=0.3),
    "colour variation 1e-3": _losses(tv_sh=1e-3),
    "density variation 1e-4": _losses(tv_density=1e-4),
    "temperature variation 1e-4": _losses(tv_temperature=1e-4),
    "sparsity 1e-4": _losses(sparsity=1e-4),
    "beta 1e-3": _losses(beta=1e-3),
    "view-dependent from the start": Candidate({"view_dependence_from": 0}, {}),
    "no thinning": Candidate({"thin_at": []}, {}),
    "thinning at 0.15": Candidate({"thin_threshold": 0.15}, {}),
    "2048 rays": Candidate({}, {}, rays=2048),
    "thermal moves density": Candidate({"thermal_density_gradient": True}, {}),
}


@dataclass
class DefaultSweep:
    """Measure candidates."""

    scenes: tuple[str, ...] = ("house-corner", "courtyard", "hot-object")
    """Synthetic scenes."""
    folders: tuple[Path, ...] = ()
    """Scene folders beside those."""
    only: tuple[str, ...] = ()
    """Candidates to measure; none: all."""
    quality: str = "standard"
    """Resolution and steps."""

    def main(self) -> None:
        """Print a table per scene."""
        with tempfile.TemporaryDirectory() as folder:
            places = [write_scene(make_scene(name), Path(folder) / name) for name in self.scenes]
            for place in (*places, *self.folders):
                self.measure(place)

    def measure(self, scene: Path) -> None:
        """All candidates on one scene."""
        names = self.only or tuple(CANDIDATES)
        print(
            f"\n{scene.name}\n\n| setting | RGB PSNR | thermal MAE | F-score | precision | recall "
            "| half-transparent | time / default |"
        )
        print("|---|---|---|---|---|---|---|---|", flush=True)
        baseline = None
        for name in names:
            candidate = CANDIDATES[name]
            datamanager = {} if candidate.rays is None else {"train_num_rays_per_batch": candidate.rays}
            overrides = {"pipeline": {"model": dict(candidate.model), "datamanager": datamanager}}
            schedule = schedule_for(*QUALITIES[self.quality])  # type: ignore[index]
            quiet, CONSOLE.quiet = CONSOLE.quiet, True
            try:
                run = TrainingRun(scene, schedule, overrides, candidate.rates)
                run.advance(schedule.steps)
                found = run.evaluate()
            finally:
                CONSOLE.quiet = quiet
            baseline = baseline or run.seconds
            shown = [f"{found[key]:.2f}" if key in found else "" for key in ("fscore", "precision", "recall")]
            print(
                f"| {name} | {found['psnr']:.1f} dB | {found['thermal_mae_c']:.2f} °C | {' | '.join(shown)} "
                f"| {found['half_transparent']:.1%} | {run.seconds / baseline:.2f} ({run.seconds:.0f} s) |",
                flush=True,
            )


if __name__ == "__main__":
    tyro.cli(DefaultSweep).main()
