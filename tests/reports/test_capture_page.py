"""Overlays of the page: what they show is where the numbers say."""

from __future__ import annotations

import numpy as np

from tests.support.posed_model import ring_model
from thermoxels_ns.capture.overlays import colours, jpeg_of, spread_out, thermal_in_photograph
from thermoxels_ns.capture.stage_types import CameraModel, RigEstimate, RigFrame

THERMAL = CameraModel(80, 60, 70.0, 70.0, 41.0, 29.0)


def test_a_point_of_the_thermal_image_lands_where_the_scene_has_it():
    """A warm spot at the projection of a scene point appears at that point in the photograph."""
    model = ring_model(3)
    seen, pixels = model.seen_by(1)
    frame = RigFrame("f1", np.zeros((480, 640)), np.zeros((60, 80)), model.camera_to_world[1], model.points[seen], seen)
    rig = np.eye(4)
    rig[:3, 3] = (0.3, -0.1, 0.05)
    estimate = RigEstimate(THERMAL, rig, (), np.zeros((0, 0)), True, "", 0.0, 0.0, 0.0)
    chosen = np.argmin(np.linalg.norm(pixels - (320, 240), axis=1))
    spot = THERMAL.project(frame.points_visible()[[chosen]] @ rig[:3, :3].T + rig[:3, 3])[0]
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    temperature_c = 20 + 10 * np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / 8)
    carried = thermal_in_photograph(frame, temperature_c, model.camera, estimate, width=640)
    row, column = np.unravel_index(np.nanargmax(carried), carried.shape)
    assert np.hypot(column + 0.5 - pixels[chosen][0], row + 0.5 - pixels[chosen][1]) < 6  # a thermal pixel is 7 wide
    assert np.isnan(carried).any()


def test_colours_go_from_dark_to_bright_and_nan_is_black():
    shown = colours(np.array([[0.0, 5.0, 10.0, np.nan]]), (0.0, 10.0)).sum(axis=2)[0]
    assert shown[0] < shown[1] < shown[2]
    assert shown[3] == 0
    assert (colours(np.full((2, 2), np.nan)) == 0).all()


def test_small_things():
    assert spread_out(100, 3) == [0, 50, 99]
    assert list(spread_out(2, 6)) == [0, 1]
    assert list(spread_out(0, 6)) == []
    assert jpeg_of(np.zeros((2, 2, 3), np.uint8)).startswith(b"\xff\xd8\xff")
