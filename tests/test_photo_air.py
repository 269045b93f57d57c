"""Voxels that photographs look through: before a plane whose place is known, and within a training."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests.short_training import train
from tests.test_photo_consistency import LATTICE, PLANE, photographs
from thermoxels_ns import photo_air, start_choice
from thermoxels_ns.data.synthetic import make_scene, write_scene
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.photo_air import (
    MARGIN_VOXELS,
    MOST_GAIN,
    SeenThrough,
    air_from_depths,
    carve_seen_through,
    find_air,
    start_from_depths,
)
from thermoxels_ns.photo_start import find_start
from thermoxels_ns.plane_sweep import Depths, depths_of


@pytest.fixture(scope="module")
def depths() -> Depths:
    return depths_of(photographs(), LATTICE.lo, LATTICE.hi)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "sphere"
    write_scene(make_scene("sphere"), folder, 18, 2, 80, 60, progress=False)
    return folder


def shown_by(at_least: int) -> np.ndarray:
    """Voxels whose middle that many photographs show."""
    points = LATTICE.cell_centres().reshape(-1, 3)
    count = np.zeros(len(points), dtype=int)
    seen = photographs()
    for matrix, size in zip(seen.matrices, seen.sizes):
        across = points @ matrix[:, :3].T + matrix[:, 3]
        pixel = across[:, :2] / across[:, 2:]
        count += ((pixel > 3) & (pixel < size - 3)).all(1)
    return (count >= at_least).reshape(LATTICE.cell_shape)


HEIGHT = LATTICE.cell_centres()[..., 2]
MARGIN = MARGIN_VOXELS * LATTICE.voxel_size


def test_most_of_what_lies_before_a_plane_is_air_and_nothing_on_or_behind_it(depths):
    air = air_from_depths(LATTICE, depths)
    assert not air[HEIGHT < PLANE + MARGIN].any()
    before = (HEIGHT > PLANE + MARGIN + 0.1) & shown_by(4)
    assert before.sum() > 500 and air[before].mean() > 0.9
    assert not air[~shown_by(1)].any()


def test_a_voxel_in_which_others_see_something_is_no_air():
    """A fourth of the photographs sees a plane nearer to it: what the others see through there is not air for sure."""
    seen = photographs([(x, y, 1.6) for x in np.linspace(-0.25, 0.25, 6) for y in np.linspace(-0.2, 0.2, 4)])
    sure = np.full((len(seen), len(seen.colours) // len(seen)), 1.6 - PLANE, dtype=np.float32)
    error = np.full(sure.size, 0.02, dtype=np.float32)
    layer = np.abs(HEIGHT - (PLANE + 0.25)) < 0.6 * LATTICE.voxel_size
    layer &= np.abs(LATTICE.cell_centres()[..., :2]).max(-1) < 0.1
    agreed = Depths(seen, sure.ravel(), sure.ravel(), error)
    assert layer.any() and air_from_depths(LATTICE, agreed)[layer].all()
    likely, sure = sure.copy(), sure.copy()
    likely[::4] -= 0.25
    sure[::4] = np.nan
    torn = Depths(seen, sure.ravel(), likely.ravel(), error)
    assert not air_from_depths(LATTICE, torn)[layer].any()


def test_a_start_from_depths_is_dense_at_the_plane_alone(depths):
    model: Any = SimpleNamespace(config=SimpleNamespace(resolutions=(16,)), grid=SimpleNamespace(lattice=LATTICE))
    found = start_from_depths(LATTICE, depths, model)
    assert found.log_gain is not None and found.log_gain.shape == LATTICE.shape
    middle = found.log_gain[6:-6, 6:-6].mean((0, 1))
    at = round((PLANE + 0.5) * 16)
    assert np.argmax(middle) == at and middle[at] > 0.9 * MOST_GAIN
    assert np.delete(middle, [at - 1, at, at + 1]).max() <= 0.0, middle
    assert middle[[at - 1, at + 1]].max() < MOST_GAIN - 2.0, middle
    assert found.air is not None and np.array_equal(found.air.air, air_from_depths(LATTICE, depths))


def test_coarse_voxels_are_air_if_all_of_them_is_and_fine_ones_if_they_lie_in_air():
    fine = Lattice.covering((0, 0, 0), (1, 1, 1), 8)
    air = np.random.default_rng(0).random((8, 8, 8)) < 0.9
    found = SeenThrough(fine, air)
    coarse = found.within(Lattice.covering((0, 0, 0), (1, 1, 1), 4))
    expected = [
        [[air[2 * i : 2 * i + 2, 2 * j : 2 * j + 2, 2 * k : 2 * k + 2].all() for k in range(4)] for j in range(4)]
        for i in range(4)
    ]
    assert np.array_equal(coarse, expected) and 0 < coarse.sum() < coarse.size
    finer = found.within(fine.refined(2))
    assert finer.shape == (16, 16, 16)
    assert np.array_equal(finer[::2, ::2, ::2], air) and np.array_equal(finer[1::2, 1::2, 1::2], air)
    assert np.array_equal(found.within(fine), air)


def test_carved_voxels_are_no_longer_stored_and_rows_follow():
    box = Lattice.covering((-1, -1, -1), (1, 1, 1), 8)
    air = np.zeros((8, 8, 8), dtype=bool)
    air[:5] = True
    model: Any = SimpleNamespace(grid=VoxelGrid(box, sh_degree=0))
    change = carve_seen_through(model, SeenThrough(box, air))
    assert np.array_equal(model.grid.kept.numpy(), ~air)
    rows = torch.arange(box.num_corners)[:, None]
    assert change is not None and torch.equal(change(rows)[:, 0], torch.from_numpy(model.grid.voxels.corners))
    assert carve_seen_through(model, SeenThrough(box, air)) is None  # nothing is left to drop
    assert carve_seen_through(model, SeenThrough(box, np.ones_like(air))) is None  # never all
    assert carve_seen_through(model, None) is None


@pytest.mark.parametrize("options", [{}, {"photo_depth": "on", "sh_degree": None}])
def test_photographs_are_not_asked_where_that_is_not_wanted_or_none_train(scene, options):
    pipeline = train(scene, 0, {"start": "plain", **options})
    assert find_air(pipeline.model, pipeline.datamanager) is None


@pytest.mark.parametrize("start", ["plain", "photographs"])
def test_air_is_dropped_at_the_start_and_after_a_refinement(scene, capsys, start):
    course = {
        "resolutions": [8, 16, 32],
        "refine_at": [2, 4],
        "prune_threshold": 0.0,
        "start": start,
        "photo_depth": "on",
    }
    with_air = train(scene, 6, course).model
    said = capsys.readouterr().out
    without = train(scene, 6, {**course, "photo_depth": "off"}).model
    assert len(without.grid.voxels) == int(np.prod(without.grid.lattice.cell_shape))
    air = np.flatnonzero(~with_air.grid.kept.numpy())
    assert len(air) > 0.01 * len(without.grid.voxels)
    assert said.count("voxels are air") >= 1 and said.count("photographs agree about") == 1  # asked once
    assert "depths:" not in capsys.readouterr().out


def test_a_start_that_won_its_trial_asks_all_photographs_once(scene, capsys, monkeypatch):
    won = start_choice.Verdict("photographs", "as it won")  # of what a trial found nothing is kept
    monkeypatch.setattr(start_choice, "_decide", lambda model, attributes: won)
    train(scene, 4, {"resolutions": [8, 16], "refine_at": [2], "photo_depth": "on"})
    said = capsys.readouterr().out
    assert said.count("voxels are air") >= 1 and said.count("photographs agree about") == 1


def test_what_the_sphere_holds_is_never_air(scene):
    pipeline = train(scene, 0, {"resolutions": [32], "start": "plain", "photo_depth": "on"})
    found = find_air(pipeline.model, pipeline.datamanager)
    assert found is not None
    outputs: Any = pipeline.datamanager.train_dataparser_outputs
    from thermoxels_ns.export import input_from_world

    to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    centres = found.lattice.cell_centres() @ to_input[:3, :3].T + to_input[:3, 3]
    inside = make_scene("sphere").signed_distance(centres.reshape(-1, 3)).reshape(centres.shape[:3]) < 0.0
    assert inside.any() and found.air.any()
    assert found.air[inside].mean() < 0.01


def test_photographs_held_back_are_not_asked(scene, monkeypatch):
    pipeline = train(scene, 0, {"start": "plain", "photo_depth": "on"})
    asked = []
    monkeypatch.setattr(photo_air, "depths_of", lambda seen, *box: asked.append(len(seen)) or depths_of(seen, *box))
    find_air(pipeline.model, pipeline.datamanager)
    find_air(pipeline.model, pipeline.datamanager, left_out=range(4, 18, 8))
    find_start(pipeline.model, pipeline.datamanager, left_out=range(4, 18, 8))
    assert asked == [18, 16, 16]
