"""What flaws of cameras and poses cost the default training, and what its corrections find and give back.

    python tests/benchmarks/imperfections.py --output RUNS
    python tests/benchmarks/imperfections.py --output RUNS --scenes house-corner --flaws none all --seed 100
    python tests/benchmarks/imperfections.py --output RUNS --scenes wild-0 wild-1 --flaws none

Each scene is written with each flaw (`thermoxels synthetic` has them as options), trained and evaluated by `ns-train
thermoxels` and `ns-eval` with their defaults. A line per run: seconds of the whole `ns-train` (they need an otherwise
idle machine to mean anything), PSNR as given, of what the box covers, and with the corrections fitted too, thermal
error with each held-out image's mean difference removed, F at 1.5 voxels of 128 of the whole surface and of what
training cameras see, and what the log says was corrected.
"""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

from measuring import print_head, print_row, run_with_options, train_and_evaluate

from thermoxels_ns.synthetic.imperfections import Imperfections
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

EXPOSURE = Imperfections(exposure_stops=0.3, white_balance=0.03, noise_counts=2.0)
THERMAL = Imperfections(thermal_blur_px=1.5, drift_k=1.0, noise_k=0.1)
FLAWS = {
    "none": Imperfections(),
    "exposure": EXPOSURE,
    "poses": Imperfections(pose_error_deg=0.15),
    "walk": Imperfections(pose_error_deg=0.15, pose_correlation=0.95),
    "focal": Imperfections(focal_error=0.005),
    "thermal": THERMAL,
    "passers-by": Imperfections(passers_by=0.2),
    "all": replace(EXPOSURE, pose_error_deg=0.15, thermal_blur_px=1.5, drift_k=1.0, noise_k=0.1),
}
"""The first sizes are those at which real captures were found to be off; x2 behind a name doubles them."""
_SCENES = ("house-corner", "courtyard", "hot-object", "random-0", "random-1", "random-2")
_SHOWN = ("psnr", "psnr_box", "psnr_fitted", "thermal_mae_debiased_c", "fscore_128", "fscore_128_seen")


def doubled(flaws: Imperfections) -> Imperfections:
    """The same flaws, twice as large; shares and JPEG stay."""
    same = ("jpeg_quality", "pose_correlation", "passers_by")
    return replace(flaws, **{name: 2.0 * value for name, value in vars(flaws).items() if name not in same})


@dataclass
class ImperfectCameras:
    """Train on scenes with flaws. `--options ...`, last, goes to ns-train as it is."""

    output: Path
    """Folder for scenes, runs, logs and results; a scene that is there is not written again."""
    scenes: tuple[str, ...] = _SCENES
    """Synthetic scenes."""
    flaws: tuple[str, ...] = tuple(FLAWS)
    """Flaws by name, x2 behind it for twice the size, such as poses-x2."""
    seed: int = 0
    """Seed of what is drawn."""

    def main(self, options: list[str]) -> None:
        """Print a line per run as it is done."""
        figures_shown = ("PSNR", "PSNR of the box", "fitted PSNR, dB", "debiased MAE, °C", "F", "F, seen")
        print_head("scene", "flaws", "seconds", *figures_shown, "corrected")
        for name in self.scenes:
            for flaw in self.flaws:
                seconds, figures, corrected = self.measure(name, flaw, options)
                shown = (f"{figures.get(key, math.nan):.3g}" for key in _SHOWN)
                print_row(name, flaw, f"{seconds:.0f}", *shown, corrected or "nothing")

    def measure(self, name: str, flaw: str, options: list[str]) -> tuple[float, dict[str, float], str]:
        folder = self.output / f"{name}-{flaw}"
        kind = flaw.removesuffix("-x2")
        imperfections = FLAWS[kind] if kind == flaw else doubled(FLAWS[kind])
        if not (folder / "scene" / "transforms.json").is_file():
            write_scene(make_scene(name), folder / "scene", seed=self.seed, imperfections=imperfections, progress=False)
        seconds, figures = train_and_evaluate(folder / "scene", folder, options)
        log = re.sub(r"\s+", " ", (folder / "train.log").read_text(encoding="utf-8"))
        patterns = {
            "poses": r"lie ([\d.]+ pixels from their points, [\d.]+) with the poses given",
            "gains": r"white balance by ([\d.]+%): corrected",
            "offsets": r"against each other by ([\d.]+ K): corrected",
        }
        found = {what: re.search(pattern, log) for what, pattern in patterns.items()}
        return seconds, figures, "; ".join(f"{what} {match[1]}" for what, match in found.items() if match)


if __name__ == "__main__":
    run_with_options(ImperfectCameras)
