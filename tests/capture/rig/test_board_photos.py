"""A folder of board pictures gives the rig in metres; what is missing in it is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.board_pictures import BOARD, board_pairs, write_board_folder
from tests.support.textured_room import RIG, THERMAL, VISIBLE
from thermoxels_ns.capture.rig.board_photos import board_of, in_scene_units, rig_from_board_photos
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.metric_scale import MetricScale
from thermoxels_ns.capture.stage_types import CameraModel, RigEstimate
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.radiometry.camera_file import RadiometryOptions

SIZE = (THERMAL.width, THERMAL.height)
SETTINGS = CaptureSettings(thermal_field_of_view_deg=55.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_board_folder(tmp_path_factory.mktemp("board"), board_pairs(VISIBLE, THERMAL, RIG))


def found(folder: Path, work: Path, visible: CameraModel = VISIBLE, size: tuple[int, int] = SIZE) -> RigEstimate:
    work.mkdir(exist_ok=True)
    return rig_from_board_photos(folder, BOARD, visible, size, work, SETTINGS, RadiometryOptions())


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


def test_without_a_scale_metres_cannot_be_used(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"known scale.*no GPS.*--known-distance"):
        in_scene_units(found(folder, tmp_path / "work"), None, "no GPS")


def test_pictures_that_do_not_serve_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="thermal images: expected 80 x 64 pixels"):
        found(folder, tmp_path / "a", size=(80, 64))
    with pytest.raises(SceneError, match=r"board0-visible\.jpg: expected 960 x 720 pixels"):
        found(folder, tmp_path / "b", visible=VISIBLE.resized(960, 720))
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SceneError, match="got none; no camera files"):
        found(empty, tmp_path / "c")
    two = write_board_folder(tmp_path / "two", board_pairs(VISIBLE, THERMAL, RIG)[:2])
    with pytest.raises(SceneError, match=r"in 2 of 2 pairs.*Pairs: board0, board1"):
        found(two, tmp_path / "d")


def test_options_of_the_board_belong_together() -> None:
    whole = replace(SETTINGS, board_photos=Path("x"), board="5x7", board_square_m=0.03)
    board = board_of(whole)
    assert board is not None and (board.columns, board.rows, board.square_m) == (7, 5, 0.03)
    assert board_of(SETTINGS) is None
    for wrong, words in (
        (replace(whole, board=None), "got no --board"),
        (replace(SETTINGS, board="7x5"), "no --board-photos and no --board-square-m"),
        (replace(whole, rig=Path("r.json")), "all of them and --rig"),
        (replace(whole, board="seven"), "inner corners along both sides"),
        (replace(whole, board="5x5"), "not as many along both"),
        (replace(whole, board_square_m=-1.0), "a square above 0 m"),
    ):
        with pytest.raises(SceneError, match=words):
            board_of(wrong)
