"""Poses and points of a corner whose truth is known; a capture's poses are compared in `test_stages.py`."""

import numpy as np
import pytest

from tests.support.textured_room import VISIBLE, write_card
from thermoxels_ns.capture.masks import PhotographMasks
from thermoxels_ns.capture.sfm.feature_matching import PoseOptions, image_pairs
from thermoxels_ns.capture.sfm.poses import add_points, find_poses
from thermoxels_ns.capture.sfm.sfm_model import SfmModel, SparseDepth

OPTIONS = PoseOptions(max_features=500)
COUNT = 6


@pytest.fixture(scope="module")
def card(tmp_path_factory):
    folder = tmp_path_factory.mktemp("card")
    truth = write_card(folder, COUNT)
    photographs = {path.name.split("-")[0]: path for path in sorted(folder.glob("*.jpg"))}
    return photographs, truth


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


def test_every_pair_is_compared_up_to_a_number_and_neighbours_beyond():
    assert len(image_pairs(40, "auto")) == 40 * 39 // 2
    many = image_pairs(500, "auto")
    assert len(many) < 500 * 499 // 2 / 8
    assert (many[:, 0] < many[:, 1]).all()
    assert len(np.unique(many, axis=0)) == len(many)
    assert {(n, n + 1) for n in range(499)} <= set(map(tuple, many.tolist()))
    assert (0, 499) in set(map(tuple, many.tolist()))  # a path that returns to its start is closed
    assert set(np.unique(image_pairs(5, "sequential"))) == set(range(5))


def test_a_slanted_plane_has_its_own_depth_and_not_that_of_its_nearest_points() -> None:
    draw = np.random.default_rng(0)
    rays = np.column_stack([draw.uniform(-0.4, 0.4, (600, 2)), np.ones(600)])
    normal = np.array([0.5, -0.2, 1.0])
    inverse = rays @ normal / 5.0
    depth, distance = SparseDepth(rays / inverse[:, None]).at(asked := rays[:100] * 0.7 + (0.0, 0.0, 0.3))
    assert np.median(np.abs(depth * (asked @ normal / 5.0) - 1.0)) < 2e-3
    assert distance.max() < 0.1


def test_at_an_outline_the_surface_in_front_counts_and_a_stray_point_does_not() -> None:
    draw = np.random.default_rng(1)
    rays = np.column_stack([draw.uniform(-0.4, 0.4, (2000, 2)), np.ones(2000)])
    depths = np.where(rays[:, 0] < 0.0, 2.0, 10.0)
    depths[7] = 0.1
    found, _ = SparseDepth(rays * depths[:, None]).at(np.array([[0.002, y, 1.0] for y in (-0.3, 0.0, 0.3)]))
    assert found == pytest.approx([2.0] * 3, rel=0.1)


def test_without_points_nothing_is_known() -> None:
    depth, distance = SparseDepth(np.zeros((0, 3))).at(np.ones((2, 3)))
    assert np.isinf(depth).all() and np.isinf(distance).all()
