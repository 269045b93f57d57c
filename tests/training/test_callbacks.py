from collections.abc import Iterator
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes

from tests.support.short_training import rays_along_minus_x
from tests.support.small_fields import kept_mask
from thermoxels_ns.core.errors import MemoryBudgetError, PruningError
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.core.units import TemperatureRange
from thermoxels_ns.multiview.votes import air_voxels
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.synthetic.scene_truth import look_at
from thermoxels_ns.training import callbacks
from thermoxels_ns.training.callbacks import coarse_to_fine_callbacks, progress, prune_by_rays
from thermoxels_ns.training.model import ThermoxelsModel
from thermoxels_ns.training.model_config import ThermoxelsModelConfig
from thermoxels_ns.training.optimizers import RowAdam


def model_of(**options) -> ThermoxelsModel:
    """A slab, solid for x < -0.5 (2 of 8 voxels), with nothing in front of it."""
    plain = {"resolutions": (8,), "refine_at": (), "prune_at": (), "thin_at": (), "density_activation": "relu"}
    config = ThermoxelsModelConfig(**{**plain, **options})
    box = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    metadata = {"temperature_range": TemperatureRange(10.0, 30.0)}
    model = config.setup(scene_box=box, num_train_data=4, metadata=metadata)
    corners = torch.as_tensor(model.grid.lattice.corner_positions(), dtype=torch.float32).reshape(-1, 3)
    model.grid.density.data = torch.where(corners[:, :1] < -0.49, 500.0, 0.0)
    return model.train()


class Rays:
    """Stands for the data manager: rays along -x onto the slab, and two cameras that have the box in view."""

    config = SimpleNamespace(train_num_rays_per_batch=10**6)

    def __init__(self, places: torch.Tensor | None = None):
        self.places = torch.linspace(-0.97, 0.97, 30) if places is None else places
        poses = np.stack([look_at((3.0, 0.0, 0.0), (0.0, 0.0, 0.0))[:3]] * 2)
        self.views = Views(poses, np.full((2, 2), 50.0), np.full((2, 2), 50.0), np.full((2, 2), 100.0))
        self.train_dataset = SimpleNamespace(views=lambda: self.views)

    def training_rays(self, stream: int, most: int) -> Iterator[RayBundle]:
        yield from rays_along_minus_x(self.places)


@pytest.mark.parametrize("dilation, layers", [(0, [1, 2]), (1, [1, 2, 3]), (2, [0, 1, 2, 3, 4])])
def test_pruning_keeps_what_rays_see_and_its_neighbours(dilation, layers):
    model = model_of()
    old = model.grid.voxels
    said, change = prune_by_rays(model, Rays(), 0.01, dilation)
    kept = kept_mask(model.grid.voxels)
    assert [x for x in range(8) if bool(kept[x].any())] == layers and bool(kept[layers].all())
    assert len(model.grid.voxels) == 64 * len(layers)
    assert change(torch.arange(old.num_rows)[:, None].float()).shape == (model.grid.voxels.num_rows, 1)
    assert said.startswith(f"kept {64 * len(layers)} of 512 voxels") and "threshold 0.01, 0.00% of the rays" in said


def test_no_hole_opens_where_no_ray_was_drawn():
    """One ray in four of a fine surface: the voxels between are opaque, and stay."""
    model = model_of(resolutions=(16,))
    prune_by_rays(model, Rays(torch.arange(-0.9375, 1.0, 0.25)), 0.01, 0)
    first = int(kept_mask(model.grid.voxels).any(-1).any(-1).nonzero().max())
    assert bool(kept_mask(model.grid.voxels)[first - 1].all()), "the first layer that is solid throughout"


def fog(model: ThermoxelsModel, density: float) -> None:
    """Put fog in place of the slab where y > 0: it stops rays, and no voxel has much of it."""
    y = torch.as_tensor(model.grid.lattice.corner_positions(), dtype=torch.float32)[..., 1].reshape(-1, 1)
    model.grid.density.data = torch.where(y > 0.01, density, model.grid.density.data)


def test_a_threshold_that_would_open_rays_is_lowered():
    """A ray spends a fifth of its light in its first sample of fog: 0.3 keeps the slab and opens half of the rays."""
    model = model_of()
    fog(model, 1.5)
    assert "threshold 0.075" in prune_by_rays(model, Rays(), 0.3, 0)[0]
    kept = kept_mask(model.grid.voxels)
    assert bool(kept[7, 5:].all()) and not bool(kept[7, :3].any()) and bool(kept[2, :4].all())


