"""The page of a capture, by which a person judges what was found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.folder_scan import shown_name
from thermoxels_ns.capture.frames import measurement_rows
from thermoxels_ns.capture.rig.start import rig_frames
from thermoxels_ns.capture.scene_writer import scene_names
from thermoxels_ns.capture.stages import CaptureResult
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.radiometry.thermal_pixels import MIN_FRAMES
from thermoxels_ns.reports.capture_pictures import colours, jpeg_of, overlay
from thermoxels_ns.reports.charts import bars, histogram
from thermoxels_ns.reports.page import build_page, write_page

_PERCENTILES = (2.0, 98.0)  # Of a thermal image's temperatures, for its darkest and brightest colours
_SHOWN = 6
_SAMPLED_PIXELS = 4000  # Of every thermal image, for the histogram

Overlay = tuple[str, bytes, bytes, bytes, str]
"""A frame's name, its thermal colours over its photograph with the rig's start value and as found, the thermal image
alone, and what the ends of its colours stand for."""


def write_capture_page(result: CaptureResult) -> None:
    """Draw the overlays and write the page of a capture, whole or not at all."""
    scene, names = result.scene, scene_names(len(result.scene.frames))
    paired = rig_frames(scene.model, scene.frames)
    overlays: list[Overlay] = []
    for index in np.unique(np.linspace(0, len(paired) - 1, min(_SHOWN, len(paired))).round().astype(int)).tolist():
        temperature_c = scene.drift.corrected(index, np.load(scene.frames[index].thermal))
        start, found = (
            jpeg_of(overlay(paired[index], temperature_c, scene.model.camera, rig)) for rig in (result.start, scene.rig)
        )
        known = temperature_c[np.isfinite(temperature_c)]
        low, high = (float(each) for each in np.percentile(known, _PERCENTILES)) if known.size else (0.0, 1.0)
        alone = jpeg_of(colours(temperature_c, (low, high)).astype(np.uint8))
        title = f"{names[index]}: {scene.frames[index].photograph_source}"
        ends = f": {low:.1f} °C and less are black, {high:.1f} °C and more are bright yellow" if known.size else ""
        overlays.append((title, start, found, alone, f"thermal image{ends}"))
    samples, masked, pixels = [], 0, 0
    for index, frame in enumerate(scene.frames):
        temperature_c = scene.drift.corrected(index, np.load(frame.thermal)).ravel()
        samples.append(temperature_c[:: max(1, len(temperature_c) // _SAMPLED_PIXELS)])
        masked, pixels = masked + frame.masked, pixels + len(temperature_c)
    write_page(result.page, capture_page(result, overlays, np.concatenate(samples), masked / max(pixels, 1)))


def capture_page(
    result: CaptureResult, overlays: Sequence[Overlay], temperatures_c: npt.NDArray[np.float32], masked_share: float
) -> str:
    """Build the html text from its arguments alone.

    Temperatures are a sample of all, corrected, and the share is that of all thermal pixels without one.
    """
    scene, rig, drift = result.scene, result.scene.rig, result.scene.drift
    errors, known_c = scene.model.sighting_error_px(), temperatures_c[np.isfinite(temperatures_c)]
    limit = max(float(np.percentile(errors, 99)), 0.1) if errors.size else 0.1
    low, high = (float(end) for end in np.percentile(known_c, (0.1, 99.9))) if known_c.size else (0.0, 1.0)
    label = "temperature, °C; how many pixels of a sample, without the coldest and hottest 0.1 %"
    frames = []
    for index, (name, frame) in enumerate(zip(scene_names(len(scene.frames)), scene.model.frames)):
        own = errors[scene.model.sighting_frame == index] if errors.size else errors
        frames.append((name, frame, len(own), f"{np.median(own):.2f}" if len(own) else "-"))
    return build_page(
        "capture.html.j2",
        name=shown_name(result.source.resolve()),
        result=result,
        overlays=overlays,
        cameras=_cameras(result),
        turn=with_error(rig.turn_deg, rig.turn_error_deg, 2),
        shift=float(np.linalg.norm(rig.visible_to_thermal[:3, 3])),
        errors=errors,
        median_error=np.median(errors) if errors.size else math.nan,
        error_chart=histogram(errors, "reprojection error, pixels of the photographs", limits=(0.0, limit)),
        frames=frames,
        up_words=", ".join(f"{value:.3f}" for value in np.round(scene.up.direction, 3) + 0.0),
        temperatures_c=known_c,
        median_c=np.median(known_c) if known_c.size else math.nan,
        temperature_chart=histogram(known_c, label, limits=(low, high)),
        measurement=measurement_rows(scene.frames),
        masked_share=masked_share,
        min_frames=MIN_FRAMES,
        drift_chart=bars(drift.offsets_k.tolist(), "frame; how much it reads too high, K") if drift.used else "",
    )


def _cameras(result: CaptureResult) -> list[tuple[str, ...]]:
    """Photographs' camera, and the thermal camera at the start and as found: rows of what describes them."""
    rig = result.scene.rig
    sure: Mapping[str, float] = {}
    found = dict(rig.standard_errors)
    found["focal"] = found.get("log_focal", math.nan) * rig.thermal_camera.fl_x
    columns: list[tuple[Camera, Mapping[str, float]]] = [
        *((result.scene.model.camera, sure), (result.start.thermal_camera, sure), (rig.thermal_camera, found))
    ]

    def told(value: float, errors: Mapping[str, float], name: str) -> str:
        return with_error(value, errors.get(name, math.nan), 1)

    angles = [float(2 * np.degrees(np.arctan(c.width / (2 * c.fl_x)))) for c, _ in columns]
    return [
        ("size, pixels", *(f"{c.width} x {c.height}" for c, _ in columns)),
        ("focal length, pixels", *(told(c.fl_x, errors, "focal") for c, errors in columns)),
        ("angle of view, degrees", *(f"{angle:.1f}" for angle in angles)),
        (
            "principal point, pixels",
            *(f"{told(c.cx, errors, 'cx')}, {told(c.cy, errors, 'cy')}" for c, errors in columns),
        ),
        ("distortion k1, k2", *(f"{c.k1:.4f}, {c.k2:.4f}" for c, _ in columns)),
    ]


def with_error(value: float, error: float, decimals: int) -> str:
    """Write a number with its standard error, where it has one.

    >>> with_error(70.04, 0.26, 1), with_error(1.0, float("nan"), 2), with_error(1.0, 0.0, 2)
    ('70.0 ± 0.3', '1.00', '1.00')
    """
    plus = f" ± {error:.{decimals}f}" if np.isfinite(error) and error > 0.0 else ""
    return f"{value:.{decimals}f}{plus}"
