"""Rig and drift of synthetic captures of which only the thermal angle of view is known, to 5 %: nothing was measured.

Turn, lenses' direction, angle of view, principal point, noise and drift are drawn anew for every seed. Where points
fall and the offsets are sure; turn and principal point, and for some captures focal length and shift ahead, stand for
each other, so these are held to their own standard errors.

How far that is from what could be known: were every surface known, with its temperature and what lies behind its
outline, the thermal pixels of such captures would hold the turn to 0.003 to 0.03 degrees (Cramer-Rao bound, four drawn
captures, noise and the sampling of pixels counted, principal point free or not; without the pixels next to outlines
0.006 to 0.08). Photographs do not tell the temperatures: windows of two materials hold the turn to 0.3 to 1.6 degrees.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.known_rig import changes_between, drawn_capture
from thermoxels_ns.capture.rig.drift import estimate_drift
from thermoxels_ns.capture.rig.parameters import PARAMETERS
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.rig.uncertainty import turn_errors_deg

FOCAL_KNOWN, FOCAL_UNSURE = 0.01, 0.02
LARGEST_TURN_DEG = 0.75


@pytest.mark.parametrize(
    ("scene", "ratio", "thermal_width", "baseline_m", "seed", "focal_limit"),
    [
        ("house-corner", 4, 160, 0.05, 11, FOCAL_KNOWN),
        ("house-corner", 5, 160, 0.20, 13, FOCAL_KNOWN),
        ("house-corner", 8, 120, 0.10, 15, FOCAL_UNSURE),
        ("courtyard", 10, 120, 0.05, 14, FOCAL_KNOWN),
        ("courtyard", 20, 80, 0.10, 12, FOCAL_UNSURE),
    ],
)
def test_points_and_offsets_are_sure_and_each_number_as_sure_as_stated(
    scene: str, ratio: int, thermal_width: int, baseline_m: float, seed: int, focal_limit: float
) -> None:
    capture, start = drawn_capture(scene, ratio, thermal_width, baseline_m, seed)
    found = estimate_rig(capture.frames, capture.visible, start)
    assert found.determined, found.explanation
    assert "windows" in found.explanation
    assert capture.projection_error_px(found) < 0.17
    assert capture.focal_error(found) < focal_limit
    assert capture.turn_error_deg(found) < LARGEST_TURN_DEG
    assert capture.turn_error_deg(found) < 2.0 * turn_errors_deg(found.covariance)[0]
    errors = np.array([found.standard_errors[name] for name in PARAMETERS])
    true_changes = changes_between(start, capture.thermal, capture.visible_to_thermal)
    off = changes_between(start, found.thermal_camera, found.visible_to_thermal) - true_changes
    assert np.all(np.abs(off) < 3.0 * errors), dict(zip(PARAMETERS, off / errors))
    drift = estimate_drift(capture.frames, found.thermal_camera, found.visible_to_thermal)
    assert drift.used, drift.explanation
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1
