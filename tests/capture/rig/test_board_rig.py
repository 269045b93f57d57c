"""A heated checker board tells the rig; without one the start stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.board_pictures import BOARD, board_pairs, picture
from tests.support.known_rig import turned
from thermoxels_ns.capture.rig.board_rig import find_board, rig_from_boards
from thermoxels_ns.capture.stage_types import CameraModel, RigStart
from thermoxels_ns.core.errors import SceneError

VISIBLE = CameraModel(640, 480, 600.0, 600.0, 322.0, 238.0, k1=-0.05)
THERMAL = CameraModel(160, 128, 150.0, 150.0, 81.0, 63.0)
RIG = np.eye(4)
RIG[:3, :3], RIG[:3, 3] = turned(0.7, -1.5, 0.4), (0.09, -0.02, 0.01)


@pytest.fixture(scope="module")
def pairs() -> list[tuple[np.ndarray, np.ndarray]]:
    return board_pairs(VISIBLE, THERMAL, RIG)


def start() -> RigStart:
    camera = CameraModel.from_field_of_view(160, 128, 52.0)
    return RigStart(camera, translation_sigma=0.1, source="the lens")


def test_board_gives_focal_length_turn_and_shift(pairs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    found = rig_from_boards(pairs, VISIBLE, start(), BOARD)
    assert found.determined, found.explanation
    assert found.thermal_camera.fl_x == pytest.approx(THERMAL.fl_x, rel=0.01)
    assert np.allclose(found.visible_to_thermal[:3, 3], RIG[:3, 3], atol=0.006)
    turn = found.visible_to_thermal[:3, :3] @ RIG[:3, :3].T
    assert np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))) < 0.5
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.7), (0.3, 0.2, 1.2), (200, 3))

    def project(camera: CameraModel, rig: np.ndarray) -> np.ndarray:
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


def test_a_board_that_cannot_be_told_from_its_quarter_turn_is_refused() -> None:
    with pytest.raises(SceneError, match="not as many along both"):
        replace(BOARD, rows=7)
    with pytest.raises(SceneError, match="a square above 0 m"):
        replace(BOARD, square_m=0.0)
