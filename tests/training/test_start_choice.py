"""Which start a training takes: trials that leave no trace, and a choice that is remembered."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes

from tests.support.short_training import train_with_optimizers
from thermoxels_ns.core.feature_rays import Sightlines
from thermoxels_ns.core.ray_streams import RGB_STREAM
from thermoxels_ns.core.threads import set_num_threads
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene
from thermoxels_ns.training import start_choice
from thermoxels_ns.training.model_config import ThermoxelsModelConfig
from thermoxels_ns.training.photo_start import SMALLEST_EPS, find_start
from thermoxels_ns.training.pipeline import ThermoxelsPipeline
from thermoxels_ns.training.start_choice import (
    HELD_BACK,
    RAYS_SHARE,
    STARTS,
    _held_back_batches,
    _Trial,
    colour_rays,
    decide_start,
    held_back,
    lines_of_others,
)
from thermoxels_ns.training.track_loss import TrackRays

TWO_LATTICES = {"resolutions": [8, 16], "refine_at": [3], "prune_threshold": 0.0, "hold_density": 2}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("choice") / "scene"
    return write_scene(make_scene("sphere"), folder, 17, 1, width=40, height=30, progress=False)


def trained(scene, steps: int = 6, **options: Any) -> ThermoxelsPipeline:
    return train_with_optimizers(scene, steps, {**TWO_LATTICES, **options}, rays=64)[0]


def attributes(pipeline: ThermoxelsPipeline, optimizers: Any, steps: int, first: int = 0) -> TrainingCallbackAttributes:
    trainer: Any = SimpleNamespace(_start_step=first, config=SimpleNamespace(max_num_iterations=steps))
    return TrainingCallbackAttributes(optimizers, None, pipeline, trainer)  # type: ignore[arg-type]


def errors_of_trials(monkeypatch, plain: float, photographs: float) -> list[int]:
    """Let trials give these errors without training, and return the lengths that were asked for."""
    asked: list[int] = []

    def error_after(trial: _Trial, steps: int, judges: list) -> float:
        assert judges and trial.model.training
        asked.append(steps)
        return plain if trial.found is None else photographs

    monkeypatch.setattr(_Trial, "error_after", error_after)
    return asked


def test_a_chosen_training_is_to_the_bit_the_one_asked_for_by_name(scene, capsys):
    chosen = trained(scene, trial_steps=2)
    log = " ".join(capsys.readouterr().out.split())
    name = STARTS[int(chosen.model.start_index)]
    assert name in ("plain", "photographs") and f"start: {name}, as photographs held back from 2 steps" in log
    assert len(re.findall(r"\d\d\.\d\d dB", log)) == 2
    named = trained(scene, start=name).model.state_dict()
    assert named.keys() == chosen.model.state_dict().keys()
    assert all(torch.equal(value, named[key]) for key, value in chosen.model.state_dict().items())
    other = trained(scene, start="plain" if name == "photographs" else "photographs").model
    assert not torch.equal(other.grid.density, chosen.model.grid.density)


@pytest.mark.parametrize(
    ("plain", "photographs", "expected", "asked"),
    [
        (0.012, 0.01, "photographs", [1, 1, 2, 2]),
        (0.01, 0.012, "plain", [1, 1, 2, 2]),
        (0.01, 0.01, "plain", [1, 1, 2, 2]),
        (0.02, 0.01, "photographs", [1, 1]),  # a lead of 3 dB
        (0.01, 0.02, "plain", [1, 1]),
        (0.01, math.nan, "plain", [1, 1, 2, 2]),
        (math.nan, 0.01, "photographs", [1, 1, 2, 2]),
        (math.nan, math.nan, "plain", [1, 1, 2, 2]),
        (0.0, 0.0, "plain", [1, 1, 2, 2]),
    ],
)
def test_the_smaller_error_wins_at_half_of_the_trials_if_clearly(
    scene, monkeypatch, capsys, plain, photographs, expected, asked
):
    found = errors_of_trials(monkeypatch, plain, photographs)
    pipeline = trained(scene, steps=6, trial_steps=2)
    assert STARTS[int(pipeline.model.start_index)] == expected and found == asked
    assert f"from {asked[-1]} steps of each" in " ".join(capsys.readouterr().out.split())


def test_trials_never_train_on_what_judges_them(scene):
    pipeline, _ = train_with_optimizers(scene, 1, {**TWO_LATTICES, "start": "plain"}, rays=256)
    batch = pipeline.datamanager.next_train(5)
    assert batch[0].camera_indices is not None
    drawn = batch[0].camera_indices[:, 0]
    parts = {judging: colour_rays(batch, judging) for judging in (False, True)}
    for judging, (some, targets) in parts.items():
        assert some.camera_indices is not None
        assert bool((torch.isin(some.camera_indices[:, 0], torch.tensor(held_back(17))) == judging).all())
        assert len(some) == len(targets["image"]) > 0
        assert bool((some.metadata["stream"] == RGB_STREAM).all())
    held = int((drawn % HELD_BACK == HELD_BACK // 2).sum())
    sizes = {key: len(targets["image"]) for key, (_, targets) in parts.items()}
    assert sizes == {True: held, False: math.ceil((256 - held) / RAYS_SHARE)}


def test_photographs_held_back_say_nothing_about_a_trials_density(scene, monkeypatch):
    """The trial's density is made without them; the training that follows asks all."""
    asked: list[Sequence[int]] = []

    def remember(model, datamanager, left_out=()):
        asked.append(list(left_out))
        return find_start(model, datamanager, left_out)

    monkeypatch.setattr(start_choice, "find_start", remember)
    errors_of_trials(monkeypatch, 2.0, 1.0)
    trained(scene, trial_steps=2)
    assert asked == [[4, 12], []]