def test_pruning_that_would_remove_a_part_of_the_scene_fails_and_changes_nothing():
    """No sample of this fog has more than 1.5 % of a ray, but it stops 60 % of it."""
    model = model_of(resolutions=(32,))
    fog(model, 0.48)
    before = model.grid.density
    with pytest.raises(
        PruningError, match=r"open at most 1% of the rays.* got 4\d\.\d% .*--pipeline.model.prune-threshold"
    ):
        prune_by_rays(model, Rays(), 0.99, 0)
    assert len(model.grid.voxels) == 32**3 and model.grid.density is before


def attributes(model: ThermoxelsModel, steps: int) -> TrainingCallbackAttributes:
    groups = model.get_param_groups()
    rows = model.grid.row_parameters()
    optimizers: Any = SimpleNamespace(
        optimizers={
            name: RowAdam(groups[name], lr=0.1) for name in groups if name.removeprefix("surroundings_") in rows
        },
        parameters=dict(groups),
    )
    pipeline: Any = SimpleNamespace(datamanager=Rays(), model=model)
    saved: list[tuple[int, ...]] = []
    trainer: Any = SimpleNamespace(
        _start_step=0,
        config=SimpleNamespace(max_num_iterations=steps),
        saved=saved,
        save_found_settings=lambda: saved.append(model.config.resolutions),
    )
    return TrainingCallbackAttributes(optimizers, None, pipeline, trainer)


def steps_of(model: ThermoxelsModel, given: TrainingCallbackAttributes, count: int) -> Iterator[int]:
    """Run the callbacks of each step, and one of the optimisers after it: they hold what the model does."""
    callbacks = coarse_to_fine_callbacks(model, given)
    grids = {"": model.grid} | ({"surroundings_": model.surroundings.grid} if model.surroundings else {})
    for step in range(count):
        for callback in callbacks:
            callback.run_callback(step)
        yield step
        for prefix, grid in grids.items():
            for name, parameter in grid.row_parameters().items():
                optimizer = given.optimizers.optimizers[prefix + name]
                assert optimizer.param_groups[0]["params"] == [parameter] == given.optimizers.parameters[prefix + name]
                parameter.grad = torch.zeros_like(parameter)
                parameter.grad[: 5 + step] = 1e-9
                optimizer.step()
                assert set(optimizer.state) == {parameter}
                assert all(len(values) == len(parameter) for values in optimizer.state[parameter].values())


def test_optimisers_follow_the_schedule():
    """At each change of the lattice every optimiser holds the new parameters, with state of as many rows."""
    model = model_of(resolutions=(8, 16), refine_at=(3,), prune_at=(5,), thin_at=(7,), prune_dilation=1)
    sizes = [len(model.grid.voxels) for _ in steps_of(model, attributes(model, 10), 10)]
    # The slab fills 4 of 16 layers; its front with a neighbour on either side, then what a surface alone needs.
    assert sizes[:3] == [512] * 3 and sizes[3:5] == [192 * 8] * 2 and sizes[5] == sizes[6] < sizes[4]
    assert sizes[7] == sizes[9] < sizes[6] and model.step == 9


@pytest.mark.parametrize("there", [True, False])
def test_surroundings_are_split_where_rays_see_some_and_dropped_where_infinity_explains_all(there):
    model = model_of(resolutions=(8, 16), refine_at=(3,), prune_at=(5,))
    grid, sizes = model.surroundings.grid, []
    for step in steps_of(model, attributes(model, 10), 6):
        if there and step == 0:
            grid.density.data.fill_(1.0)
        sizes.append(len(grid.voxels))
    assert 0 < sizes[0] < 0.5 * 6 * 48 * 48 * 12, "only what rays cross is kept"
    assert (model.seen_surroundings is not None) == there
    assert sizes[3] > sizes[2] if there else sizes[1:4] == [1, 1, 1], "a third of the way to the first change"
    seen = model.render_rays(RayRequest(torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]])), RenderOptions())
    assert (seen.around is not None) == there


