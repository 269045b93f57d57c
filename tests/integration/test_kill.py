import time
from pathlib import Path

import torch

from tests.integration.commands import SHORT_TRAINING, started, succeed


def test_kill_9_while_saving_loses_at_most_the_work_since_the_last_checkpoint(tiny_scene: Path, tmp_path: Path):
    """Every step saves; the signal is sent when a checkpoint is being written."""
    words = [
        *("thermoxels", "--output-dir", str(tmp_path), "--experiment-name", "killed", "--timestamp", "run"),
        *SHORT_TRAINING,
        *("--steps-per-save", "1", "--max-num-iterations", "100000", "--pipeline.model.resolutions", "32", "64"),
    ]
    scene = ("thermal-data", "--data", str(tiny_scene))
    folder = tmp_path / "killed" / "thermoxels" / "run" / "nerfstudio_models"
    with started("ns-train", *words, *scene, log=tmp_path / "log") as process:
        end = time.monotonic() + 200
        while len(list(folder.glob("*.ckpt"))) < 4 or not any(folder.parent.glob(".step-*.part")):
            assert process.is_alive() and time.monotonic() < end, "no checkpoint was written"
            time.sleep(0.0005)
    steps = []
    for checkpoint in folder.iterdir():
        steps.append(torch.load(checkpoint, weights_only=False)["step"])
        assert checkpoint.name == f"step-{steps[-1]:09d}.ckpt"
    assert sorted(steps) == list(range(1, max(steps) + 1)) and len(steps) >= 4
    again = [*words, "--load-dir", str(folder), "--max-num-iterations", "3", "--steps-per-save", "1000"]
    succeed("ns-train", *again, *scene)
    last = folder / f"step-{max(steps) + 3:09d}.ckpt"
    assert last.is_file(), sorted(path.name for path in folder.iterdir())
