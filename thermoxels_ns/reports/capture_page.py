"""What a capture found, as sections of capture.html."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.folder_scan import shown_name
from thermoxels_ns.capture.frames import measurement_rows
from thermoxels_ns.capture.rig_types import DriftEstimate, with_error
from thermoxels_ns.capture.scene_writer import Scene, scene_names
from thermoxels_ns.capture.stages import CaptureResult
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.radiometry.dead_pixels import MIN_FRAMES
from thermoxels_ns.reports.charts import bars, histogram
from thermoxels_ns.reports.page import Gallery, Page, Picture, Section, Table
from thermoxels_ns.reports.page import build_page as build_html

_PERCENTILES = (0.1, 99.9)
_TOO_FEW = f"not looked for in fewer than {MIN_FRAMES} frames"


@dataclass(frozen=True)
class Overlay:
    """One frame for a person to judge: thermal colours over the photograph with the rig's start value and as found."""

    name: str
    start: bytes
    found: bytes
    thermal: bytes
    colours: str = "thermal image"  # what the last one is, and what its darkest and its brightest colour stand for


@dataclass(frozen=True)
class CapturePage:
    """What the page shows; temperatures are a sample of all, corrected, and the share is that of all thermal pixels."""

    result: CaptureResult
    overlays: Sequence[Overlay]
    temperatures_c: npt.NDArray[np.float32]
    masked_share: float

    @property
    def scene(self) -> Scene:
        """What was written."""
        return self.result.scene


def build_page(page: CapturePage) -> str:
    """Build the html text; it depends on `page` alone."""
    sections = (
        _overlays(page),
        _dropped(page.result.dropped),
        _cameras(page),
        _poses(page),
        Section("Scale and up", tables=(_rows(_scale(page)),)),
        _temperatures(page),
        _drift(page),
        _pairs(page),
        Section("Time", tables=(_rows([(name, f"{took:.1f} s") for name, took in page.result.seconds]),)),
    )
    title = f"Capture of {shown_name(page.result.source.resolve())}"
    return build_html(Page(title, "", (Section("In short", tables=(_rows(_summary(page)),)), *sections)))


def _summary(page: CapturePage) -> list[tuple[str, str]]:
    registered, pairs = len(page.scene.model.frames), len(page.result.pairs)
    error, rig = page.scene.model.sighting_error_px(), page.scene.rig
    if not rig.determined:
        rig_text = "not determined: the start value is kept, look at the pictures below before you trust it"
    elif not np.isfinite(rig.projection_sigma_px):
        rig_text = "known"
    else:
        rig_text = f"found from the images, a point's place is known to {rig.projection_sigma_px:.2f} thermal pixels"
    rows = [
        ("Pairs found", str(pairs)),
        ("Frames in the scene", f"{registered} of {pairs}"),
        ("Rig", rig_text),
        ("Drift and vignetting", _drift_text(page.scene.drift)),
        ("Scale", _scale_text(page)),
    ]
    if len(error):
        rows.insert(2, ("Median reprojection error", f"{np.median(error):.2f} pixels"))
    return rows


def _drift_text(drift: DriftEstimate) -> str:
    if not (np.isfinite(drift.before_k) and np.isfinite(drift.after_k)):
        return "corrected" if drift.used else "not corrected"
    before = f"two frames of one point differ by {drift.before_k:.2f} K"
    return f"corrected: {before} before, {drift.after_k:.2f} K after" if drift.used else f"not corrected: {before}"


def _scale_text(page: CapturePage) -> str:
    scale = page.scene.scale
    if scale is None:
        why = page.result.scale_missing
        return f"unknown ({why}); give a length when you export the mesh, or areas and watts are missing"
    error = scale.standard_error
    plus = "" if error is None else f" ± {error:.2g} ({100 * error / scale.metres_per_unit:.1f} %)"
    return f"{scale.metres_per_unit:.5g}{plus} m per unit"


def _overlays(page: CapturePage) -> Section:
    heading = "Judge for yourself: thermal colours over the photographs"
    if not page.overlays:
        return Section(heading, words=("No frame has both a pose and a thermal image.",))
    words = "White lines are the photograph's edges. Warm and cold shapes should lie on them. "
    words += (
        "Left: where the search for the rig began. Middle: where it ended."
        if page.scene.rig.determined
        else f"The rig was not determined: {page.scene.rig.explanation}"
    )
    galleries = tuple(
        Gallery(
            (
                Picture(one.start, "start value"),
                Picture(one.found, "as written"),
                Picture(one.thermal, one.colours),
            ),
            columns=3,
            heading=one.name,
        )
        for one in page.overlays
    )
    return Section(heading, words=(words,), galleries=galleries)


def _dropped(dropped: Mapping[str, str]) -> Section:
    heading = f"Left out ({len(dropped)})"
    if not dropped:
        return Section(heading, words=("Nothing: every file is in a pair and every pair has a pose.",))
    return Section(heading, tables=(Table(("file or frame", "why"), tuple(dropped.items()), figures_from=2),))