CENTRES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])


def lines(*cameras_of_points: list[int], off: float = 0.0) -> Sightlines:
    point = np.concatenate([np.full(len(cameras), n) for n, cameras in enumerate(cameras_of_points)])
    origins = CENTRES[np.concatenate(cameras_of_points)] + off
    points = np.arange(3.0 * len(cameras_of_points)).reshape(-1, 3)
    return Sightlines(origins, point, points, np.arange(len(point)) / 10.0)


def test_lines_of_sight_of_photographs_that_are_left_out():
    found = lines_of_others(lines([0, 1, 3], [1], [0, 2], off=1e-7), CENTRES, range(1, 4, 8), 1e-5)
    assert found is not None
    assert found.origins == pytest.approx(CENTRES[[0, 3, 0, 2]], abs=1e-6)
    assert found.point.tolist() == [0, 0, 1, 1] and found.uncertainty == pytest.approx([0.0, 0.2, 0.4, 0.5])
    assert found.points.tolist() == [[0, 1, 2], [6, 7, 8]]  # the second point was seen by camera 1 alone
    assert lines_of_others(lines([1], [1]), CENTRES, range(1, 4, 8), 1e-5) is None


def test_a_camera_where_one_that_is_left_out_stands_gives_no_lines():
    centres = CENTRES.copy()
    centres[2] = centres[1] + 1e-7
    found = lines_of_others(lines([0, 1], [1, 3]), centres, range(2, 4, 8), 1e-5)
    assert found is not None and found.origins[:, 0].tolist() == [0.0, 3.0]


def test_trials_know_no_lines_of_sight_of_photographs_held_back(scene):
    pipeline, optimizers = train_with_optimizers(scene, 1, {**TWO_LATTICES, "start": "plain"}, rays=64)
    model, cameras = pipeline.model, pipeline.datamanager.train_dataset.cameras
    origins = cameras.camera_to_worlds[:, :3, 3].double().numpy()
    model.sightlines = Sightlines(origins, np.zeros(17, dtype=np.int64), np.zeros((1, 3)), np.zeros(17))
    model.track_rays = TrackRays(model.sightlines)
    trial = _Trial(model, pipeline.datamanager, optimizers.config, None)
    others = np.delete(origins, held_back(17), axis=0)
    assert trial.model.sightlines is not None and trial.model.sightlines.origins.tolist() == others.tolist()
    assert trial.model.track_rays is not None and len(trial.model.track_rays._length) == 15
    assert len(model.sightlines.origins) == 17 and len(model.track_rays._length) == 17


