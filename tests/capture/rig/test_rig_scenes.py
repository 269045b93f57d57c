"""Whole captures: rig and drift of synthetic scenes with noise, drift and vignetting, and of a real room corner."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.support.known_rig import known_capture, projection_difference_px
from thermoxels_ns.capture.rig.drift import estimate_drift
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.stage_types import CameraModel, RigFrame, RigStart


@pytest.mark.parametrize(
    ("scene", "photograph_width", "thermal_width", "baseline_m"),
    [
        ("house-corner", 800, 200, (0.15, 0.03, 0.02)),  # 4 times the resolution
        ("house-corner", 1600, 80, (0.19, -0.02, 0.01)),  # 20 times
        ("courtyard", 640, 160, (0.05, 0.02, 0.0)),
    ],
)
def test_rig_and_drift_of_a_noisy_drifting_vignetting_camera(
    scene: str, photograph_width: int, thermal_width: int, baseline_m: tuple[float, float, float]
) -> None:
    views = 6 if photograph_width > 1000 else 8
    capture = known_capture(scene, views, photograph_width, thermal_width, baseline_m)
    found = estimate_rig(capture.frames, capture.visible, capture.measured_start())
    assert found.determined, found.explanation
    assert capture.turn_error_deg(found) < 0.2
    assert capture.focal_error(found) < 0.01
    assert capture.projection_error_px(found) < 0.4
    assert found.score_after > found.score_before
    drift = estimate_drift(capture.frames, found.thermal_camera, found.visible_to_thermal)
    assert drift.used, drift.explanation
    assert np.abs(drift.offsets_k - capture.offsets_k).max() < 0.1
    assert drift.after_k < 0.5 * drift.before_k


@pytest.mark.real_data
def test_arco_agrees_with_its_given_rig_and_drift_halves(shared_data: Path) -> None:
    import pycolmap

    folder = shared_data / "arco"
    given = json.loads((folder / "transforms.json").read_text())
    model = pycolmap.Reconstruction(str(folder / "colmap"))
    images = {Path(image.name).name: image for image in model.images.values()}
    frames = []
    for entry in given["frames"][::2]:
        name = Path(entry["file_path"]).name
        ids = np.unique([point.point3D_id for point in images[name].points2D if point.has_point3D()])
        counts = np.asarray(Image.open(folder / entry["thermal_file_path"]), dtype=np.float32)
        temperature_c = cv2.resize(counts, (320, 256), interpolation=cv2.INTER_AREA) * 0.025 - 100.0
        photograph = cv2.imread(str(folder / entry["file_path"]), cv2.IMREAD_REDUCED_GRAYSCALE_2)
        world = np.array([model.points3D[number].xyz for number in ids])
        pose = np.array(entry["transform_matrix"])
        frames.append(RigFrame(name, photograph, temperature_c, pose, world, ids.astype(np.int64)))

    def camera(entry: dict[str, float]) -> CameraModel:
        keys = ("fl_x", "fl_y", "cx", "cy", "k1")
        return CameraModel(int(entry["w"]), int(entry["h"]), **{key: entry[key] for key in keys})

    thermal, rig = camera(given["thermal_camera"]), np.array(given["rig"])
    start = RigStart(CameraModel.from_field_of_view(320, 256, 47.0))
    found = estimate_rig(frames, camera(given), start)
    assert found.determined, found.explanation
    half = thermal.resized(320, 256)
    # 3 pixels of the full image
    apart = projection_difference_px(frames, (half, rig), (found.thermal_camera, found.visible_to_thermal))
    assert apart < 1.5
    assert 2.0 * found.thermal_camera.fl_x == pytest.approx(thermal.fl_x, rel=0.02)
    drift = estimate_drift(frames, found.thermal_camera, found.visible_to_thermal)
    assert drift.used
    assert drift.after_k < 0.25 * drift.before_k, drift.explanation
