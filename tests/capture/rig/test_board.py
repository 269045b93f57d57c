from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.board_pictures import BOARD, board_pairs, picture, write_board_folder
from tests.support.known_rig import turned
from thermoxels_ns.capture.rig.board import board_of, find_board, in_scene_units, rig_from_board_photos, rig_from_boards
from thermoxels_ns.capture.rig_types import RigEstimate, RigStart
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


def start() -> RigStart:
    camera = Camera.from_field_of_view(160, 128, 52.0)
    return RigStart(camera, translation_sigma=0.1, source="the lens")


def test_board_gives_focal_length_turn_and_shift(pairs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    found = rig_from_boards(pairs, VISIBLE, start(), BOARD)
    assert found.determined, found.explanation
    assert found.thermal_camera.fl_x == pytest.approx(THERMAL.fl_x, rel=0.01)
    assert np.allclose(found.visible_to_thermal[:3, 3], RIG[:3, 3], atol=0.006)
    turn = found.visible_to_thermal[:3, :3] @ RIG[:3, :3].T
    assert np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))) < 0.5
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.7), (0.3, 0.2, 1.2), (200, 3))

    def project(camera: Camera, rig: np.ndarray) -> np.ndarray:
        return camera.project(points @ rig[:3, :3].T + rig[:3, 3])

    apart = project(found.thermal_camera, found.visible_to_thermal) - project(THERMAL, RIG)
    assert np.median(np.linalg.norm(apart, axis=1)) < 0.15
    assert 0.0 < found.projection_sigma_px < 0.3


def test_corners_are_found_to_a_fraction_of_a_pixel(pairs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    board = np.eye(4)
    board[:3, 3] = (-0.18, -0.12, 0.9)
    corners = find_board(picture(THERMAL, board), BOARD)
    assert corners is not None
    truth = THERMAL.project(BOARD.corners + board[:3, 3])
    if np.dot(corners[-1] - corners[0], truth[-1] - truth[0]) < 0:
        corners = corners[::-1]
    assert np.abs(corners - truth).max() < 0.15
    assert find_board(np.full((60, 80), 20.0), BOARD) is None
    assert find_board(np.full((60, 80), np.nan), BOARD) is None


def test_without_boards_the_start_stays(pairs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    blank = [(photograph, np.full_like(thermal, 20.0)) for photograph, thermal in pairs]
    found = rig_from_boards([*blank, *pairs[:2]], VISIBLE, start(), BOARD)
    assert not found.determined
    assert found.thermal_camera == start().thermal_camera
    assert "in 2 of 7 pairs" in found.explanation


SIZE = (THERMAL.width, THERMAL.height)
SETTINGS = CaptureSettings(thermal_field_of_view_deg=55.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, pairs: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    return write_board_folder(tmp_path_factory.mktemp("board"), pairs)


def found(folder: Path, work: Path, size: tuple[int, int] = SIZE) -> RigEstimate:
    work.mkdir(exist_ok=True)
    return rig_from_board_photos(folder, BOARD, VISIBLE, size, work, SETTINGS, RadiometryOptions())


def test_files_give_focal_length_and_place_in_metres_and_then_in_units(folder: Path, tmp_path: Path) -> None:
    rig = found(folder, tmp_path / "work")
    assert rig.determined
    assert rig.thermal_camera.fl_x == pytest.approx(THERMAL.fl_x, rel=0.01)
    assert np.allclose(rig.visible_to_thermal[:3, 3], RIG[:3, 3], atol=0.006)
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
    two = write_board_folder(tmp_path / "two", pairs[:2])
    with pytest.raises(SceneError, match="in 2 of 2 pairs"):
        found(two, tmp_path / "d")


def test_options_of_the_board_belong_together() -> None:
    whole = replace(SETTINGS, board_photos=Path("x"), board="5x7", board_square_m=0.03)
    board = board_of(whole)
    assert board is not None and (board.columns, board.rows, board.square_m) == (7, 5, 0.03)
    assert board_of(SETTINGS) is None
    for wrong in (replace(whole, board=None), replace(whole, rig=Path("r.json")), replace(whole, board="5x5")):
        with pytest.raises(SceneError, match="checker board"):
            board_of(wrong)
