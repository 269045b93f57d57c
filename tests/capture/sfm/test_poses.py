"""Poses and points of a corner whose truth is known; a capture's poses are compared in `test_stages.py`."""

from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from tests.support.camera_card import write_pairs
from tests.support.posed_model import CAMERA, ring_model, write_colmap_model
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.poses import MODEL_FOLDER, image_pairs, read_poses
from thermoxels_ns.capture.sfm.sfm_model import SparseDepth
from thermoxels_ns.commands.capture import capture_folder
from thermoxels_ns.core.errors import OutputError, SceneError, ThermoxelsError


def test_every_pair_is_compared_up_to_a_number_and_neighbours_beyond():
    assert len(image_pairs(40)) == 40 * 39 // 2
    many = image_pairs(500)
    assert len(many) < 500 * 499 // 2 / 8
    assert (many[:, 0] < many[:, 1]).all()
    assert len(np.unique(many, axis=0)) == len(many)
    assert {(n, n + 1) for n in range(499)} <= set(map(tuple, many.tolist()))
    assert (0, 499) in set(map(tuple, many.tolist()))  # a path that returns to its start is closed


def test_a_mapping_that_fails_is_an_error_and_the_capture_goes_on_behind_its_features(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise ValueError("no model")

    write_pairs(tmp_path / "card")
    said: list[str] = []
    monkeypatch.setattr(pycolmap, "incremental_mapping", fail)
    with pytest.raises(ThermoxelsError, match=r"COLMAP: .* got no model.*--from-stage poses"):
        capture_folder(tmp_path / "card", tmp_path / "scene", CaptureSettings(), said.append)
    assert said[-1].startswith("matches: 3 of 3")
    monkeypatch.undo()
    with pytest.raises(SceneError, match="photographs that fit together"):  # grey ones: it got past the mapping
        capture_folder(tmp_path / "card", tmp_path / "scene", CaptureSettings())


def test_a_model_that_a_full_disk_cut_off_is_not_kept(tmp_path, monkeypatch):
    """COLMAP itself says nothing of it."""

    class Group:
        points3D = ()
        num_reg_images = staticmethod(lambda: 3)
        reg_image_ids = staticmethod(lambda: [1, 2, 3])
        image = staticmethod(lambda _: SimpleNamespace(name=""))

        @staticmethod
        def write(folder):
            write_colmap_model(folder, ["a.jpg"], np.eye(4)[None], CAMERA, np.array([[0.0, 0.0, -2.0]]))
            (folder / "points3D.bin").write_bytes(b"")

    write_pairs(tmp_path / "card")
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *_, **__: {0: Group})
    with pytest.raises(OutputError, match=r"poses: expected to write .* got files that are cut off.*free space"):
        capture_folder(tmp_path / "card", tmp_path / "scene", CaptureSettings())
    kept = tmp_path / "scene" / ".capture" / "poses"
    assert kept.is_dir() and not (kept / "done").exists() and not (kept / MODEL_FOLDER).exists()


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


def test_a_colmap_model_comes_in_with_its_points_at_the_photographs_own_size(tmp_path):
    write_colmap_model(tmp_path / MODEL_FOLDER, list("abcde"), MODEL.camera_to_world, CAMERA, MODEL.points)
    found = read_poses(tmp_path, MODEL.frames, (CAMERA.width, CAMERA.height))
    assert found.frames == MODEL.frames
    assert found.camera_to_world == pytest.approx(MODEL.camera_to_world, abs=1e-9)
    assert found.camera == CAMERA
    assert len(found.points) == len(MODEL.points)
    assert found.points == pytest.approx(MODEL.points, abs=1e-9)
    assert [len(seen) for seen in found.seen] == len(MODEL.frames) * [len(MODEL.points)]
    assert found.point_error_px == pytest.approx(0.5)
    large = read_poses(tmp_path, MODEL.frames, (1280, 960))
    assert (large.camera.fl_x, large.camera.cx, large.camera.k1) == (1000.0, 640.0, 0.02)
    assert large.point_error_px == pytest.approx(1.0)