def test_steps_in_two_goes_and_other_threads_do_not_change_a_bit(scene):
    pipeline, optimizers = train_with_optimizers(scene, 1, {**TWO_LATTICES, "start": "plain"}, rays=256)
    judges, errors = _held_back_batches(pipeline.datamanager), []
    for threads, goes in ((1, (4,)), (1, (1, 4)), (3, (4,))):
        set_num_threads(threads)
        trial = _Trial(pipeline.model, pipeline.datamanager, optimizers.config, None)
        errors.append([trial.error_after(steps, judges) for steps in goes][-1])
    set_num_threads(1)
    assert errors[0] == errors[1] == errors[2]


def test_a_trial_leaves_model_and_optimisers_as_they_are(scene):
    pipeline, optimizers = train_with_optimizers(scene, 1, {**TWO_LATTICES, "start": "plain"}, rays=64)
    before = deepcopy(pipeline.model.state_dict()), deepcopy(optimizers.config), torch.random.get_rng_state()
    trial = _Trial(pipeline.model, pipeline.datamanager, optimizers.config, None)
    error = trial.error_after(3, _held_back_batches(pipeline.datamanager))
    assert 0.0 < error < 1.0 and trial.model.grid.lattice.cell_shape[0] == 16
    assert all(torch.equal(value, before[0][key]) for key, value in pipeline.model.state_dict().items())
    assert str(optimizers.config) == str(before[1]) and torch.equal(torch.random.get_rng_state(), before[2])
    assert not torch.equal(trial.model.grid.density, torch.full_like(trial.model.grid.density, math.log(0.1)))


def test_longer_trials_are_nearer_to_photographs_that_they_never_saw(scene):
    pipeline, optimizers = train_with_optimizers(scene, 1, {**TWO_LATTICES, "start": "plain"}, rays=512)
    judges = _held_back_batches(pipeline.datamanager)
    trial = _Trial(pipeline.model, pipeline.datamanager, optimizers.config, None)
    short, long = (trial.error_after(steps, judges) for steps in (2, 40))
    assert long < 0.75 * short


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"trial_steps": 3}, "as the run is shorter than 3 trials of 3 steps"),
        ({"trial_steps": 2, "recipe": "paper"}, "as published for the recipe paper"),
        ({"trial_steps": 2, "sh_degree": None, "thermal_density_gradient": True}, "as no photographs train"),
        ({"trial_steps": 2, "loss_overrides": {"rgb": 0.0}}, "as no photographs train"),
        ({"trial_steps": 2, "resolutions": [65], "refine_at": []}, "as trials need a lattice of at most 64 voxels"),
    ],
)
def test_where_trials_tell_nothing_the_start_is_plain(scene, capsys, monkeypatch, options, reason):
    asked = errors_of_trials(monkeypatch, 2.0, 1.0)
    pipeline = trained(scene, **options)
    assert f"start: plain, {reason}" in " ".join(capsys.readouterr().out.split())
    assert STARTS[int(pipeline.model.start_index)] == "plain" and asked == []


def test_too_few_photographs_to_hold_some_back(scene, capsys, monkeypatch):
    monkeypatch.setattr(start_choice, "FEWEST_PHOTOGRAPHS", 18)
    pipeline = trained(scene, trial_steps=2)
    assert "start: plain, as 17 photographs are too few" in " ".join(capsys.readouterr().out.split())
    assert STARTS[int(pipeline.model.start_index)] == "plain"


def test_nothing_to_see_in_the_photographs_to_hold_back(scene, capsys, monkeypatch):
    asked = errors_of_trials(monkeypatch, 2.0, 1.0)
    monkeypatch.setattr(start_choice, "HELD_BACK", 40)  # the first of them would be photograph 20 of 17
    trained(scene, trial_steps=2)
    assert "start: plain, as nothing of the photographs to hold back" in " ".join(capsys.readouterr().out.split())
    assert asked == []


def test_trials_beyond_the_memory_budget_are_not_made(scene, capsys, monkeypatch):
    """A run that stays on a lattice for which the budget is enough is not ended by its trials."""
    asked = errors_of_trials(monkeypatch, 2.0, 1.0)
    pipeline = trained(scene, steps=6, trial_steps=2, refine_at=[100], memory_budget_gb=0.0003)
    log = " ".join(capsys.readouterr().out.split())
    assert "start: plain, as trials need more memory than they may have" in log
    assert asked == [] and pipeline.model.grid.lattice.cell_shape[0] == 8


