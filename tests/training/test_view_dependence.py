"""Colour is stored as one per corner until it depends on the direction: a training notices nothing of it."""

from __future__ import annotations

import io
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers

from tests.support.boxed_scene import write_boxed_scene
from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.errors import CheckpointError
from thermoxels_ns.core.yaml_records import with_overrides
from thermoxels_ns.synthetic.scene_folder import make_scene
from thermoxels_ns.training.model_config import ThermoxelsModelConfig
from thermoxels_ns.training.pipeline import ThermoxelsPipeline

RISES = 9
"""Step from which colour depends on the direction."""
STEPS = 14
COURSE = {"resolutions": [8, 16], "refine_at": [4], "prune_at": [6], "thin_at": [RISES], "distortion_ramp": [2, 4]}
COURSE |= {"start_density": 3.0, "prune_threshold": 0.02, "thin_threshold": 0.04, "prune_dilation": 0}
COURSE |= {"view_dependence_from": RISES}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("view-dependence")
    return write_boxed_scene(make_scene("sphere"), folder / "scene", 6, 1, width=40, height=30)


@pytest.fixture
def stored_whole(monkeypatch):
    """All harmonics are stored from the first step on, as versions before did."""
    monkeypatch.setattr(ThermoxelsModelConfig, "first_sh_degree", lambda config: config.sh_degree)


class Training:
    """A training that can be saved and resumed at any step."""

    def __init__(self, scene: Path, options: dict[str, Any] | None = None, saved: bytes | None = None):
        rays = {"data": scene, "train_num_rays_per_batch": 300}
        overrides = {"datamanager": rays, "model": COURSE | (options or {})}
        pipeline = with_overrides(deepcopy(thermoxels.config.pipeline), overrides).setup(device="cpu", test_mode="val")
        assert isinstance(pipeline, ThermoxelsPipeline)
        pipeline.train()
        self.pipeline: Any = pipeline
        self.step, self.loss = 0, torch.zeros(())
        self.optimizers = Optimizers(deepcopy(thermoxels.config.optimizers), pipeline.get_param_groups())
        if saved is not None:
            # In the order of nerfstudio's trainer: callbacks come after the checkpoint.
            state = torch.load(io.BytesIO(saved), weights_only=True)
            pipeline.load_pipeline(state["pipeline"], state["step"])
            self.optimizers.load_optimizers(state["optimizers"])
            self.step = state["step"] + 1
        trainer: Any = SimpleNamespace(_start_step=self.step, config=SimpleNamespace(max_num_iterations=STEPS))
        attributes = TrainingCallbackAttributes(self.optimizers, None, pipeline, trainer)  # type: ignore[arg-type]
        self.callbacks = pipeline.get_training_callbacks(attributes)

    @property
    def columns(self) -> int:
        """Columns of colour."""
        return self.pipeline.model.grid.sh.shape[1]

    def advance(self, until: int) -> Training:
        """Train; the loss of the step before, with its graph, is there while callbacks run, as in nerfstudio."""
        while self.step < until:
            for callback in self.callbacks:
                callback.run_callback(self.step)
            self.optimizers.zero_grad_all()
            self.loss = torch.stack(list(self.pipeline.get_train_loss_dict(self.step)[1].values())).sum()
            self.loss.backward()
            self.optimizers.optimizer_step_all()
            self.step += 1
        return self

    def save(self) -> bytes:
        """A checkpoint of the last step."""
        file = io.BytesIO()
        optimizers = {name: o.state_dict() for name, o in self.optimizers.optimizers.items()}
        torch.save({"step": self.step - 1, "pipeline": self.pipeline.state_dict(), "optimizers": optimizers}, file)
        return file.getvalue()

    def tensors(self) -> dict[str, torch.Tensor]:
        """Everything that a checkpoint holds."""
        found = dict(self.pipeline.state_dict())
        for group, optimizer in self.optimizers.optimizers.items():
            for place, state in optimizer.state_dict()["state"].items():
                found |= {f"{group}.{place}.{name}": value for name, value in state.items()}
        return {name: torch.as_tensor(value).clone() for name, value in found.items()}


