"""nerfstudio's trainer, except that an interrupted save never harms an earlier checkpoint."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.engine.trainer import Trainer, TrainerConfig

from thermoxels_ns.schedule import QUALITIES, Quality, Schedule, schedule_for


@dataclass
class ThermoxelsTrainerConfig(TrainerConfig):
    """Settings of a training run."""

    _target: type = field(default_factory=lambda: ThermoxelsTrainer)
    quality: Quality | None = None
    """Named setting of resolution and length: draft (64 voxels along the longest side, 800 steps: a first look, half
    a minute on two cores), standard (128 voxels, 1500 steps, the default: one to two minutes) or fine (256 voxels,
    4000 steps: some minutes); `thermoxels cost` measures what they give. It replaces max-num-iterations, the lengths
    of the learning rate schedules, and the model's resolutions, refine-at, prune-at, thin-at, distortion-ramp and
    view-dependence-from."""

    def __post_init__(self) -> None:
        if self.quality is not None:
            self.follow_schedule(schedule_for(*QUALITIES[self.quality]))

    def follow_schedule(self, schedule: Schedule) -> None:
        """Set everything that depends on the resolution and the number of steps."""
        self.max_num_iterations = schedule.steps
        for group in self.optimizers.values():
            if group.get("scheduler") is not None:
                group["scheduler"].max_steps = schedule.steps
        model: Any = self.pipeline.model
        for item in ("resolutions", "refine_at", "prune_at", "thin_at", "distortion_ramp", "view_dependence_from"):
            setattr(model, item, getattr(schedule, item))


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
