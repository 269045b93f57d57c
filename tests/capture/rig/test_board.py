from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.board_pictures import BOARD, board_pairs, write_board_folder
from tests.support.known_rig import turned
from thermoxels_ns.capture.rig.board import board_of, in_scene_units, rig_from_board_photos
from thermoxels_ns.capture.rig_types import RigEstimate
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.scale_and_up import MetricScale
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.radiometry.thermogram import RadiometryOptions

VISIBLE = Camera(640, 480, 600.0, 600.0, 322.0, 238.0, k1=-0.05)
THERMAL = Camera(160, 128, 150.0, 150.0, 81.0, 63.0)
RIG = np.eye(4)
RIG[:3, :3], RIG[:3, 3] = turned(0.7, -1.5, 0.4), (0.09, -0.02, 0.01)


@pytest.fixture(scope="module")
def pairs() -> list[tuple[np.ndarray, np.ndarray]]:
    return board_pairs(VISIBLE, THERMAL, RIG)


SIZE = (THERMAL.width, THERMAL.height)
SETTINGS = CaptureSettings(thermal_field_of_view_deg=55.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, pairs: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    return write_board_folder(tmp_path_factory.mktemp("board"), pairs)


def found(folder: Path, work: Path, size: tuple[int, int] = SIZE) -> RigEstimate:
    work.mkdir(exist_ok=True)
    return rig_from_board_photos(folder, BOARD, VISIBLE, size, work, SETTINGS, RadiometryOptions())


def test_files_give_focal_length_turn_and_place_in_metres_and_then_in_units(folder: Path, tmp_path: Path) -> None:
    rig = found(folder, tmp_path / "work")
    assert rig.determined
    assert rig.thermal_camera.fl_x == pytest.approx(THERMAL.fl_x, rel=0.01)
    assert np.allclose(rig.visible_to_thermal[:3, 3], RIG[:3, 3], atol=0.006)
    turn = rig.visible_to_thermal[:3, :3] @ RIG[:3, :3].T
    assert np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))) < 0.5
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.7), (0.3, 0.2, 1.2), (200, 3))
    pixels = [
        camera.project(points @ pose[:3, :3].T + pose[:3, 3])
        for camera, pose in ((rig.thermal_camera, rig.visible_to_thermal), (THERMAL, RIG))
    ]
    assert np.median(np.linalg.norm(pixels[0] - pixels[1], axis=1)) < 0.15
    assert 0.0 < rig.projection_sigma_px < 0.3
    units = in_scene_units(rig, MetricScale(0.5, None, "a ruler"), "")
    assert np.allclose(units.visible_to_thermal[:3, 3], 2.0 * rig.visible_to_thermal[:3, 3])
    assert np.array_equal(units.visible_to_thermal[:3, :3], rig.visible_to_thermal[:3, :3])
    assert units.standard_errors["tx"] == pytest.approx(2.0 * rig.standard_errors["tx"])
    assert units.standard_errors["rx"] == rig.standard_errors["rx"]


def test_pictures_that_do_not_serve_are_refused(
    folder: Path, tmp_path: Path, pairs: list[tuple[np.ndarray, np.ndarray]]
) -> None:
    with pytest.raises(SceneError, match="board pictures"):
        found(folder, tmp_path / "a", size=(80, 64))
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SceneError, match="empty"):
        found(empty, tmp_path / "c")
    blank = [(photograph, np.full_like(thermal, 20.0)) for photograph, thermal in pairs[2:]]
    two = write_board_folder(tmp_path / "two", [*pairs[:2], *blank])
    with pytest.raises(SceneError, match="in 2 of 5 pairs"):
        found(two, tmp_path / "d")


def test_options_of_the_board_belong_together() -> None:
    whole = replace(SETTINGS, board_photos=Path("x"), board="5x7", board_square_m=0.03)
    board = board_of(whole)
    assert board is not None and (board.columns, board.rows, board.square_m) == (7, 5, 0.03)
    assert board_of(SETTINGS) is None
    for wrong in (replace(whole, board=None), replace(whole, rig=Path("r.json")), replace(whole, board="5x5")):
        with pytest.raises(SceneError, match="checker board"):
            board_of(wrong)
