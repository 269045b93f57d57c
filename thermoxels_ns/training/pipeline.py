"""The nerfstudio pipeline: loading of checkpoints, averages of metrics, the snapshot for meshes."""

from __future__ import annotations

import math
import os
import pickle
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.core.config_loader import ModuleWith
from thermoxels_ns.core.errors import CheckpointError, SceneError
from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.core.threads import set_num_threads
from thermoxels_ns.render.renderers import choose_backend
from thermoxels_ns.training.model import ThermoxelsModel

_GRID = "_model.grid."


@dataclass
class ThermoxelsPipelineConfig(VanillaPipelineConfig):
    """Settings of the pipeline."""

    _target: type = field(default_factory=lambda: ThermoxelsPipeline)
    cpu_threads: int | None = None
    """Threads of the compiled kernels. Default: one per processor. (PyTorch itself gets half of the processors, or
    OMP_NUM_THREADS: its threads wait for each other, so one that shares a processor would slow every step.)"""


class ThermoxelsPipeline(VanillaPipeline):
    """Pipeline of the voxel model: data manager, model, checkpoints and evaluation."""

    @property
    def model(self) -> ThermoxelsModel:
        """The voxel model."""
        return super().model  # type: ignore[return-value]

    compare_with_truth: ClassVar[Callable[[Any], dict[str, float]] | None] = None
    """Function from a pipeline to metrics of its surface, set by `config.py`; None: there are no such metrics."""
    world_from_input: torch.Tensor  # Transform, scene box and mean camera, (3, 10); a checkpoint must have the same

    def __init__(self, config: ThermoxelsPipelineConfig, *args: Any, **kwargs: Any) -> None:
        if config.cpu_threads is not None and config.cpu_threads < 1:
            raise SceneError("cpu_threads", expected="1 or more", got=config.cpu_threads, remedy="Leave it out.")
        set_num_threads(config.cpu_threads)
        for module in map(sys.modules.get, ("nerfstudio.engine.trainer", "nerfstudio.utils.eval_utils")):
            if module is not None:  # these modules call torch.load(path, map_location="cpu")
                vars(module)["torch"] = ModuleWith(torch, load=load_checkpoint)
        if "OMP_NUM_THREADS" not in os.environ:
            torch.set_num_threads(max(1, (os.cpu_count() or 2) // 2))
        super().__init__(config, *args, **kwargs)
        choose_backend(self.model.config.backend, self.model.grid.density.device)  # refused before the first step
        streams = getattr(config.datamanager, "streams", "both")
        if streams == "thermal" and (self.model.grid.sh is not None or not self.model.config.thermal_density_gradient):
            expected = "thermal images alone only for a model without colour whose density they move"
            got = f"thermal, with SH degree {self.model.config.sh_degree}"
            remedy = "Use the method plenoxels-t."
            raise SceneError("streams", expected=expected, got=got, remedy=remedy)
        datamanager: Any = self.datamanager
        outputs = datamanager.train_dataparser_outputs
        placed = torch.cat(
            (
                outputs.dataparser_transform.double() * outputs.dataparser_scale,
                outputs.scene_box.aabb.T,
                outputs.cameras.camera_to_worlds.double().mean(0),
            ),
            1,
        )
        self.register_buffer("world_from_input", placed)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return the callbacks of nerfstudio, followed by the result of `coarse_to_fine_callbacks`."""
        # The module `callbacks` loads compiled kernels, which importing the configuration must not.
        from thermoxels_ns.training.callbacks import coarse_to_fine_callbacks

        stock = super().get_training_callbacks(training_callback_attributes)
        return stock + coarse_to_fine_callbacks(self.model, training_callback_attributes)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint's state into the model; raise `CheckpointError` if its method, settings or scene differ."""
        state = {name.removeprefix("module."): value for name, value in loaded_state.items()}
        columns = self.model.config.checkpoint_columns()
        found = {
            name.removeprefix(_GRID): (tensor.shape[1],)
            for name, tensor in state.items()
            if name.startswith(_GRID) and getattr(tensor, "ndim", 0) == 2
        }
        if columns.keys() != found.keys() or not all(set(found[name]) <= set(columns[name]) for name in columns):
            here, there = (
                ", ".join(f"{name} {' or '.join(map(str, numbers))}" for name, numbers in sorted(grid.items()))
                for grid in (columns, found)
            )
            expected = f"a voxel grid with the columns {here}"
            got = there or "no voxel grid: the checkpoint of another method"
            remedy = "Load it with the config.yml that was written beside it."
            raise CheckpointError("checkpoint", expected=expected, got=got, remedy=remedy)
        own = self.state_dict()
        differing = sorted(set(own) ^ set(state))
        if differing:
            remedy = "Use the same background, sky and per-image-offset options as in training."
            got = f"a difference in {', '.join(differing)}"
            raise CheckpointError("checkpoint", expected="the parts that the options build", got=got, remedy=remedy)
        resolution = int(state[_GRID + "corner_shape"].max()) - 1
        if resolution not in self.model.config.resolutions:
            expected = f"one of the resolutions {self.model.config.resolutions}"
            remedy = "Pass --pipeline.model.resolutions as in training; finer ones may follow."
            raise CheckpointError("checkpoint", expected=expected, got=f"{resolution} voxels", remedy=remedy)
        for name, what, tolerance in (
            (f"{_GRID}activation_index", "density_activation", 0.0),
            ("world_from_input", "poses and scene box", 1e-4),
            ("_model.temperature_bounds_c", "temperature range", 1e-3),
            ("_model.thermal_offset", "number of training images", math.inf),
        ):
            if name not in own:
                continue
            here, stored = own[name].cpu().double(), state[name].cpu().double()
            if here.shape != stored.shape or not torch.allclose(here, stored, atol=tolerance, rtol=1e-4):
                remedy = "Use the scene folder and the options of the training run."
                expected = "what the checkpoint was trained with"
                raise CheckpointError(what, expected=expected, got="something else", remedy=remedy)
        super().load_pipeline(state, step)

    def get_average_eval_image_metrics(self, *args: Any, **kwargs: Any) -> dict[str, float]:
        """Return metrics averaged over held-out images and, in ns-eval, the metrics of `compare_with_truth`."""
        averages = super().get_average_eval_image_metrics(*args, **kwargs)
        compare = type(self).compare_with_truth
        if self.test_mode == "test" and compare is not None:  # ns-eval; training has "val"
            averages |= compare(self)
        return averages

    def get_average_image_metrics(self, *args: Any, **kwargs: Any) -> dict[str, float]:
        """Return metrics averaged over images; an image for which a metric is NaN does not count in its average.

        They are the metrics of the model and ``half_transparent``, the share of rays of opacity between 0.1 and 0.9. A
        metric that is NaN for all images is left out.
        """
        rows: list[dict[str, float]] = []
        one_image = self.model.get_image_metrics_and_images

        def remember(outputs, batch):
            metrics, images = one_image(outputs, batch)
            opacity = outputs["accumulation"]
            metrics["half_transparent"] = float(((opacity > 0.1) & (opacity < 0.9)).double().mean())
            rows.append(dict(metrics))
            return metrics, images

        self.model.get_image_metrics_and_images = remember  # type: ignore[method-assign]
        try:
            averages = super().get_average_image_metrics(*args, **kwargs)
        finally:
            del self.model.get_image_metrics_and_images
        for name in rows[0]:
            average = float(torch.tensor([row[name] for row in rows]).nanmean())
            if math.isnan(average):  # json has no NaN
                CONSOLE.print(f"{name} is left out: no image has a pixel that counts for it.")
                averages = {key: value for key, value in averages.items() if key not in (name, f"{name}_std")}
            else:
                averages[name] = average
        return averages

    def corrections(self) -> dict[str, Any]:
        """Return the corrections of training photographs: by kind, if there is one, a dictionary by file name.

        ``poses``: camera to world in input coordinates; ``gains``: of red, green and blue, with geometric mean 1;
        ``thermal_offsets_c``: the excess of the thermal image's readings, [K], with mean 0.
        """
        datamanager: Any = self.datamanager
        metadata, model, found = datamanager.train_dataparser_outputs.metadata, self.model, {}
        names = [path.name for path in datamanager.train_dataparser_outputs.image_filenames]
        if metadata.get("adjusted_poses") is not None:
            found["poses"] = {name: pose.tolist() for name, pose in metadata["adjusted_poses"].items()}
        gains_on, offsets_on = model.corrected.tolist()
        if gains_on and model.log_gain is not None:
            gains = torch.exp(model.log_gain - model.log_gain.mean(0)).tolist()
            found["gains"] = dict(zip(names, gains))
        if offsets_on and model.thermal_offset is not None:
            offsets = (model.thermal_offset - model.thermal_offset.mean()) * model.temperature_range.span_k
            found["thermal_offsets_c"] = dict(zip(names, offsets.tolist()))
        return found

    def grid_snapshot(self, rays_per_image: int = 20_000) -> GridSnapshot:
        """Return the trained field for the mesher, with the training cameras and the evidence of their rays."""
        datamanager: Any = self.datamanager
        rays = datamanager.training_rays(RGB_STREAM | THERMAL_STREAM, rays_per_image)
        found = self.model.grid_snapshot(rays, datamanager.training_views())
        return replace(found, temperature_c=None) if datamanager.config.streams == "rgb" else found


def load_checkpoint(path: Any, **options: Any) -> dict[str, Any]:
    """Return the content of a checkpoint, read by `torch.load` with ``weights_only=True``, so that no code can run.
    Raises `CheckpointError` if the file cannot be read or contains anything but tensors and plain values."""
    try:
        return torch.load(path, **{**options, "weights_only": True})
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError) as problem:
        named = re.search(r"GLOBAL ([\w.]+)", str(problem))
        got = f"one that names {named[1]}, which could run code" if named else f"damage ({type(problem).__name__})"
        remedy = "Use a checkpoint that ns-train of this installation wrote, such as an earlier one beside it."
        if isinstance(problem, OSError) and problem.errno is not None:
            got, remedy = problem.strerror, "Check its permissions and the disk."
        expected = "a checkpoint that can be read, of tensors and numbers"
        raise CheckpointError(str(path), expected=expected, got=got, remedy=remedy) from problem
