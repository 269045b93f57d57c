"""Rig and drift of synthetic captures of as many frames as people take: nothing was measured, yet both are known.

Six frames leave the turn unsure by half a degree (`test_rig_without_ruler`), thirty-six less: they show the same walls
at other places of the image. Up to half a thermal pixel of the principal point stays unknown, so thermal images 80
pixels wide leave some 0.4 degrees (`tests/benchmarks/rig_accuracy.py`).
"""

from __future__ import annotations

import numpy as np

from tests.support.known_rig import drawn_capture
from thermoxels_ns.capture.rig.drift import estimate_drift
from thermoxels_ns.capture.rig.search import estimate_rig

FRAMES = 36


def test_turn_focal_length_and_offsets_are_known() -> None:
    capture, start = drawn_capture("house-corner", 4, 160, 0.05, 51, FRAMES)  # 0.34 degrees where all count as one
    found = estimate_rig(capture.frames, capture.visible, start)
    assert found.determined, found.explanation
    assert capture.turn_error_deg(found) < 0.2
    assert capture.focal_error(found) < 0.01
    assert capture.projection_error_px(found) < 0.17
    drift = estimate_drift(capture.frames, found.thermal_camera, found.visible_to_thermal)
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1


def test_points_that_lie_together_do_not_decide_an_offset() -> None:
    capture, _ = drawn_capture("courtyard", 8, 120, 0.05, 72, FRAMES)  # 0.19 K from a thousand points of each frame
    drift = estimate_drift(capture.frames, capture.thermal, capture.visible_to_thermal)
    assert drift.used, drift.explanation
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1
