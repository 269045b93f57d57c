"""nerfstudio's trainer, except that an interrupted save never harms an earlier checkpoint."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

import torch
from nerfstudio.engine.trainer import Trainer, TrainerConfig


@dataclass
class ThermoxelsTrainerConfig(TrainerConfig):
    """Settings of a training run."""

    _target: type = field(default_factory=lambda: ThermoxelsTrainer)


class ThermoxelsTrainer(Trainer):
    """Trainer whose checkpoints are complete or absent."""

    def save_checkpoint(self, step: int) -> None:
        """Save model and optimisers under a temporary name, rename, and only then delete older checkpoints.

        The temporary file lies beside the checkpoint folder, not in it: nerfstudio takes every name in there for a
        checkpoint's.
        """
        if self.local_rank != 0:
            return
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        final = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        unfinished = self.checkpoint_dir.parent / f".{final.name}.part"
        pipeline = getattr(self.pipeline, "module", self.pipeline)
        try:
            torch.save(
                {
                    "step": step,
                    "pipeline": pipeline.state_dict(),
                    "optimizers": {k: v.state_dict() for k, v in self.optimizers.optimizers.items()},
                    "schedulers": {k: v.state_dict() for k, v in self.optimizers.schedulers.items()},
                    "scalers": self.grad_scaler.state_dict(),
                },
                unfinished,
            )
            os.replace(unfinished, final)
        finally:
            unfinished.unlink(missing_ok=True)
        if self.config.save_only_latest_checkpoint:
            for other in self.checkpoint_dir.glob("*.ckpt"):
                if other != final:
                    other.unlink()
