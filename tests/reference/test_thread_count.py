from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.support.boxed_scene import write_boxed_scene
from tests.support.short_training import train_with_optimizers
from thermoxels_ns.core import threads
from thermoxels_ns.core.threads import num_threads
from thermoxels_ns.synthetic.scene_folder import make_scene


@pytest.fixture
def restored_threads() -> Iterator[None]:
    """Give kernels and torch their threads back after a test."""
    kernels, ours = threads._state["threads"], torch.get_num_threads()
    yield
    threads.set_num_threads(kernels or None)
    torch.set_num_threads(ours)


COUNTS = (1, 3)

pytestmark = pytest.mark.usefixtures("restored_threads")


def flat(value: Any) -> dict[str, torch.Tensor]:
    """All tensors in nested dictionaries and lists, by their path."""
    found = {}

    def walk(node: Any, path: str) -> None:
        if isinstance(node, torch.Tensor):
            found[path] = node.detach().clone()
        elif isinstance(node, dict):
            for key, child in node.items():
                walk(child, f"{path}.{key}")
        elif isinstance(node, list | tuple):
            for place, child in enumerate(node):
                walk(child, f"{path}.{place}")

    walk(value, "")
    return found


def assert_same_bits(results: list[dict[str, torch.Tensor]]) -> None:
    first = results[0]
    assert first
    for other in results[1:]:
        assert other.keys() == first.keys()
        differing = [name for name, value in first.items() if not torch.equal(value, other[name])]
        assert differing == []


def after_training(scene: Path, count: int, steps: int, settings: dict[str, Any], rays: int) -> dict[str, torch.Tensor]:
    """What a checkpoint holds, model and optimisers, after some steps on so many threads."""
    torch.set_num_threads(count)
    pipeline, optimizers = train_with_optimizers(scene, steps, settings, rays=rays, threads=count)
    assert num_threads() == count
    states = {name: optimizer.state_dict()["state"] for name, optimizer in optimizers.optimizers.items()}
    return flat({"model": dict(pipeline.state_dict()), "optimizers": states})


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_boxed_scene(make_scene("sphere"), tmp_path_factory.mktemp("threads"), 6, 1, width=40, height=30)


def test_a_training_that_refines_and_prunes(scene):
    """Steps on both sides of refinement, pruning and thinning."""
    schedule = {"resolutions": [8, 16], "voxel_pixels": 0.0, "refine_at": [6], "prune_at": [9], "thin_at": [11]}
    # So few steps form no surface: rays end in a fog, of which pruning and thinning take the thinnest parts.
    schedule |= {"distortion_ramp": [2, 4], "start_density": 3.0, "prune_threshold": 0.02, "thin_threshold": 0.04}
    results = [after_training(scene, count, 14, schedule | {"prune_dilation": 0}, 700) for count in COUNTS]
    shape, cells = (
        next(v for k, v in results[0].items() if k.endswith(end)) for end in ("grid.corner_shape", "grid.cells")
    )
    assert int(shape[0]) == 17 and len(cells) < int((shape - 1).prod())
    assert any("optimizers.sh.0.exp_avg" in name for name in results[0])
    assert_same_bits(results)


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


def test_a_training_with_large_batches(scene):
    """Every tensor with a row per ray is one that torch splits among its threads."""
    settings = {"resolutions": [8], "voxel_pixels": 0.0, "refine_at": [], "start_density": 3.0, "prune_at": [3]}
    settings |= {"prune_threshold": 0.02, "per_image_offset": "on", "thermal_background": "learned", "background": "on"}
    with NoProductOfLongVectors():
        results = [after_training(scene, count, 5, settings, TOO_MANY_FOR_ONE_THREAD) for count in COUNTS]
    assert any("thermal_offset" in name for name in results[0])
    assert_same_bits(results)
