import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.posed_model import ring_model
from thermoxels_ns.capture.frames import CaptureFrame, CaptureFrames
from thermoxels_ns.capture.masks import PhotographMasks
from thermoxels_ns.capture.pairs import Pair
from thermoxels_ns.capture.rig_types import PARAMETERS, DriftEstimate, RigEstimate, RigFrame
from thermoxels_ns.capture.scene_writer import Scene
from thermoxels_ns.capture.sfm.scale_and_up import MetricScale, Up
from thermoxels_ns.capture.stages import CaptureResult
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.radiometry.measurement_model import Conditions
from thermoxels_ns.reports.capture_page import Overlay, capture_page, thermal_in_photograph
from thermoxels_ns.reports.charts import colours

THERMAL = Camera(80, 60, 70.0, 70.0, 41.0, 29.0)


def test_a_point_of_the_thermal_image_lands_where_the_scene_has_it():
    """A warm spot at the projection of a scene point appears at that point in the photograph."""
    model = ring_model(3)
    seen, pixels = model.seen_by(1)
    frame = RigFrame("f1", np.zeros((480, 640)), np.zeros((60, 80)), model.camera_to_world[1], model.points[seen], seen)
    rig = np.eye(4)
    rig[:3, 3] = (0.3, -0.1, 0.05)
    estimate = RigEstimate(THERMAL, rig, True, "")
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


MODEL = ring_model(4)
JPEG = b"\xff\xd8\xff"
OVERLAY: Overlay = ("a", JPEG, JPEG, JPEG, "thermal image")


@pytest.fixture
def result() -> CaptureResult:
    rig = RigEstimate(
        *(Camera(80, 60, 70.0, 70.0, 41.0, 29.0), np.eye(4), True, "Found.", ("rx",), np.eye(1), 0.1, 0.4, 0.33)
    )
    conditions = Conditions(emissivity=0.95, reflected_c=20.0)
    frames = [
        CaptureFrame(name, Path(f"{name}.jpg"), Path(f"{name}.npy"), f"{name}.jpg", f"{name}.tiff", format="TIFF")
        for name in MODEL.frames
    ]
    scene = Scene(
        frames=[replace(frame, conditions=conditions) for frame in frames],
        model=MODEL,
        rig=rig,
        drift=DriftEstimate(np.array([0.5, -0.5, 0.1, -0.1]), (), 1.553, 0.111, True, "Corrected."),
        scale=None,
        up=Up(np.array([-1e-9, -1e-12, 1.0]), "Assumed.", None),
        masks=PhotographMasks((640, 480)),
    )
    return CaptureResult(
        source=Path("card"),
        output=Path("scene"),
        pairs=[Pair(name, Path(f"{name}.jpg"), Path(f"{name}.tiff"), "equal names") for name in MODEL.frames],
        dropped={},
        read=CaptureFrames(tuple(frames), (80, 60), dead_pixels=0),
        scene=scene,
        start=rig,
        scale_missing="no photograph has a GPS position",
        poses_source="Given.",
        seconds=[("pairs", 1.0)],
    )


def with_scene(result: CaptureResult, **changes: Any) -> CaptureResult:
    return replace(result, scene=replace(result.scene, **changes))


def page_of(result: CaptureResult, overlay: Overlay = OVERLAY) -> str:
    return capture_page(result, [overlay], np.linspace(10, 20, 100, dtype=np.float32), 0.0)


def words(result: CaptureResult) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page_of(result)))


def test_numbers_of_the_rig_have_their_errors(result):
    errors = {"rx": 0.003, "ry": 0.004, "rz": 0.012, "log_focal": 0.01, "cx": 0.42, "cy": 0.57}
    covariance = np.diag([errors.get(name, 0.0) ** 2 for name in PARAMETERS])
    rig = replace(result.scene.rig, parameters=PARAMETERS, covariance=covariance)
    said = words(with_scene(result, rig=rig))
    assert "principal point, pixels 320.0, 240.0 41.0, 29.0 41.0 ± 0.4, 29.0 ± 0.6 " in said
    assert "focal length, pixels 500.0 70.0 70.0 ± 0.7 " in said
    assert "turned by 0.00 ± 0.74 degrees" in said
    given = words(with_scene(result, rig=replace(rig, parameters=(), covariance=np.zeros((0, 0)))))
    assert "41.0, 29.0 41.0, 29.0 " in given


def test_a_scale_that_is_missing_says_what_it_costs(result):
    said = words(result)
    assert "unknown (no photograph has a GPS position); give a length when you export the mesh" in said
    known = words(with_scene(result, scale=MetricScale(0.5, 0.01, "GPS.")))
    assert "0.5 ± 0.01 (2.0 %) m per unit" in known and "unknown" not in known


def test_names_of_files_are_no_markup(result):
    evil = "<script>alert(1)</script>"
    frames = [replace(frame, camera=evil) for frame in result.scene.frames]
    pairs = [Pair("a", Path(f"{evil}.jpg"), Path("a.tiff"), evil)]
    changed = with_scene(result, frames=frames)
    changed = replace(changed, source=Path(evil), dropped={evil: evil}, pairs=pairs, scale_missing=evil)
    text = page_of(changed, (evil, JPEG, JPEG, JPEG, evil))
    assert "<script" not in text
    assert text.count("&lt;script&gt;") >= 8
