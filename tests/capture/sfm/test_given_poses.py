import json

import numpy as np
import pytest
from PIL import Image

from tests.support.colmap_model import write_colmap_model
from tests.support.posed_model import CAMERA, ring_model
from thermoxels_ns.capture.sfm.colmap import model_of_colmap, read_colmap
from thermoxels_ns.capture.sfm.poses import Poses, fitted_to_photographs, read_given_poses
from thermoxels_ns.core.errors import SceneError

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


def photographs(folder, sizes):
    files = {}
    for name, size in zip(MODEL.frames, sizes):
        files[name] = folder / f"{name}.png"
        Image.new("L", size).save(files[name])
    return files


def test_poses_of_reduced_photographs_are_those_of_the_originals(tmp_path):
    size = (2 * CAMERA.width, 2 * CAMERA.height)
    files = photographs(tmp_path, [size] * len(MODEL.frames))
    fitted = fitted_to_photographs(Poses(MODEL, {}), files).model
    assert (fitted.camera.width, fitted.camera.height) == size
    assert fitted.camera.fl_x == 2 * CAMERA.fl_x and fitted.camera.k1 == CAMERA.k1
    assert np.array_equal(fitted.sighting_pixel, 2 * MODEL.sighting_pixel)
    assert np.array_equal(fitted.camera_to_world, MODEL.camera_to_world)
    assert fitted.sighting_error_px() == pytest.approx(2 * MODEL.sighting_error_px(), abs=1e-9)


def test_cropped_or_turned_photographs_are_refused_and_single_ones_of_another_size_left_out(tmp_path):
    for size in ((CAMERA.height, CAMERA.width), (CAMERA.width, CAMERA.height - 8)):
        files = photographs(tmp_path, [size] * len(MODEL.frames))
        with pytest.raises(SceneError, match=rf"proportions of .*got {size[0]} x {size[1]}.*cropped"):
            fitted_to_photographs(Poses(MODEL, {}), files)
    sizes = [(CAMERA.width, CAMERA.height)] * (len(MODEL.frames) - 1) + [(64, 48)]
    fitted = fitted_to_photographs(Poses(MODEL, {"x": "no pose"}), photographs(tmp_path, sizes))
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
    large = model_of_colmap(read_colmap(tmp_path), files, (1280, 960))
    assert (large.camera.fl_x, large.camera.cx, large.camera.k1) == (1000.0, 640.0, 0.02)
    assert large.sighting_error_px().max() < 1e-6
    assert large.point_error_px == pytest.approx(1.0)