@pytest.mark.parametrize("carve", ["auto", "off"])
def test_air_is_carved_at_the_start_and_after_a_refinement(carve):
    """Lines from the middle of one side to points on the other, of which each lattice carves what it can resolve."""
    side = np.linspace(-0.6, 0.6, 13)
    points = np.stack(np.meshgrid([0.93], side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    count = len(points)
    lines = FeatureRays(np.tile([-0.99, 0.01, 0.01], (count, 1)), np.arange(count), points, np.zeros(count))
    model = model_of(resolutions=(8, 16), refine_at=(3,), prune_threshold=0.0, carve=carve)
    model.feature_rays = lines
    for _ in steps_of(model, attributes(model, 10), 4):
        kept, empty = kept_mask(model.grid.voxels).numpy(), air_voxels(model.grid.lattice, lines)
        assert kept.all() if carve == "off" else empty.any() and not (kept & empty).any()


@pytest.mark.parametrize("narrow", [0, 1, 2])
def test_voxels_that_fewer_than_two_photographs_show_go(narrow):
    """Feature rays far outside of the box say nothing of it."""
    model = model_of(prune_threshold=0.0)
    points = np.array([[9.0, 9.0, 9.0]])
    model.feature_rays = FeatureRays(np.array([[8.0, 9.0, 9.0]]), np.arange(1), points, np.ones(1))
    given: Any = attributes(model, 10)
    given.pipeline.datamanager.views.focal[:narrow] = 200.0  # these see 14 degrees around the x axis alone
    next(steps_of(model, given, 1))
    centres = model.grid.lattice.cell_centres()
    beside = np.abs(centres[..., 1:]).max(axis=-1) > 0.25 * (3.0 - centres[..., 0])
    assert beside.any() and not beside.all()
    assert torch.equal(kept_mask(model.grid.voxels), torch.from_numpy(~beside if narrow else np.ones_like(beside)))


def test_where_no_two_photographs_show_anything_of_the_box_air_goes_all_the_same():
    model = model_of(prune_threshold=0.0)
    side = np.linspace(-0.9, 0.9, 5)
    points = np.stack(np.meshgrid([0.9], side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    model.feature_rays = FeatureRays(np.tile([-0.9, 0.0, 0.0], (25, 1)), np.arange(25), points, np.zeros(25))
    given: Any = attributes(model, 10)
    given.pipeline.datamanager.views.camera_to_world[:, :, [0, 2]] *= -1.0
    next(steps_of(model, given, 1))
    air = torch.from_numpy(air_voxels(model.grid.lattice, model.feature_rays))
    assert bool(air.any()) and torch.equal(kept_mask(model.grid.voxels), ~air)


@pytest.mark.parametrize("voxel_pixels", [0.0, 1.6])
def test_a_refinement_beyond_the_budget_leaves_the_lattice_as_it_is(voxel_pixels):
    """An error where somebody asked for the resolution; where photographs did, training goes on without it."""
    budget = {"memory_budget_gb": 0.001, "prune_threshold": 0.0, "voxel_pixels": voxel_pixels}
    model = model_of(resolutions=(8, 32), refine_at=(2,), **budget)
    given: Any = attributes(model, 4)
    with nullcontext() if voxel_pixels else pytest.raises(MemoryBudgetError, match="32 x 32 x 32"):
        assert [*steps_of(model, given, 3)][-1] == 2
    assert model.config.resolutions == ((8,) if voxel_pixels else (8, 32))
    assert given.trainer.saved == ([(8,)] if voxel_pixels else []), "what is resumed knows it"
    assert model.grid.lattice.cell_shape == (8, 8, 8) and len(model.grid.voxels) == 8**3


@pytest.mark.parametrize(("rays", "voxel_pixels", "side"), [(6144, 1.6, 16), (6143, 1.6, 8), (6143, 0.0, 16)])
def test_a_refinement_for_which_rays_are_few_is_left_out_unless_somebody_asked_for_it(rays, voxel_pixels, side):
    """Of the last two steps each gives as many rays as 8^3 voxels of a surface need for a refinement by two."""
    model = model_of(resolutions=(8, 16), refine_at=(2,), prune_threshold=0.0, voxel_pixels=voxel_pixels)
    given: Any = attributes(model, 4)
    given.pipeline.datamanager.config = SimpleNamespace(train_num_rays_per_batch=rays)
    assert [*steps_of(model, given, 3)][-1] == 2
    assert model.grid.lattice.cell_shape == (side, side, side)
    assert given.trainer.saved == ([(8,)] if side == 8 else [])


def test_progress_is_told_at_each_twentieth_and_after_a_silence(monkeypatch, capsys):
    """Steps of two seconds, but the first, in which kernels compile, and one of a minute and a half."""
    clock = iter([0.0, *(30.0 + 2.0 * step + 90.0 * (step > 104) for step in range(100, 200))])
    monkeypatch.setattr(callbacks.time, "monotonic", lambda: next(clock))
    tell = progress(100, 200)
    for step in range(100, 200):
        tell(step)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "step 106 of 200 (53 %); at this pace 0:31:20 more", "after a silence"
    assert lines[1] == "step 110 of 200 (55 %); at this pace 0:03:00 more"
    assert lines[-1] == "step 200 of 200 (100 %)" and len(lines) == 11
