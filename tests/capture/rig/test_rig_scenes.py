"""Rigs of drawn captures, and those that a file gives."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.support.known_rig import KnownCapture, changes_between, drawn_capture, known_capture, painted_sky
from thermoxels_ns.capture.rig.drift import estimate_drift, sample_shared_points
from thermoxels_ns.capture.rig.images import local_contrast, without_fixed_pattern
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.rig.start import read_rig
from thermoxels_ns.capture.rig_types import PARAMETERS, RigEstimate, RigFrame, guessed_rig
from thermoxels_ns.core.errors import SceneError


@pytest.fixture(scope="module")
def house() -> KnownCapture:
    return known_capture(views=6, photograph_width=480, thermal_width=120)


@pytest.fixture(scope="module")
def sky() -> KnownCapture:
    return painted_sky()


def sky_start(sky: KnownCapture) -> RigEstimate:
    camera = replace(sky.thermal, fl_x=sky.thermal.fl_x * 0.95, fl_y=sky.thermal.fl_y * 0.95)
    guess = guessed_rig(camera, "the test", shift_sigma=1e-6)
    return replace(guess, covariance=guess.covariance * ([1.0] * 7 + [0.0] * 3))  # principal point and k1 are known


def with_temperatures(capture: KnownCapture, images: list[np.ndarray]) -> list[RigFrame]:
    return [replace(f, temperature_c=image.astype(np.float32)) for f, image in zip(capture.frames, images)]


def test_comparing_edges_alone_is_exact_to_a_twentieth_of_a_pixel(sky: KnownCapture) -> None:
    eight_bit = [replace(f, photograph=np.round(255 * np.asarray(f.photograph)).astype(np.uint8)) for f in sky.frames]
    found = estimate_rig(eight_bit, sky.visible, sky_start(sky))
    assert found.determined, found.explanation
    assert sky.turn_error_deg(found) < 0.05
    assert sky.focal_error(found) < 2e-3
    assert sky.projection_error_px(found) < 0.05
    negative = with_temperatures(sky, [40.0 - np.asarray(frame.temperature_c) for frame in sky.frames])
    assert sky.projection_error_px(estimate_rig(negative, sky.visible, sky_start(sky))) < 0.05


@pytest.mark.parametrize("kind", ["noise", "other frames", "two frames", "black photographs"])
def test_what_the_images_cannot_tell_stays_as_it_was(house: KnownCapture, kind: str) -> None:
    draw = np.random.default_rng(1)
    shape = (house.thermal.height, house.thermal.width)
    if kind == "noise":
        frames = with_temperatures(house, [20.0 + 0.05 * draw.standard_normal(shape) for _ in house.frames])
    elif kind == "other frames":
        frames = with_temperatures(house, [np.asarray(f.temperature_c) for f in (*house.frames[3:], *house.frames[:3])])
    elif kind == "two frames":
        frames = house.frames[:2]
    else:
        frames = [replace(f, photograph=np.zeros_like(f.photograph)) for f in house.frames]
    start = guessed_rig(house.thermal, "the test")
    found = estimate_rig(frames, house.visible, start)
    assert not found.determined
    assert found.thermal_camera == start.thermal_camera
    assert np.array_equal(found.visible_to_thermal, start.visible_to_thermal)
    assert "the start value is kept (the test)" in found.explanation
    reason = {"two frames": "2 frames with at least 12", "other frames": ""}.get(kind, "no better")
    assert reason in found.explanation


def test_dead_columns_and_an_odd_number_of_colours_do_no_harm(sky: KnownCapture) -> None:
    width = sky.thermal.width
    images = [np.where(np.arange(width) < width // 8, np.nan, np.asarray(f.temperature_c)) for f in sky.frames]
    frames = [
        replace(f, photograph=np.dstack([255 * np.asarray(f.photograph)] * 3).astype(np.uint8))
        for f in with_temperatures(sky, images)
    ]
    found = estimate_rig(frames, sky.visible, sky_start(sky))
    assert found.determined, found.explanation
    assert sky.projection_error_px(found) < 0.1


def test_a_pattern_that_stays_is_taken_out_and_images_without_one_are_as_they_were() -> None:
    draw = np.random.default_rng(1)
    scenes = [3.0 * cv2.GaussianBlur(draw.standard_normal((64, 64)), (0, 0), 2.0).astype(np.float32) for _ in range(12)]
    pattern = 0.5 * draw.standard_normal((64, 64)).astype(np.float32)
    alone, cleaned = without_fixed_pattern(scenes), without_fixed_pattern([scene + pattern for scene in scenes])
    assert all(np.array_equal(image, local_contrast(scene)) for image, scene in zip(alone, scenes))
    assert np.std([image - scene for image, scene in zip(cleaned, alone)]) < 0.5 * pattern.std()


CAMERA = {"w": 64, "h": 48, "fl_x": 70.0, "fl_y": 70.0, "cx": 32.0, "cy": 24.0}


def rig_file(folder, **changed):
    rig = np.eye(4)
    rig[:3, 3] = 0.1, 0.0, 0.02
    content = {"thermal_camera": CAMERA, "rig": rig.tolist(), "metres_per_unit": 0.5, **changed}
    path = folder / "transforms.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(("ours", "shift"), [(0.5, 0.1), (0.25, 0.2), (None, 0.1)])
def test_lengths_follow_the_scales(tmp_path, ours, shift):
    rig = read_rig(rig_file(tmp_path), (64, 48), ours)
    assert rig.visible_to_thermal[0, 3] == pytest.approx(shift)
    assert ("converted" in rig.explanation) == (ours is not None)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        *(({"rig": rig.tolist()}, "rig: expected") for rig in (np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(3))),
        *(({"thermal_camera": {**CAMERA, "w": w}}, "thermal_camera") for w in (math.inf, math.nan, 64.5, -math.inf)),
    ],
)
def test_mirrors_other_matrices_and_sizes_that_are_no_whole_numbers_are_refused(tmp_path, changes, named):
    with pytest.raises(SceneError, match=rf"transforms\.json: {named}"):
        read_rig(rig_file(tmp_path, **changes), (64, 48))
    assert read_rig(rig_file(tmp_path, thermal_camera={**CAMERA, "w": 64.0}), (64, 48)).thermal_camera.width == 64


FRAMES = 36


def test_turn_focal_length_and_offsets_are_known() -> None:
    """Nothing was measured, yet the turn is known: 36 frames show the same walls at other places of the image."""
    capture, start = drawn_capture("house-corner", 4, 160, 0.05, 51, FRAMES)  # 0.34 degrees where all count as one
    found = estimate_rig(capture.frames, capture.visible, start)
    assert found.determined, found.explanation
    assert capture.turn_error_deg(found) < 0.2
    assert capture.focal_error(found) < 0.01
    assert capture.projection_error_px(found) < 0.17
    drift = estimate_drift(sample_shared_points(capture.frames, found.thermal_camera, found.visible_to_thermal))
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1


def test_points_that_lie_together_do_not_decide_an_offset() -> None:
    capture, _ = drawn_capture("courtyard", 2, 120, 0.05, 72, FRAMES)  # 0.15 K from a thousand points of each frame
    drift = estimate_drift(sample_shared_points(capture.frames, capture.thermal, capture.visible_to_thermal))
    assert drift.used, drift.explanation
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1


def test_points_and_offsets_are_sure_and_each_number_as_sure_as_stated() -> None:
    """Only the thermal angle of view is known, to 5 %; turn, lenses, noise and drift are drawn anew for every seed.

    Turn and principal point, and for some captures focal length and shift ahead, can be exchanged for each other, so
    these are held to their own standard errors.
    """
    capture, start = drawn_capture("courtyard", 10, 120, 0.05, 14)
    found = estimate_rig(capture.frames, capture.visible, start)
    assert found.determined, found.explanation
    assert "windows" in found.explanation
    assert capture.projection_error_px(found) < 0.17
    assert capture.focal_error(found) < 0.01
    assert capture.turn_error_deg(found) < 0.75
    assert capture.turn_error_deg(found) < 2.0 * found.turn_error_deg
    errors = np.array([found.standard_errors[name] for name in PARAMETERS])
    true_changes = changes_between(start, capture.thermal, capture.visible_to_thermal)
    off = changes_between(start, found.thermal_camera, found.visible_to_thermal) - true_changes
    assert np.all(np.abs(off) < 3.0 * errors), dict(zip(PARAMETERS, off / errors))
    drift = estimate_drift(sample_shared_points(capture.frames, found.thermal_camera, found.visible_to_thermal))
    assert drift.used, drift.explanation
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1
