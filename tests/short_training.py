"""A few training steps in this process, without nerfstudio's trainer: for laws that need a trained model."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import torch

from thermoxels_ns.config import thermoxels
from thermoxels_ns.pipeline import ThermoxelsPipeline
from thermoxels_ns.presets import with_overrides


def train(scene: Path, steps: int, model: dict[str, Any] | None = None, rays: int = 512, rate: float = 1.0):
    """Train the default method on a scene at 16 voxels, or as `model` says, and return its pipeline."""
    config = with_overrides(
        deepcopy(thermoxels.config.pipeline),  # nerfstudio writes the folder into it
        {
            "datamanager": {
                "data": scene,
                "train_num_rays_per_batch": rays,
                "thermal_num_rays_per_batch": rays,
            },
            "model": {"resolutions": [16], "refine_at": [], "prune_at": [], **(model or {})},
        },
    )
    pipeline = config.setup(device="cpu", test_mode="val")
    assert isinstance(pipeline, ThermoxelsPipeline)
    pipeline.train()
    optimizers = {
        name: torch.optim.Adam(group, lr=rate * thermoxels.config.optimizers[name]["optimizer"].lr, eps=1e-15)
        for name, group in pipeline.get_param_groups().items()
    }
    for step in range(steps):
        pipeline.model.update_to_step(step)
        _, losses, _ = pipeline.get_train_loss_dict(step)
        for optimizer in optimizers.values():
            optimizer.zero_grad()
        sum(losses.values()).backward()  # type: ignore[union-attr]
        for optimizer in optimizers.values():
            optimizer.step()
    pipeline.eval()
    return pipeline
