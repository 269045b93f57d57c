"""Build the page of a capture, by which a person judges poses, rig and temperatures."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.frames import measurement_rows
from thermoxels_ns.capture.rig.images import read_photograph
from thermoxels_ns.capture.rig.start import rig_frames
from thermoxels_ns.capture.rig_types import RigEstimate, RigFrame
from thermoxels_ns.capture.sfm.poses import scene_names
from thermoxels_ns.capture.sfm.sfm_model import SparseDepth
from thermoxels_ns.capture.stages import CaptureResult
from thermoxels_ns.core.arrays import Float32Array, FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import printable
from thermoxels_ns.radiometry.thermal_pixels import MIN_FRAMES
from thermoxels_ns.reports.page import PERCENTILES, build_page, colours, image_file, write_page

_DEPTH_STEP = 4  # Spacing of the pixels at which depth is looked up, [pixels]; depth is interpolated in between
_COLOUR_SHARE = 0.55  # Opacity of the thermal colours over the photograph
_SHOWN = 6  # Number of frames with an overlay
_SAMPLED_PIXELS = 4000  # About the number of pixels of each thermal image whose temperatures are counted

Overlay = tuple[str, bytes, bytes, str]
"""Name of a frame; JPEG files of the overlay with the rig that was found and of the thermal image alone; and a caption
on the colours of the thermal image."""


def write_capture_page(result: CaptureResult) -> None:
    """Draw the overlays of a capture and write its page; an interrupted write leaves no broken file."""
    scene, names = result.scene, scene_names(len(result.scene.frames))
    paired = rig_frames(scene.model, scene.frames)
    overlays: list[Overlay] = []
    for index in np.unique(np.linspace(0, len(paired) - 1, min(_SHOWN, len(paired))).round().astype(int)).tolist():
        temperature_c = scene.drift.corrected(index, np.load(scene.frames[index].thermal))
        found = image_file(overlay(paired[index], temperature_c, scene.model.camera, scene.rig))
        known = temperature_c[np.isfinite(temperature_c)]
        low, high = (float(each) for each in np.percentile(known, PERCENTILES)) if known.size else (0.0, 1.0)
        alone = image_file(colours(temperature_c, (low, high)))
        title = f"{names[index]}: {scene.frames[index].name}"
        ends = f": {low:.1f} °C and less are black, {high:.1f} °C and more are bright yellow" if known.size else ""
        overlays.append((title, found, alone, f"thermal image{ends}"))
    samples, masked, pixels = [], 0, 0
    for index, frame in enumerate(scene.frames):
        temperature_c = scene.drift.corrected(index, np.load(frame.thermal)).ravel()
        samples.append(temperature_c[:: max(1, len(temperature_c) // _SAMPLED_PIXELS)])
        masked, pixels = masked + np.count_nonzero(np.isnan(temperature_c)), pixels + len(temperature_c)
    write_page(result.page, capture_page(result, overlays, np.concatenate(samples), masked / max(pixels, 1)))


def thermal_in_photograph(
    frame: RigFrame, temperature_c: npt.NDArray, visible: Camera, rig: RigEstimate, width: int = 640
) -> Float32Array:
    """Return a thermal image, [degrees Celsius], warped to a reduced photograph, (height, `width`); NaN beyond it.

    `visible` is the camera of the full photograph. Depths are interpolated between the scene points that `frame` sees.
    """
    height = max(1, round(visible.height * width / visible.width))
    rays = _grid_rays(visible, width, height)
    coarse = (max(2, width // _DEPTH_STEP), max(2, height // _DEPTH_STEP))
    depth, _ = SparseDepth(frame.points).at(_grid_rays(visible, *coarse))
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=np.isfinite(depth)).reshape(coarse[::-1])
    parallax = cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR).ravel()
    rotation, shift = rig.visible_to_thermal[:3, :3], rig.visible_to_thermal[:3, 3]
    local = rays @ rotation.T + parallax[:, None] * shift  # points divided by depth, which project to the same pixel
    pixels = rig.thermal_camera.project(local).reshape(height, width, 2).astype(np.float32) - np.float32(0.5)
    return cv2.remap(
        temperature_c.astype(np.float32),
        np.nan_to_num(pixels[..., 0], nan=-1e6),
        np.nan_to_num(pixels[..., 1], nan=-1e6),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),  # type: ignore[arg-type]
    )


def _grid_rays(camera: Camera, width: int, height: int) -> FloatArray:
    """Return rays of depth 1 through the pixels of a reduced photograph, row by row, shape (width * height, 3)."""
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    return camera.resized(width, height).rays(grid)


def overlay(frame: RigFrame, temperature_c: npt.NDArray, visible: Camera, rig: RigEstimate) -> npt.NDArray:
    """Return a thermal image in colours over its photograph in grey, with white edges, shape (height, width, 3)."""
    carried = thermal_in_photograph(frame, temperature_c, visible, rig)
    height, width = carried.shape
    photograph = read_photograph(frame).astype(np.uint8)
    grey = np.asarray(cv2.resize(photograph, (width, height), interpolation=cv2.INTER_AREA))
    base = np.repeat(grey[..., None], 3, axis=2).astype(np.float32)
    known = np.isfinite(carried)
    mixed = np.where(known[..., None], (1 - _COLOUR_SHARE) * base + _COLOUR_SHARE * colours(carried), base)
    edges = cv2.Canny(cv2.GaussianBlur(grey, (0, 0), 1.5), 40, 100) > 0
    mixed[edges & known] = 255.0
    return np.clip(mixed, 0, 255).astype(np.uint8)


def capture_page(
    result: CaptureResult, overlays: Sequence[Overlay], temperatures_c: Float32Array, masked_share: float
) -> str:
    """Return the html text of a capture's page; equal arguments give equal text.

    `temperatures_c` is a sample of corrected temperatures; `masked_share` is the share of masked thermal pixels.
    """
    scene, rig = result.scene, result.scene.rig
    errors, known_c = np.concatenate(scene.model.errors_px), temperatures_c[np.isfinite(temperatures_c)]
    off = {**rig.standard_errors, "focal": rig.standard_errors["log_focal"] * rig.thermal_camera.fl_x}
    named = zip(scene_names(len(scene.frames)), scene.model.frames, scene.model.errors_px)
    frames = [(name, frame, len(own), f"{np.median(own):.2f}" if len(own) else "-") for name, frame, own in named]
    return build_page(
        "capture.html.j2",
        name=printable(result.source.resolve().name),
        result=result,
        overlays=overlays,
        cameras=[(scene.model.camera, {}), (result.start.thermal_camera, {}), (rig.thermal_camera, off)],
        with_error=with_error,
        angle_deg=lambda camera: 2.0 * math.degrees(math.atan(camera.width / (2.0 * camera.fl_x))),
        turn=with_error(rig.turn_deg, rig.turn_error_deg, 2),
        shift=float(np.linalg.norm(rig.visible_to_thermal[:3, 3])),
        errors=errors,
        median_error=np.median(errors) if errors.size else math.nan,
        frames=frames,
        up_words=", ".join(f"{value:.3f}" for value in np.round(scene.up.direction, 3) + 0.0),
        quantiles_c=np.quantile(known_c, (0.0, 0.001, 0.5, 0.999, 1.0)).tolist() if known_c.size else [],
        measurement=measurement_rows(scene.frames),
        masked_share=masked_share,
        min_frames=MIN_FRAMES,
    )


def with_error(value: float, error: float, decimals: int) -> str:
    """Return a number as text, with its standard error if the error is finite and above 0.

    >>> with_error(70.04, 0.26, 1), with_error(1.0, float("nan"), 2), with_error(1.0, 0.0, 2)
    ('70.0 ± 0.3', '1.00', '1.00')
    """
    plus = f" ± {error:.{decimals}f}" if np.isfinite(error) and error > 0.0 else ""
    return f"{value:.{decimals}f}{plus}"