def _cameras(page: CapturePage) -> Section:
    rig, scale = page.scene.rig, page.scene.scale
    found = rig.standard_errors
    focal_error = found.get("log_focal", math.nan) * rig.thermal_camera.fl_x
    errors = {"focal": focal_error, **{name: found[name] for name in ("cx", "cy") if name in found}}
    columns = (
        ("photographs", page.scene.model.camera, {}),
        ("thermal, start value", page.result.start.thermal_camera, {}),
        ("thermal, as written", rig.thermal_camera, errors),
    )
    angles = (float(2 * np.degrees(np.arctan(c.width / (2 * c.fl_x)))) for _, c, _ in columns)
    focal = (with_error(camera.fl_x, own.get("focal", math.nan), 1) for _, camera, own in columns)
    rows = (
        ("size, pixels", *(f"{camera.width} x {camera.height}" for _, camera, _ in columns)),
        ("focal length, pixels", *focal),
        ("angle of view, degrees", *(f"{angle:.1f}" for angle in angles)),
        ("principal point, pixels", *(_principal_point(camera, own) for _, camera, own in columns)),
        ("distortion k1, k2", *(f"{camera.k1:.4f}, {camera.k2:.4f}" for _, camera, _ in columns)),
    )
    cameras = Table(("", *(name for name, _, _ in columns)), rows, look="cameras")
    turn = with_error(rig.turn_deg, rig.turn_error_deg, 2)
    shift = float(np.linalg.norm(rig.visible_to_thermal[:3, 3]))
    metres = f" = {100 * shift * scale.metres_per_unit:.1f} cm" if scale is not None else ""
    names = sorted({frame.camera for frame in page.scene.frames if frame.camera})
    extra = [
        ("camera", ", ".join(names) or "the files do not say"),
        ("between the two lenses", f"turned by {turn} degrees, {shift:.4g} units{metres} apart"),
        ("how the rig was found", rig.explanation),
    ]
    if np.isfinite(rig.score_after):
        extra.append(("agreement of edges", f"{rig.score_before:.3f} before, {rig.score_after:.3f} after"))
    if np.isfinite(rig.projection_sigma_px):
        extra.append(("standard error of a point's place", f"{rig.projection_sigma_px:.2f} thermal pixels"))
    return Section("Cameras", tables=(cameras, _rows(extra)))


def _principal_point(camera: Camera, errors: Mapping[str, float]) -> str:
    return ", ".join(
        with_error(value, errors.get(name, math.nan), 1) for name, value in (("cx", camera.cx), ("cy", camera.cy))
    )


def _poses(page: CapturePage) -> Section:
    error = page.scene.model.sighting_error_px()
    if not len(error):
        return Section("Poses", words=(page.result.poses_source,))
    limit = float(np.percentile(error, 99))
    names, rows = scene_names(len(page.scene.frames)), []
    for index, name in enumerate(page.scene.model.frames):
        own = error[page.scene.model.sighting_frame == index]
        median = f"{np.median(own):.2f}" if len(own) else "-"
        rows.append((names[index], name, str(len(own)), median))
    head = ("in the scene", "frame", "points", "median error, pixels")
    figures = [
        ("source", page.result.poses_source),
        ("points", f"{len(page.scene.model.points)}"),
        ("mean and median error", f"{error.mean():.2f} and {np.median(error):.2f} pixels"),
    ]
    return Section(
        "Poses",
        svg=histogram(error, "reprojection error, pixels of the photographs", limits=(0.0, max(limit, 0.1))),
        tables=(_rows(figures), Table(head, tuple(rows), figures_from=2, summary="Frame by frame")),
    )


def _scale(page: CapturePage) -> list[tuple[str, str]]:
    up = page.scene.up
    rows = [("scale", _scale_text(page))]
    if page.scene.scale is not None:
        rows.append(("from", page.scene.scale.source))
    spread = "" if up.spread_deg is None else f" Single photographs differ by {up.spread_deg:.1f} degrees."
    direction = ", ".join(f"{value + 0.0:.3f}" for value in np.round(up.direction, 3))
    return [*rows, ("up, as x, y, z", f"{direction}. {up.source}{spread}")]


def _temperatures(page: CapturePage) -> Section:
    values = page.temperatures_c[np.isfinite(page.temperatures_c)]
    if not values.size:
        return Section("Temperatures", words=("No thermal pixel has a temperature.",))
    low, high = (float(value) for value in np.percentile(values, _PERCENTILES))
    rows = [
        *measurement_rows(page.scene.frames),
        ("lowest, median, highest", f"{values.min():.1f}, {np.median(values):.1f}, {values.max():.1f} °C"),
        ("pixels without a temperature", f"{100 * page.masked_share:.2f} %"),
        (
            "stuck pixels of the sensor",
            str(page.result.read.dead_pixels) if len(page.scene.frames) >= MIN_FRAMES else _TOO_FEW,
        ),
    ]
    drawn = page.scene.masks.overlay
    if drawn is not None:
        rows.append(("photographs masked", f"{100 * (1.0 - float(drawn.mean())):.1f} %"))
    label = "temperature, °C; how many pixels of a sample, without the coldest and hottest 0.1 %"
    return Section("Temperatures", svg=histogram(values, label, limits=(low, high)), tables=(_rows(rows),))


def _drift(page: CapturePage) -> Section:
    drift = page.scene.drift
    rows = [("result", drift.explanation)]
    if np.isfinite(drift.before_k):
        rows.append(("two frames at the same point, before", f"{drift.before_k:.3f} K"))
    if np.isfinite(drift.after_k):
        rows.append(("after, at points it was not fitted to", f"{drift.after_k:.3f} K"))
    chart = bars(drift.offsets_k.tolist(), "frame; how much it reads too high, K") if drift.used else ""
    return Section("Drift", svg=chart, tables=(_rows(rows),))


def _pairs(page: CapturePage) -> Section:
    rows = tuple((pair.name, pair.photograph.name, pair.thermal.name, pair.how) for pair in page.result.pairs)
    head = ("frame", "photograph", "thermal", "how")
    return Section(f"Pairs ({len(rows)})", tables=(Table(head, rows, figures_from=4, summary="All pairs"),))


def _rows(rows: Sequence[tuple[str, str]]) -> Table:
    return Table(("", ""), tuple(rows), figures_from=2, look="rows")