def differing(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> list[str]:
    assert one.keys() == other.keys() and "sh.0.exp_avg" in one
    return [name for name, value in one.items() if not torch.equal(value, other[name])]


@pytest.mark.parametrize(
    "options",
    [{}, {"sh_degree": 1}, {"backend": "reference"}, {"recipe": "paper"}],
    ids=lambda options: "-".join(map(str, options.values())) or "default",
)
def test_a_training_ends_with_the_bits_of_one_that_stores_everything(scene, request, options):
    narrow = Training(scene, options)
    seen = [(narrow.advance(step + 1).columns) for step in range(STEPS)]
    all_columns = 3 * (options.get("sh_degree", 2) + 1) ** 2
    assert seen == [3] * RISES + [all_columns] * (STEPS - RISES)
    request.getfixturevalue("stored_whole")
    whole = Training(scene, options)
    assert whole.columns == all_columns
    whole.advance(STEPS)
    assert narrow.pipeline.model.grid.lattice.cell_shape[0] == 16
    higher = narrow.pipeline.model.grid.sh.detach().view(-1, 3, all_columns // 3)[..., 1:]
    assert float(higher.abs().max()) > 0
    assert differing(narrow.tensors(), whole.tensors()) == []


@pytest.mark.parametrize("stop", [1, 5, RISES - 1, RISES, RISES + 1, STEPS - 1])
def test_a_training_resumed_at_any_step_ends_with_the_same_bits(scene, stop):
    straight = Training(scene).advance(STEPS)
    saved = Training(scene).advance(stop).save()
    resumed = Training(scene, saved=saved)
    assert resumed.columns == (3 if stop <= RISES else 27)
    assert differing(resumed.advance(STEPS).tensors(), straight.tensors()) == []


@pytest.mark.parametrize("stop", [5, STEPS])
def test_images_and_snapshots_need_no_further_columns(scene, stop):
    """A model loaded for evaluation shows what the trained one does, before and after colour depends on directions."""
    trained = Training(scene).advance(stop)
    loaded = Training(scene, saved=trained.save()).pipeline
    shown = []
    for pipeline in (trained.pipeline, loaded):
        pipeline.eval()
        assert pipeline.model.grid.sh.shape[1] == (3 if stop == 5 else 27)
        camera = pipeline.datamanager.eval_dataset.cameras[0:1]
        outputs = pipeline.model.get_outputs_for_camera(camera)
        shown.append((outputs["rgb"], outputs["thermal"], torch.from_numpy(pipeline.grid_snapshot().colour)))
    assert all(torch.equal(one, other) for one, other in zip(*shown))
    assert float(shown[0][0].std()) > 0 and shown[0][2].shape[-1] == 3


@pytest.mark.parametrize("options, columns, expected", [({}, 12, "sh 3 or 27"), ({"sh_degree": 0}, 27, "sh 3,")])
def test_a_checkpoint_of_another_degree_is_refused(scene, options, columns, expected):
    training = Training(scene, options)
    state = dict(training.pipeline.state_dict())
    name = "_model.field.grid.sh"
    state[name] = torch.zeros(len(state[name]), columns)
    with pytest.raises(CheckpointError, match=f"columns density 1, {expected}.* got density 1, sh {columns}, temp"):
        training.pipeline.load_pipeline(state, 0)


def test_memory_is_predicted_for_the_columns_that_a_lattice_will_have():
    """Only lattices that give way before colour depends on the direction stay narrow; the last one never does."""
    course: dict[str, Any] = {"resolutions": (8, 16, 32, 64), "refine_at": (10, 20, 30), "view_dependence_from": 20}
    config = ThermoxelsModelConfig(**course)
    assert [config.row_channels(resolution) for resolution in config.resolutions] == [5, 5, 29, 29]
    assert ThermoxelsModelConfig(view_dependence_from=0).row_channels(32) == 29
    assert ThermoxelsModelConfig(sh_degree=None, temperature_degree=2).row_channels(128) == 10
