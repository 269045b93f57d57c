"""Running the real console scripts, and the short training that integration tests share."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

SHORT_TRAINING = [
    *("--max-num-iterations", "40", "--steps-per-save", "20", "--vis", "tensorboard"),
    *("--pipeline.model.resolutions", "12", "24", "--pipeline.model.refine-at", "15"),
    *("--pipeline.model.prune-at", "30", "--pipeline.model.thin-at", "35"),
    *("--pipeline.model.view-dependence-from", "25", "--pipeline.datamanager.train-num-rays-per-batch", "512"),
    *("--logging.local-writer.enable", "False", "--save-only-latest-checkpoint", "False"),
]
SCREEN = {"COLUMNS": "200", "TERM": "dumb"}


def run(
    *command: str, timeout_s: float = 300.0, cwd: Path | None = None, threads: int = 1
) -> subprocess.CompletedProcess[str]:
    """Run a console script of this environment as a user would, with its output captured as one text."""
    script = Path(sys.executable).with_name(command[0])
    return subprocess.run(
        [str(script), *command[1:]],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=timeout_s,
        check=False,
        cwd=cwd,
        env={**os.environ, **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads)), **SCREEN},
    )


@dataclass(frozen=True)
class Trained:
    """A scene folder and the run that was trained on it."""

    scene: Path
    run_folder: Path

    @property
    def config(self) -> Path:
        return self.run_folder / "config.yml"

    @property
    def checkpoints(self) -> Path:
        return self.run_folder / "nerfstudio_models"
