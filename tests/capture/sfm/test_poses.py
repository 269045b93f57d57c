"""Poses and points of a corner whose truth is known; a capture's poses are compared in `test_stages.py`."""

import json

import numpy as np
import pytest
from PIL import Image

from tests.support.colmap_model import write_colmap_model
from tests.support.posed_model import CAMERA, ring_model
from tests.support.textured_room import VISIBLE, write_card
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.colmap import model_of_colmap
from thermoxels_ns.capture.sfm.poses import (
    Poses,
    add_points,
    find_poses,
    fitted_to_photographs,
    image_pairs,
    read_given_poses,
)
from thermoxels_ns.capture.sfm.sfm_model import SfmModel, SparseDepth
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data.colmap_model import read_model

SETTINGS = CaptureSettings(max_features=500)
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
    model = add_points(given, photographs, tmp_path, SETTINGS)
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
    Image.fromarray(use).save(tmp_path / "mask.png")
    some = {name: photographs[name] for name in ("shot0", "shot1", "shot2", "shot3")}
    masks = dict.fromkeys(some, tmp_path / "mask.png")
    model = find_poses(some, tmp_path, SETTINGS, 430.0, masks).model
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
    assert np.isinf(SparseDepth(np.zeros((0, 3))).at(np.ones((2, 3)))).all()  # nothing is known without points


MODEL = ring_model(5, points=60)
SOURCES = {name: f"visible/{name}-visible.jpg" for name in MODEL.frames}


def transforms(tmp_path, names=None, **more):
    content = {
        **{key: getattr(CAMERA, key) for key in ("fl_x", "fl_y", "cx", "cy", "k1")},
        **{"w": CAMERA.width, "h": CAMERA.height, "camera_model": "OPENCV", **more},
        "frames": [
            {"file_path": (names or SOURCES)[name], "transform_matrix": pose.tolist()}
            for name, pose in zip(MODEL.frames, MODEL.camera_to_world)
        ],
    }
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("form", ["{0}-visible.jpg", "images/{0}-visible.png", "visible\\{0}-visible.jpg", "{0}.jpg"])
def test_photographs_are_recognised_by_name(tmp_path, form):
    path = transforms(tmp_path, {name: form.format(name) for name in MODEL.frames})
    found = read_given_poses(path, {**SOURCES, "other": "visible/other-visible.jpg"})
    assert found.model.frames == MODEL.frames
    assert np.array_equal(found.model.camera_to_world, MODEL.camera_to_world)
    assert found.model.camera == CAMERA
    assert list(found.dropped) == ["other"]


def test_poses_that_cannot_be_and_distortion_that_the_camera_cannot_hold_are_refused(tmp_path):
    path = transforms(tmp_path)
    content = json.loads(path.read_text())
    content["frames"][2]["transform_matrix"] = (MODEL.camera_to_world[2] @ np.diag([-1.0, 1.0, 1.0, 1.0])).tolist()
    path.write_text(json.dumps(content))
    with pytest.raises(SceneError, match="frame 2: transform_matrix"):
        read_given_poses(path, SOURCES)
    with pytest.raises(SceneError, match="k3 0"):
        read_given_poses(transforms(tmp_path, k3=0.1), SOURCES)


def blank_photographs(folder, sizes):
    files = {}
    for name, size in zip(MODEL.frames, sizes):
        files[name] = folder / f"{name}.png"
        Image.new("L", size).save(files[name])
    return files


def test_poses_of_reduced_photographs_are_those_of_the_originals(tmp_path):
    size = (2 * CAMERA.width, 2 * CAMERA.height)
    files = blank_photographs(tmp_path, [size] * len(MODEL.frames))
    fitted = fitted_to_photographs(Poses(MODEL, {}), files).model
    assert (fitted.camera.width, fitted.camera.height) == size
    assert fitted.camera.fl_x == 2 * CAMERA.fl_x and fitted.camera.k1 == CAMERA.k1
    assert np.array_equal(fitted.sighting_pixel, 2 * MODEL.sighting_pixel)
    assert np.array_equal(fitted.camera_to_world, MODEL.camera_to_world)
    assert fitted.sighting_error_px() == pytest.approx(2 * MODEL.sighting_error_px(), abs=1e-9)


def test_cropped_or_turned_photographs_are_refused_and_single_ones_of_another_size_left_out(tmp_path):
    for size in ((CAMERA.height, CAMERA.width), (CAMERA.width, CAMERA.height - 8)):
        files = blank_photographs(tmp_path, [size] * len(MODEL.frames))
        with pytest.raises(SceneError, match=rf"proportions of .*got {size[0]} x {size[1]}.*cropped"):
            fitted_to_photographs(Poses(MODEL, {}), files)
    sizes = [(CAMERA.width, CAMERA.height)] * (len(MODEL.frames) - 1) + [(64, 48)]
    fitted = fitted_to_photographs(Poses(MODEL, {"x": "no pose"}), blank_photographs(tmp_path, sizes))
    assert fitted.model.frames == MODEL.frames[:-1]
    assert fitted.model.camera == CAMERA
    assert set(fitted.dropped) == {"x", MODEL.frames[-1]} and "64 x 48" in fitted.dropped[MODEL.frames[-1]]


def test_a_colmap_model_comes_in_with_its_points(tmp_path):
    files = {f"{name}-visible.jpg": name for name in MODEL.frames}
    write_colmap_model(tmp_path, list(files), MODEL.camera_to_world, CAMERA, MODEL.points, text=True)
    found = read_given_poses(tmp_path, SOURCES).model
    assert found.camera_to_world == pytest.approx(MODEL.camera_to_world, abs=1e-9)
    assert found.camera == CAMERA
    assert len(found.points) == len(MODEL.points)
    assert found.sighting_error_px().max() < 1e-6
    assert len(found.sighting_frame) == len(MODEL.frames) * len(MODEL.points)
    assert found.point_error_px == pytest.approx(0.5)
    large = model_of_colmap(read_model(tmp_path), files, (1280, 960))
    assert (large.camera.fl_x, large.camera.cx, large.camera.k1) == (1000.0, 640.0, 0.02)
    assert large.sighting_error_px().max() < 1e-6
    assert large.point_error_px == pytest.approx(1.0)
