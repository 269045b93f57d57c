"""What accuracy costs: training budgets against image, temperature and surface errors on a synthetic scene.

Run it on an otherwise idle machine:

    python tests/benchmarks/accuracy_cost.py hot-object

It runs ns-train, ns-eval and ns-export for each budget and prints a table as Markdown. Times are whole commands; the
last column relates the training time to that of the default budget in the same run.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from thermoxels_ns.data.synthetic import make_scene, write_scene

GROUPS = ("density", "sh", "temperature", "background")


@dataclass(frozen=True)
class Budget:
    """One setting of the schedule."""

    name: str
    resolutions: tuple[int, ...]
    refine_at: tuple[int, ...]
    prune_at: tuple[int, ...]
    steps: int

    def options(self) -> list[str]:
        words = ["--max-num-iterations", str(self.steps)]
        for group in GROUPS:
            words += [f"--optimizers.{group}.scheduler.max-steps", str(self.steps)]
        words += ["--pipeline.model.resolutions", *map(str, self.resolutions)]
        words += ["--pipeline.model.refine-at", *map(str, self.refine_at)]
        words += ["--pipeline.model.prune-at", *map(str, self.prune_at)]
        return [*words, "--pipeline.model.distortion-ramp", str(self.steps // 8), str(self.steps // 2)]


BUDGETS = (
    Budget("32 voxels, 400 steps", (32,), (), (250,), 400),
    Budget("64 voxels, 700 steps", (32, 64), (200,), (400,), 700),
    Budget("64 voxels, 1500 steps (default)", (32, 64), (400,), (800,), 1500),
)
BASELINE = 2


def run(*words: str) -> float:
    """Run a console script of this environment; return its wall time [s]."""
    start = time.monotonic()
    script = Path(sys.executable).with_name(words[0])
    done = subprocess.run([str(script), *words[1:]], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(words)}\n{done.stdout[-4000:]}")
    return time.monotonic() - start


def measure(budget: Budget, scene: Path, work: Path) -> dict[str, float]:
    """Train, evaluate and export with one budget."""
    name = f"run{BUDGETS.index(budget)}"
    base = ["--output-dir", str(work), "--experiment-name", name, "--timestamp", "t", "--vis", "tensorboard"]
    seconds = run("ns-train", "thermoxels", *base, *budget.options(), "thermal-data", "--data", str(scene))
    config = str(work / name / "thermoxels" / "t" / "config.yml")
    run("ns-eval", "--load-config", config, "--output-path", str(work / f"{name}.json"))
    exported = work / f"{name}-export"
    options = ["--metres-per-unit", "1", "--pictures", "False", "--steps", "1"]
    run("ns-export", "thermoxels-mesh", "--load-config", config, "--output-dir", str(exported), *options)
    results = json.loads((work / f"{name}.json").read_text())["results"]
    truth = json.loads((exported / "summary.json").read_text())["truth"]
    return {
        "seconds": seconds,
        "psnr": results["psnr"],
        "thermal_mae_c": results["thermal_mae_c"],
        "fscore": truth["fscore"],
        "distance_mm": 1000 * truth["mean_distance_m"],
        "nodes_mae_c": truth["temperature_mae_c"],
    }


def main() -> None:
    """Measure every budget and print the table."""
    name = sys.argv[1] if len(sys.argv) > 1 else "hot-object"
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        scene = write_scene(make_scene(name), work / "scene")
        rows = [measure(budget, scene, work) for budget in BUDGETS]
    print(f"\n{name}, 42 training views of 320 x 240, held-out views and exact surface\n")
    print(
        "| budget | RGB PSNR | thermal MAE | F-score at 1.5 voxels | surface distance | mesh nodes | time / default |"
    )
    print("|---|---|---|---|---|---|---|")
    for budget, row in zip(BUDGETS, rows):
        print(
            f"| {budget.name} | {row['psnr']:.1f} dB | {row['thermal_mae_c']:.2f} °C | {row['fscore']:.2f} "
            f"| {row['distance_mm']:.0f} mm | {row['nodes_mae_c']:.2f} °C "
            f"| {row['seconds'] / rows[BASELINE]['seconds']:.2f} ({row['seconds']:.0f} s) |"
        )


if __name__ == "__main__":
    main()
