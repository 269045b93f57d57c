"""Rig and drift of drawn captures with noise, drift and vignetting; of a real one in `tests/integration`."""

import numpy as np
import pytest

from tests.support.known_rig import changes_between, drawn_capture
from thermoxels_ns.capture.rig.drift import estimate_drift
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.rig_types import PARAMETERS

FRAMES = 36


def test_turn_focal_length_and_offsets_are_known() -> None:
    """Nothing was measured, yet the turn is known: 36 frames show the same walls at other places of the image."""
    capture, start = drawn_capture("house-corner", 4, 160, 0.05, 51, FRAMES)  # 0.34 degrees where all count as one
    found = estimate_rig(capture.frames, capture.visible, start)
    assert found.determined, found.explanation
    assert capture.turn_error_deg(found) < 0.2
    assert capture.focal_error(found) < 0.01
    assert capture.projection_error_px(found) < 0.17
    drift = estimate_drift(capture.frames, found.thermal_camera, found.visible_to_thermal)
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1


def test_points_that_lie_together_do_not_decide_an_offset() -> None:
    capture, _ = drawn_capture("courtyard", 2, 120, 0.05, 72, FRAMES)  # 0.15 K from a thousand points of each frame
    drift = estimate_drift(capture.frames, capture.thermal, capture.visible_to_thermal)
    assert drift.used, drift.explanation
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1


@pytest.mark.parametrize(
    ("scene", "ratio", "thermal_width", "baseline_m", "seed", "focal_limit"),
    [
        ("house-corner", 4, 160, 0.05, 11, 0.01),
        ("courtyard", 10, 120, 0.05, 14, 0.01),
        ("courtyard", 20, 80, 0.10, 12, 0.02),
    ],
)
def test_points_and_offsets_are_sure_and_each_number_as_sure_as_stated(
    scene: str, ratio: int, thermal_width: int, baseline_m: float, seed: int, focal_limit: float
) -> None:
    """Only the thermal angle of view is known, to 5 %; turn, lenses, noise and drift are drawn anew for every seed.

    Turn and principal point, and for some captures focal length and shift ahead, can be exchanged for each other, so
    these are held to their own standard errors.
    """
    capture, start = drawn_capture(scene, ratio, thermal_width, baseline_m, seed)
    found = estimate_rig(capture.frames, capture.visible, start)
    assert found.determined, found.explanation
    assert "windows" in found.explanation
    assert capture.projection_error_px(found) < 0.17
    assert capture.focal_error(found) < focal_limit
    assert capture.turn_error_deg(found) < 0.75
    assert capture.turn_error_deg(found) < 2.0 * found.turn_error_deg
    errors = np.array([found.standard_errors[name] for name in PARAMETERS])
    true_changes = changes_between(start, capture.thermal, capture.visible_to_thermal)
    off = changes_between(start, found.thermal_camera, found.visible_to_thermal) - true_changes
    assert np.all(np.abs(off) < 3.0 * errors), dict(zip(PARAMETERS, off / errors))
    drift = estimate_drift(capture.frames, found.thermal_camera, found.visible_to_thermal)
    assert drift.used, drift.explanation
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1
