"""A few training steps in this process, without nerfstudio's trainer, for laws that need a trained model; and scenes.

The optimisers, their schedules and the callbacks are those of the default method.
"""

import io
import json
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers

from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.yaml_records import with_overrides
from thermoxels_ns.synthetic.scene_folder import write_scene
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.training.pipeline import ThermoxelsPipeline


def write_boxed_scene(scene: SyntheticScene, folder: Path, num_train: int, num_eval: int, **options: Any) -> Path:
    """Write a scene whose json names the exact box, as somebody who knows it may, and whose photographs lose nothing.

    A few tiny photographs do not show where the box ends, and what JPEG does to them drowns what a test looks at.
    """
    options = {"photo_format": "png", "progress": False} | options
    write_scene(scene, folder, num_train, num_eval, **options)
    path = folder / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"scene_box": scene.scene_box}))
    return folder


STEPS, RISES = 14, 9
COURSE = {"resolutions": [8, 16], "voxel_pixels": 0.0, "refine_at": [4], "prune_at": [6], "thin_at": [RISES]}
COURSE |= {"distortion_ramp": [2, 4], "view_dependence_from": RISES}
# So few steps form no surface: rays end in a fog, of which pruning and thinning take the thinnest parts.
COURSE |= {"start_density": 3.0, "prune_threshold": 0.02, "thin_threshold": 0.04, "prune_dilation": 0}
"""The model of a training of `STEPS` in which all happens; from `RISES` on colour depends on the direction."""


class Training:
    """A training that can be stepped, saved and resumed at any step.

    Args:
        overrides: What differs from the pipeline's default configuration, nested as in a preset.
        steps: Its length, for callbacks.
        config: A method to begin with in place of the default one.
        rate: Factor on all learning rates.
        saved: A checkpoint to go on from.
        device: Where the model is.
    """

    def __init__(
        self,
        overrides: dict[str, Any],
        steps: int,
        config: Any = None,
        rate: float = 1.0,
        saved: bytes | None = None,
        device: str = "cpu",
    ):
        config = deepcopy(config or thermoxels.config)  # nerfstudio writes the folder into it
        pipeline = with_overrides(config.pipeline, overrides).setup(device=device, test_mode="val")
        assert isinstance(pipeline, ThermoxelsPipeline)
        pipeline.train()
        self.pipeline, self.step, self.loss = pipeline, 0, torch.zeros(())
        for group in config.optimizers.values():
            group["optimizer"].lr *= rate
            group["scheduler"].lr_final *= rate
        self.optimizers = Optimizers(config.optimizers, pipeline.get_param_groups())
        if saved is not None:
            # In the order of nerfstudio's trainer: callbacks come after the checkpoint.
            state = torch.load(io.BytesIO(saved), weights_only=True)
            pipeline.load_pipeline(state["pipeline"], state["step"])
            self.optimizers.load_optimizers(state["optimizers"])
            self.optimizers.load_schedulers(state["schedulers"])
            self.step = state["step"] + 1
        trainer: Any = SimpleNamespace(_start_step=self.step, config=SimpleNamespace(max_num_iterations=steps))
        attributes = TrainingCallbackAttributes(self.optimizers, None, pipeline, trainer)  # type: ignore[arg-type]
        self.callbacks = pipeline.get_training_callbacks(attributes)

    def advance(self, until: int) -> "Training":
        """Train; the loss of the step before, with its graph, is there while callbacks run, as in nerfstudio."""
        while self.step < until:
            for callback in self.callbacks:
                callback.run_callback(self.step)
            self.take_step()
            for scheduler in self.optimizers.schedulers.values():
                scheduler.step()
            self.step += 1
        return self

    def take_step(self) -> None:
        self.optimizers.zero_grad_all()
        self.terms = self.pipeline.get_train_loss_dict(self.step)[1]
        self.loss = torch.stack(list(self.terms.values())).sum()
        self.loss.backward()
        self.optimizers.optimizer_step_all()

    def save(self) -> bytes:
        """A checkpoint of the last step."""
        file = io.BytesIO()
        parts = {"optimizers": self.optimizers.optimizers, "schedulers": self.optimizers.schedulers}
        states = {part: {name: one.state_dict() for name, one in held.items()} for part, held in parts.items()}
        torch.save({"step": self.step - 1, "pipeline": self.pipeline.state_dict(), **states}, file)
        return file.getvalue()


def train(
    scene: Path, steps: int, model: dict[str, Any] | None = None, rays: int = 512, rate: float = 1.0
) -> ThermoxelsPipeline:
    """Train the default method on a scene on one thread, and return its pipeline.

    Args:
        scene: Scene folder.
        steps: Training steps.
        model: Overrides of the model's configuration: 16 voxels, and changes of the lattice where it says so.
        rays: Rays of each stream per step.
        rate: Factor on all learning rates.
    """
    plain = {"resolutions": [16], "refine_at": [], "prune_at": [], "thin_at": []}
    data = {"data": scene, "train_num_rays_per_batch": rays, "thermal_num_rays_per_batch": rays}
    overrides = {"cpu_threads": 1, "datamanager": data, "model": plain | (model or {})}
    return Training(overrides, steps, rate=rate).advance(steps).pipeline.eval()


def rays_along_minus_x(places: torch.Tensor | None = None) -> Iterator[RayBundle]:
    """Parallel rays from x = 3 at all pairs of places across, of which there are 40 from -0.97 to 0.97 unless told."""
    y, z = torch.meshgrid(*[torch.linspace(-0.97, 0.97, 40) if places is None else places] * 2, indexing="ij")
    for part in torch.stack((torch.full_like(y, 3.0), y, z), -1).reshape(-1, 3).split(300):
        yield RayBundle(part, torch.tensor([-1.0, 0.0, 0.0]).expand_as(part), torch.ones(len(part), 1))
