"""A training on any number of threads, and one that was resumed at any step, ends with the same bits."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.support.short_training import COURSE, RISES, STEPS, Training, write_boxed_scene
from thermoxels_ns.core import threads
from thermoxels_ns.core.errors import CheckpointError
from thermoxels_ns.synthetic.scene_folder import make_scene
from thermoxels_ns.training.model_config import ThermoxelsModelConfig


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("same-bits")
    return write_boxed_scene(make_scene("sphere"), folder / "scene", 6, 1, width=40, height=30)


@pytest.fixture
def restored_threads() -> Iterator[None]:
    """Give kernels and torch their threads back after a test."""
    kernels, ours = threads._threads, torch.get_num_threads()
    yield
    threads.set_num_threads(kernels)
    torch.set_num_threads(ours)


def begin(
    scene: Path, options: dict[str, Any] = COURSE, saved: bytes | None = None, count: int = 1, rays: int = 700
) -> Training:
    """Begin a training, or go on with a saved one, on so many threads."""
    torch.set_num_threads(count)
    data = {"data": scene, "train_num_rays_per_batch": rays, "thermal_num_rays_per_batch": rays}
    settings = {"cpu_threads": count, "datamanager": data, "model": options}
    return Training(settings, STEPS, saved=saved)


def columns(training: Training) -> int:
    return training.pipeline.model.grid.sh.shape[1]


def tensors(training: Training) -> dict[str, torch.Tensor]:
    """What a checkpoint holds of model and optimisers."""
    found = dict(training.pipeline.state_dict())
    for group, optimizer in training.optimizers.optimizers.items():
        for place, state in optimizer.state_dict()["state"].items():
            found |= {f"{group}.{place}.{name}": value for name, value in state.items()}
    return {name: torch.as_tensor(value).clone() for name, value in found.items()}


def differing(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> list[str]:
    assert one.keys() == other.keys() and "sh.0.exp_avg" in one
    return [name for name, value in one.items() if not torch.equal(value, other[name])]


@pytest.fixture(scope="module")
def straight(scene) -> dict[str, torch.Tensor]:
    """What a training without a pause on one thread ends with."""
    training = begin(scene)
    seen = [columns(training.advance(step + 1)) for step in range(STEPS)]
    assert seen == [3] * RISES + [27] * (STEPS - RISES)
    grid = training.pipeline.model.grid
    assert grid.lattice.cell_shape == (16, 16, 16) and len(grid.voxels) < 16**3
    return tensors(training)


@pytest.mark.parametrize("stop", [1, RISES, RISES + 1])
def test_a_training_resumed_at_any_step_ends_with_the_same_bits(scene, straight, stop):
    saved = begin(scene).advance(stop).save()
    resumed = begin(scene, saved=saved)
    assert columns(resumed) == (3 if stop <= RISES else 27)
    assert differing(tensors(resumed.advance(STEPS)), straight) == []


@pytest.mark.usefixtures("restored_threads")
def test_a_training_on_three_threads_ends_with_the_same_bits(scene, straight):
    """Steps on both sides of refinement, pruning, thinning and the rise of colour."""
    on_three = begin(scene, count=3).advance(STEPS)
    assert threads.num_threads() == 3 and differing(tensors(on_three), straight) == []


TOO_MANY_FOR_ONE_THREAD = 40_000
"""Rays of a batch whose tensors torch and BLAS split among their threads on every processor."""


class NoProductOfLongVectors(TorchDispatchMode):
    """Refuses matrix products that sum over rays: BLAS splits them among its threads on some processors only."""

    longest = 64

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        if name in ("mm", "mv", "dot", "vdot", "bmm", "addmm", "addmv", "baddbmm"):
            left = args[1] if name.startswith(("add", "badd")) else args[0]
            assert left.shape[-1] <= self.longest, f"{name} sums {left.shape[-1]} products"
        return func(*args, **(kwargs or {}))


@pytest.mark.usefixtures("restored_threads")
def test_a_training_with_large_batches_ends_with_the_same_bits(scene):
    """Every tensor with a row per ray is one that torch splits among its threads."""
    settings = {"resolutions": [8], "voxel_pixels": 0.0, "refine_at": [], "start_density": 3.0, "prune_at": [3]}
    settings |= {"thin_at": [], "prune_threshold": 0.02, "per_image_offset": "on"}
    settings |= {"thermal_background": "learned", "background": "on"}
    with NoProductOfLongVectors():
        one, three = (
            tensors(begin(scene, settings, count=count, rays=TOO_MANY_FOR_ONE_THREAD).advance(5)) for count in (1, 3)
        )
    assert any("thermal_offset" in name for name in one) and differing(one, three) == []


@pytest.mark.parametrize("stop", [5, STEPS])
def test_images_and_snapshots_need_no_further_columns(scene, stop):
    """A model loaded for evaluation shows what the trained one does, before and after colour depends on directions."""
    trained = begin(scene).advance(stop)
    loaded = begin(scene, saved=trained.save()).pipeline
    shown = []
    for pipeline in (trained.pipeline, loaded):
        pipeline.eval()
        assert pipeline.model.grid.sh.shape[1] == (3 if stop == 5 else 27)
        camera = pipeline.datamanager.eval_dataset.cameras[0:1]
        outputs = pipeline.model.get_outputs_for_camera(camera)
        shown.append((outputs["rgb"], outputs["thermal"], torch.from_numpy(pipeline.grid_snapshot().colour)))
    assert all(torch.equal(one, other) for one, other in zip(*shown))
    assert float(shown[0][0].std()) > 0 and shown[0][2].shape[-1] == 3


@pytest.mark.parametrize(
    "options, columns, expected", [(COURSE, 12, "sh 3 or 27"), (COURSE | {"sh_degree": 0}, 27, "sh 3,")]
)
def test_a_checkpoint_of_another_degree_is_refused(scene, options, columns, expected):
    training = begin(scene, options)
    state = dict(training.pipeline.state_dict())
    name = "_model.grid.sh"
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
