"""Poses of a corner whose truth is known; strays are dropped by name; the same seed gives the same bits."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from tests.support.textured_room import VISIBLE, alignment, write_card
from thermoxels_ns.capture.masks import PhotographMasks
from thermoxels_ns.capture.sfm.feature_matching import PoseOptions, image_pairs
from thermoxels_ns.capture.sfm.poses import add_points, find_poses
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.errors import SceneError

OPTIONS = PoseOptions(max_features=500)
COUNT = 6


@pytest.fixture(scope="module")
def card(tmp_path_factory):
    folder = tmp_path_factory.mktemp("card")
    truth = write_card(folder, COUNT, stray=True)
    photographs = {path.name.split("-")[0]: path for path in sorted(folder.glob("*.jpg"))}
    wide = folder / "wide.jpg"
    Image.new("RGB", (64, 48)).save(wide)
    return {**photographs, "wide": wide}, truth


@pytest.fixture(scope="module")
def found(card, tmp_path_factory):
    folder = tmp_path_factory.mktemp("poses")
    return find_poses(card[0], folder, 430.0, options=OPTIONS), folder


def test_poses_and_focal_length_are_those_of_the_truth(card, found):
    model = found[0].model
    assert model.frames == tuple(f"shot{n}" for n in range(COUNT))
    _, off_m, off_deg = alignment(model.camera_to_world, card[1])
    assert off_m < 0.01
    assert off_deg < 0.3
    assert model.camera.fl_x == pytest.approx(VISIBLE.fl_x, rel=0.01)
    assert (model.camera.width, model.camera.height) == (VISIBLE.width, VISIBLE.height)


def test_points_lie_on_the_walls_and_project_to_where_they_were_seen(card, found):
    model = found[0].model
    assert len(model.points) > 200
    error = model.sighting_error_px()
    assert np.median(error) < 0.5
    # Every wall is a coordinate plane of the truth's world; take the points there.
    a, b = model.centres, card[1][:, :3, 3]
    ac, bc = a - a.mean(axis=0), b - b.mean(axis=0)
    left, _, right = np.linalg.svd(bc.T @ ac)
    rotation = left @ np.diag([1, 1, np.sign(np.linalg.det(left @ right))]) @ right
    scale = alignment(model.camera_to_world, card[1])[0]
    points = scale * (model.points - a.mean(axis=0)) @ rotation.T + b.mean(axis=0)
    assert np.median(np.abs(points).min(axis=1)) < 0.01


def test_what_does_not_fit_is_dropped_and_named(found):
    dropped = found[0].dropped
    assert set(dropped) == {f"shot{COUNT}", "wide"}
    assert "too few matches" in dropped[f"shot{COUNT}"]
    assert "64 x 48 pixels" in dropped["wide"]


def test_the_same_seed_gives_the_same_bits(card, found, tmp_path):
    again = find_poses(card[0], tmp_path, 430.0, options=replace(OPTIONS, threads=1)).model
    assert np.array_equal(again.camera_to_world, found[0].model.camera_to_world)
    assert np.array_equal(again.points, found[0].model.points)
    assert again.camera == found[0].model.camera


def test_points_for_poses_that_are_given(card, tmp_path):
    photographs, truth = card
    none = np.zeros(0, dtype=np.int64)
    names = tuple(f"shot{n}" for n in range(COUNT))[::-1]  # in another order than that of their names
    given = SfmModel(
        *(names, VISIBLE, truth[::-1], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), none, none),
        np.zeros((0, 2)),
    )
    model = add_points(given, photographs, tmp_path, options=OPTIONS)
    assert np.array_equal(model.camera_to_world, truth[::-1])
    assert model.camera == VISIBLE
    assert len(model.points) > 200
    assert np.median(np.abs(model.points).min(axis=1)) < 0.01
    assert np.median(model.sighting_error_px()) < 0.7
    assert (np.diff(model.sighting_frame) >= 0).all() and set(model.sighting_frame) == set(range(COUNT))


def test_masked_parts_have_no_features(card, tmp_path):
    photographs, _ = card
    use = np.ones((VISIBLE.height, VISIBLE.width), dtype=bool)
    use[:, :200] = False
    masks = PhotographMasks((VISIBLE.width, VISIBLE.height), use)
    some = {name: photographs[name] for name in ("shot0", "shot1", "shot2", "shot3")}
    model = find_poses(some, tmp_path, 430.0, masks, OPTIONS).model
    assert model.sighting_pixel[:, 0].min() > 195


def test_photographs_that_show_nothing_in_common_are_an_error_that_says_what_to_do(tmp_path):
    rng = np.random.default_rng(0)
    paths = {}
    for name in "abcd":
        paths[name] = tmp_path / f"{name}.jpg"
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(paths[name])
    work = tmp_path / "work"
    work.mkdir()
    with pytest.raises(SceneError, match="more overlap"):
        find_poses(paths, work, options=OPTIONS)
    with pytest.raises(SceneError, match="at least 3"):
        find_poses({}, work, options=OPTIONS)


def test_every_pair_is_compared_up_to_a_number_and_neighbours_beyond():
    assert len(image_pairs(40, "auto")) == 40 * 39 // 2
    many = image_pairs(500, "auto")
    assert len(many) < 500 * 499 // 2 / 8
    assert (many[:, 0] < many[:, 1]).all()
    assert len(np.unique(many, axis=0)) == len(many)
    assert {(n, n + 1) for n in range(499)} <= set(map(tuple, many.tolist()))
    assert (0, 499) in set(map(tuple, many.tolist()))  # a path that returns to its start is closed
    assert set(np.unique(image_pairs(5, "sequential"))) == set(range(5))