@pytest.mark.parametrize("rays", [1, 3])
def test_batches_of_next_to_no_rays(scene, rays):
    pipeline, _ = train_with_optimizers(scene, 6, {**TWO_LATTICES, "trial_steps": 2}, rays=rays)
    assert STARTS[int(pipeline.model.start_index)] in ("plain", "photographs")


@pytest.mark.parametrize("start", ["plain", "photographs"])
def test_a_resumed_training_goes_on_with_its_course(scene, start, monkeypatch, capsys):
    """The lattice of a start from photographs is not split again where a plain one is."""
    asked = errors_of_trials(monkeypatch, 2.0 if start == "photographs" else 1.0, 1.5)
    pipeline, optimizers = train_with_optimizers(scene, 6, {**TWO_LATTICES, "trial_steps": 2}, rays=64)
    model, state = pipeline.model, pipeline.state_dict()
    assert model.grid.lattice.cell_shape[0] == 16 and asked == [1, 1, 2, 2]
    fresh, resumed = train_with_optimizers(scene, 1, {**TWO_LATTICES, "start": "plain"}, rays=64)
    fresh.model.config.start = "auto"
    fresh.load_pipeline({f"module.{key}": value for key, value in state.items()}, 5)
    resumed.load_optimizers({name: optimizer.state_dict() for name, optimizer in optimizers.optimizers.items()})
    given = attributes(fresh, resumed, 20, first=6)
    verdict = decide_start(fresh.model, given)
    assert verdict.start == start and len(asked) == 4
    fresh.model.config.start = "plain" if start == "photographs" else "photographs"
    assert decide_start(fresh.model, given).start == start
    said = f"start: {start}, as the training began; {fresh.model.config.start} would need a new training"
    assert said in " ".join(capsys.readouterr().out.split())
    for callback in fresh.model.get_training_callbacks(given):
        callback.run_callback(TWO_LATTICES["refine_at"][0])
    # Only the course of a plain start splits voxels at this step.
    assert fresh.model.grid.lattice.cell_shape[0] == (16 if start == "photographs" else 32)


def test_a_checkpoint_from_before_there_was_a_choice_is_loaded(scene):
    pipeline, optimizers = train_with_optimizers(scene, 1, {**TWO_LATTICES, "start": "plain"}, rays=64)
    state = pipeline.state_dict()
    del state["_model.start_index"]
    pipeline.model.start_index.zero_()
    pipeline.load_pipeline(state, 0)
    assert decide_start(pipeline.model, attributes(pipeline, optimizers, 5000, first=1)).start == "plain"


def test_a_start_from_photographs_begins_on_a_finer_lattice_and_its_optimisers_follow(scene):
    pipeline, optimizers = train_with_optimizers(scene, 1, {**TWO_LATTICES, "start": "photographs"}, rays=64)
    grid = pipeline.model.grid
    assert grid.lattice.cell_shape == (16, 16, 16)
    for name, parameter in grid.row_parameters().items():
        assert optimizers.optimizers[name].param_groups[0]["params"] == [parameter]
    assert optimizers.optimizers["density"].param_groups[0]["eps"] == SMALLEST_EPS
    assert optimizers.optimizers["sh"].param_groups[0]["eps"] == 1e-15


@pytest.mark.parametrize(
    ("resolutions", "refine_at", "skipped", "factor"),
    [
        ((32, 64, 128), (300, 750), (300,), 2),
        ((64, 128), (600,), (), 1),
        ((16, 32, 64), (10, 20), (10, 20), 4),
        ((33, 66), (10,), (), 1),
        ((128, 256), (10,), (), 1),
    ],
)
def test_lattices_of_at_most_64_voxels_are_skipped(resolutions, refine_at, skipped, factor):
    config = ThermoxelsModelConfig(resolutions=resolutions, refine_at=refine_at)
    assert config.skipped_refinements() == skipped and config.skipped_factor() == factor
