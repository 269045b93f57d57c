"""Train in this process with nerfstudio's pipeline, optimisers and callbacks, without its trainer: for benchmarks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers

from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.yaml_records import with_overrides
from thermoxels_ns.training.pipeline import ThermoxelsPipeline
from thermoxels_ns.training.schedule import Schedule


class TrainingRun:
    """A training that can be stepped.

    Args:
        scene: Scene folder.
        schedule: Resolution and length.
        overrides: What else differs from the default configuration, nested as in a preset.
        learning_rates: Factors on the learning rates by group.
    """

    def __init__(
        self,
        scene: Path,
        schedule: Schedule,
        overrides: Mapping[str, Any] | None = None,
        learning_rates: Mapping[str, float] | None = None,
    ):
        config = deepcopy(thermoxels.config)
        config.follow_schedule(schedule)  # type: ignore[attr-defined]
        config.pipeline.datamanager.data = scene
        config = with_overrides(config, overrides or {})
        for name, factor in (learning_rates or {}).items():
            config.optimizers[name]["optimizer"].lr *= factor
            config.optimizers[name]["scheduler"].lr_final *= factor
        pipeline = config.pipeline.setup(device="cpu", test_mode="val")
        assert isinstance(pipeline, ThermoxelsPipeline)
        self.pipeline, self.config, self.step, self.seconds = pipeline, config, 0, 0.0
        self._start_step = 0
        pipeline.train()
        groups = pipeline.get_param_groups()
        self.optimizers = Optimizers({k: v for k, v in config.optimizers.items() if k in groups}, groups)
        attributes = TrainingCallbackAttributes(
            optimizers=self.optimizers,
            grad_scaler=None,  # type: ignore[arg-type]
            pipeline=pipeline,
            trainer=self,  # type: ignore[arg-type]
        )
        self.callbacks = pipeline.get_training_callbacks(attributes)

    def advance(self, until: int, observe: Callable[[TrainingRun], None] | None = None) -> None:
        """Train until a step; `observe` is called after each, its time not counted."""
        self.pipeline.train()
        while self.step < until:
            start = time.perf_counter()
            for callback in self.callbacks:
                callback.run_callback_at_location(self.step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
            self.take_step()
            self.optimizers.scheduler_step_all(self.step)
            self.step += 1
            self.seconds += time.perf_counter() - start
            if observe is not None:
                observe(self)

    def take_step(self) -> None:
        """One batch forward, backward and through the optimisers."""
        self.optimizers.zero_grad_all()
        _, losses, _ = self.pipeline.get_train_loss_dict(self.step)
        sum(losses.values()).backward()  # type: ignore[union-attr]
        for optimizer in self.optimizers.optimizers.values():
            optimizer.step()

    def evaluate(self) -> dict[str, float]:
        """Metrics of the held-out views, and of the geometry where truth is known."""
        self.pipeline.eval()
        return {**self.pipeline.get_average_eval_image_metrics(), **self.pipeline.geometry_metrics()}
