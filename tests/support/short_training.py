"""A few training steps in this process, without nerfstudio's trainer: for laws that need a trained model.

The optimisers, their schedules and the callbacks are those of the default method.
"""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers

from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.yaml_records import with_overrides
from thermoxels_ns.training.pipeline import ThermoxelsPipeline


def train(scene: Path, steps: int, model: dict[str, Any] | None = None, rays: int = 512, rate: float = 1.0):
    """Train the default method on a scene at 16 voxels, or as `model` says, and return its pipeline."""
    return train_with_optimizers(scene, steps, model, rays, rate)[0]


def train_with_optimizers(
    scene: Path,
    steps: int,
    model: dict[str, Any] | None = None,
    rays: int = 512,
    rate: float = 1.0,
    threads: int | None = 1,
) -> tuple[ThermoxelsPipeline, Optimizers]:
    """The same, and return the optimisers too.

    Args:
        scene: Scene folder.
        steps: Training steps.
        model: Overrides of the model's configuration; lattice changes happen where it says so.
        rays: Rays of each stream per step.
        rate: Factor on all learning rates.
        threads: Threads of the compiled kernels.
    """
    plain = {"resolutions": [16], "refine_at": [], "prune_at": [], "thin_at": []}
    config = with_overrides(
        deepcopy(thermoxels.config.pipeline),  # nerfstudio writes the folder into it
        {
            "cpu_threads": threads,
            "datamanager": {
                "data": scene,
                "train_num_rays_per_batch": rays,
                "thermal_num_rays_per_batch": rays,
            },
            "model": plain | (model or {}),
        },
    )
    pipeline = config.setup(device="cpu", test_mode="val")
    assert isinstance(pipeline, ThermoxelsPipeline)
    pipeline.train()
    settings = deepcopy(thermoxels.config.optimizers)
    for group in settings.values():
        group["optimizer"].lr *= rate
        group["scheduler"].lr_final *= rate
    optimizers = Optimizers(settings, pipeline.get_param_groups())
    trainer: Any = SimpleNamespace(_start_step=0, config=SimpleNamespace(max_num_iterations=steps))
    attributes = TrainingCallbackAttributes(optimizers, None, pipeline, trainer)
    callbacks = pipeline.get_training_callbacks(attributes)
    for step in range(steps):
        for callback in callbacks:
            callback.run_callback(step)
        optimizers.zero_grad_all()
        _, losses, _ = pipeline.get_train_loss_dict(step)
        sum(losses.values()).backward()  # type: ignore[union-attr]
        optimizers.optimizer_step_all()
        for scheduler in optimizers.schedulers.values():
            scheduler.step()
    pipeline.eval()
    return pipeline, optimizers
