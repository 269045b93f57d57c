"""The nerfstudio pipeline: loads checkpoints with clear errors, averages metrics with gaps, takes the snapshot."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from thermoxels_ns.errors import CheckpointError, explain
from thermoxels_ns.model import ThermoxelsModel
from thermoxels_ns.snapshot import GridSnapshot
from thermoxels_ns.streams import THERMAL_STREAM

_GRID = "_model.field.grid."


@dataclass
class ThermoxelsPipelineConfig(VanillaPipelineConfig):
    """Settings of the pipeline."""

    _target: type = field(default_factory=lambda: ThermoxelsPipeline)


class ThermoxelsPipeline(VanillaPipeline):
    """nerfstudio's pipeline with what it lacks for us."""

    @property
    def model(self) -> ThermoxelsModel:
        """The voxel model."""
        return super().model  # type: ignore[return-value]

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint.

        Raises:
            CheckpointError: It belongs to another method, to other settings or to another scene.
        """
        expected = {_GRID + name: p.shape[1] for name, p in self.model.grid.row_parameters().items()}
        found = {
            name.removeprefix("module."): tensor.shape[1]
            for name, tensor in loaded_state.items()
            if name.removeprefix("module.").startswith(_GRID) and getattr(tensor, "ndim", 0) == 2
        }
        if expected != found:
            raise CheckpointError(
                explain(
                    "checkpoint",
                    expected=f"a voxel grid with the columns {_columns(expected)}",
                    got=_columns(found) if found else "no voxel grid: the checkpoint of another method",
                    remedy="Load it with the config.yml that was written beside it.",
                )
            )
        here = self.model.temperature_bounds_c.clone()
        super().load_pipeline(loaded_state, step)
        stored = self.model.temperature_bounds_c.to(here.device)
        if not torch.allclose(here, stored, atol=1e-3, rtol=0):
            raise CheckpointError(
                explain(
                    "temperature range",
                    expected=f"the checkpoint's, {stored[0]:.2f} to {stored[1]:.2f} C",
                    got=f"{here[0]:.2f} to {here[1]:.2f} C from the scene",
                    remedy="Use the thermal files (and temperature_bounds.json) that the checkpoint was trained on.",
                )
            )

    def get_average_image_metrics(self, *args: Any, **kwargs: Any) -> dict[str, float]:
        """Average metrics over images; an image where a metric has no pixel does not count for it."""
        rows: list[dict[str, float]] = []
        one_image = self.model.get_image_metrics_and_images

        def remember(outputs, batch):
            metrics, images = one_image(outputs, batch)
            rows.append(dict(metrics))
            return metrics, images

        self.model.get_image_metrics_and_images = remember  # type: ignore[method-assign]
        try:
            averages = super().get_average_image_metrics(*args, **kwargs)
        finally:
            del self.model.get_image_metrics_and_images
        for name in rows[0]:
            averages[name] = float(torch.tensor([row[name] for row in rows]).nanmean())
        return averages

    def grid_snapshot(self, rays_per_image: int = 20_000) -> GridSnapshot:
        """The trained field for the mesher, with the weight that thermal training rays gave each corner."""
        return self.model.grid_snapshot(self.datamanager.training_rays(THERMAL_STREAM, rays_per_image))  # type: ignore


def _columns(grid: dict[str, int]) -> str:
    return ", ".join(f"{name.removeprefix(_GRID)} {columns}" for name, columns in sorted(grid.items()))
