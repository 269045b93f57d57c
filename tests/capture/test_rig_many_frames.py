"""Rig and drift of a synthetic capture of as many frames as people take: nothing was measured, yet the turn is sure.

Six frames leave the turn unsure by half a degree (`test_rig_without_ruler`), thirty-six less: they show the same walls
at other places of the image. Up to half a thermal pixel of the principal point stays unknown, so thermal images 80
pixels wide leave some 0.4 degrees (`tests/benchmarks/rig_accuracy.py`).
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.capture.known_rig import drawn_capture
from thermoxels_ns.capture.drift import estimate_drift
from thermoxels_ns.capture.rig import estimate_rig

FRAMES = 36


@pytest.mark.parametrize(
    ("scene", "ratio", "thermal_width", "baseline_m", "seed"),
    [("courtyard", 8, 120, 0.05, 72)],
)
def test_turn_focal_length_and_offsets_are_known(
    scene: str, ratio: int, thermal_width: int, baseline_m: float, seed: int
) -> None:
    capture, start = drawn_capture(scene, ratio, thermal_width, baseline_m, seed, FRAMES)
    found = estimate_rig(capture.frames, capture.visible, start)
    assert found.determined, found.explanation
    assert capture.turn_error_deg(found) < 0.2
    assert capture.focal_error(found) < 0.01
    assert capture.projection_error_px(found) < 0.17
    drift = estimate_drift(capture.frames, found.thermal_camera, found.visible_to_thermal)
    assert drift.used, drift.explanation
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1
