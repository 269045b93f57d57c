"""Train far longer than anyone should, on a hard scene, and look for numbers that are not finite.

    python tests/benchmarks/long_training.py --steps 20000

Prints the loss every twentieth of the run and fails at the first parameter or optimiser state that is not finite.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from training_run import TrainingRun

from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene
from thermoxels_ns.training.schedule import schedule_for


@dataclass
class LongTraining:
    """Train long."""

    scene: str = "courtyard"
    """Synthetic scene."""
    steps: int = 20_000
    """Training steps."""
    resolution: int = 64
    """Voxels along the longest side."""
    rays: int = 512
    """Rays per step."""

    def main(self) -> None:
        """Train and check."""
        with tempfile.TemporaryDirectory() as folder:
            scene = write_scene(make_scene(self.scene), Path(folder) / "scene", noise_k=0.5, drift_k=1.0)
            rays = {"train_num_rays_per_batch": self.rays}
            run = TrainingRun(scene, schedule_for(self.resolution, self.steps), {"pipeline": {"datamanager": rays}})
            for part in range(1, 21):
                run.advance(part * self.steps // 20)
                self.check(run)
                _, losses, metrics = run.pipeline.get_train_loss_dict(run.step)
                shown = {
                    **{k: float(v.detach()) for k, v in losses.items()},
                    **{k: float(v) for k, v in metrics.items()},
                }
                print(run.step, " ".join(f"{name} {value:.4g}" for name, value in shown.items()), flush=True)
            print({name: round(value, 3) for name, value in run.evaluate().items()})

    def check(self, run: TrainingRun) -> None:
        """Stop at what is not finite."""
        for name, values in run.pipeline.model.state_dict().items():
            if values.is_floating_point() and not bool(torch.isfinite(values).all()):
                raise SystemExit(f"step {run.step}: {name} is not finite")
        for name, optimizer in run.optimizers.optimizers.items():
            for state in optimizer.state.values():
                for key, values in state.items():
                    if torch.is_tensor(values) and not bool(torch.isfinite(values).all()):
                        raise SystemExit(f"step {run.step}: optimiser {name}, {key} is not finite")


if __name__ == "__main__":
    tyro.cli(LongTraining).main()
