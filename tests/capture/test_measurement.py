"""The page says how temperatures were measured, in words that an auditor can check."""

from __future__ import annotations

from pathlib import Path

import pytest

from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.measurement import conditions_text, measurement_rows
from thermoxels_ns.radiometry.conditions import Conditions


def frame(**more) -> CaptureFrame:
    return CaptureFrame("a", Path("a.jpg"), Path("a.npy"), "a.jpg", "a.tiff", **more)


def test_settings_that_all_frames_share_are_said_once():
    conditions = Conditions(emissivity=0.95, reflected_c=21.0, distance_m=4.0, air_c=19.5)
    rows = dict(measurement_rows([frame(format="FLIR R-JPEG", conditions=conditions)] * 3))
    assert rows["thermal files"] == "FLIR R-JPEG"
    assert rows["computed with"] == (
        "emissivity 0.95, reflected temperature 21 °C, 4 m of air of 50 % humidity and 19.5 °C"
    )


def test_settings_that_differ_are_counted_the_most_frequent_first():
    kinds = [Conditions(emissivity=e, reflected_c=20.0) for e in (0.9, 0.8, 0.8, 0.7, 0.6, 0.5)]
    rows = dict(measurement_rows([frame(format="TIFF", celsius_per_count=0.025, conditions=kind) for kind in kinds]))
    assert rows["thermal files"] == "TIFF with 0.025 K per count"
    said = rows["computed with"]
    assert said.startswith("emissivity 0.8, reflected temperature 20 °C (2 frames); emissivity 0.9")
    assert said.endswith("; 1 more kinds")


def test_what_no_file_says_is_not_said():
    assert measurement_rows([frame()]) == []


@pytest.mark.parametrize(
    ("conditions", "said"),
    [
        (Conditions(), "apparent temperatures"),
        (Conditions(distance_m=2.0, air_c=10.0), "emissivity 1, 2 m of air"),
        (Conditions(window_transmission=0.9, window_c=20.0), "a window that passes 90 %"),
    ],
)
def test_what_lies_between_is_said(conditions, said):
    assert said in conditions_text(conditions)
    assert ("apparent" in conditions_text(conditions)) == (conditions == Conditions())
