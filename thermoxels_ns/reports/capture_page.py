"""capture.html: what the capture found, on one page that fetches nothing and runs no script."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.measurement import measurement_rows
from thermoxels_ns.capture.pairs import Pair
from thermoxels_ns.capture.rig.summary import turn_deg, turn_error_deg, why_turn_is_unsure, with_error
from thermoxels_ns.capture.sfm.gravity import Up
from thermoxels_ns.capture.sfm.metric_scale import MetricScale
from thermoxels_ns.capture.sfm.model import SfmModel
from thermoxels_ns.capture.stage_types import CameraModel, DriftEstimate, RigEstimate
from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.radiometry.dead_pixels import MIN_FRAMES
from thermoxels_ns.reports.page_style import html_page, scrolling
from thermoxels_ns.reports.svg_charts import bars, histogram

_PERCENTILES = (0.1, 99.9)
_TOO_FEW = f"not looked for in fewer than {MIN_FRAMES} frames"


@dataclass(frozen=True)
class Overlay:
    """One frame for a person to judge."""

    name: str
    start_url: str
    """Thermal colours over the photograph with the rig's start value."""
    found_url: str
    """The same with the rig that was found."""
    thermal_url: str
    """The thermal image alone."""
    shown_c: tuple[float, float] | None = None
    """Temperatures of its darkest and its brightest colour, [degrees C]; None: it has none."""


@dataclass(frozen=True)
class CapturePage:
    """Everything the page says."""

    title: str
    pairs: Sequence[Pair]
    dropped: Mapping[str, str]
    """Why, by the frame or file."""
    frames: Sequence[CaptureFrame]
    """In the order of the model's frames."""
    scene_names: Sequence[str]
    model: SfmModel
    rig: RigEstimate
    start: RigEstimate
    drift: DriftEstimate
    scale: MetricScale | None
    scale_missing: str
    """Why there is no scale, where there is none."""
    up: Up
    overlays: Sequence[Overlay]
    temperatures_c: npt.NDArray[np.float32]
    """A sample of all temperatures, corrected, [degrees C]."""
    masked_share: float
    """Of all thermal pixels."""
    dead_pixels: int
    poses_source: str
    overlay_share: float | None
    """Share of the photographs that is masked as drawn over; None: nothing is."""
    seconds: Sequence[tuple[str, float]]


def write_page(page: CapturePage, path: Path) -> None:
    """Write the page, whole or not at all."""
    with replace_when_done(path) as temporary:
        temporary.write_text(build_page(page), encoding="utf-8")


def build_page(page: CapturePage) -> str:
    """Build the html text; it depends on `page` alone."""
    sections = [
        ("In short", _summary(page)),
        ("Judge for yourself: thermal colours over the photographs", _overlays(page)),
        (f"Left out ({len(page.dropped)})", _dropped(page.dropped)),
        ("Cameras", _cameras(page)),
        ("Poses", _poses(page)),
        ("Scale and up", _scale(page)),
        ("Temperatures", _temperatures(page)),
        ("Drift", _drift(page)),
        (f"Pairs ({len(page.pairs)})", _pairs(page)),
        ("Time", _rows([(name, f"{took:.1f} s") for name, took in page.seconds])),
    ]
    body = "\n".join(f"<section><h2>{escape(heading)}</h2>{content}</section>" for heading, content in sections)
    return html_page(page.title, f"<h1>{escape(page.title)}</h1>\n{body}", _STYLE)


def _summary(page: CapturePage) -> str:
    registered, pairs = len(page.model.frames), len(page.pairs)
    error = page.model.sighting_error_px()
    rows = [
        ("Pairs found", str(pairs)),
        ("Frames in the scene", f"{registered} of {pairs}"),
        ("Rig", _rig_text(page.rig)),
        ("Drift and vignetting", _drift_text(page.drift)),
        ("Scale", _scale_text(page)),
    ]
    if len(error):
        rows.insert(2, ("Median reprojection error", f"{np.median(error):.2f} pixels"))
    return _rows(rows)


def _rig_text(rig: RigEstimate) -> str:
    if not rig.determined:
        return "not determined: the start value is kept, look at the pictures below before you trust it"
    if not np.isfinite(rig.projection_sigma_px):
        return "known"
    return f"found from the images, a point's place is known to {rig.projection_sigma_px:.2f} thermal pixels"


def _drift_text(drift: DriftEstimate) -> str:
    if not (np.isfinite(drift.before_k) and np.isfinite(drift.after_k)):
        return "corrected" if drift.used else "not corrected"
    before = f"two frames of one point differ by {drift.before_k:.2f} K"
    return f"corrected: {before} before, {drift.after_k:.2f} K after" if drift.used else f"not corrected: {before}"


def _scale_text(page: CapturePage) -> str:
    if page.scale is None:
        return f"unknown ({page.scale_missing}); give a length when you export the mesh, or areas and watts are missing"
    error = page.scale.standard_error
    plus = "" if error is None else f" ± {error:.2g} ({100 * error / page.scale.metres_per_unit:.1f} %)"
    return f"{page.scale.metres_per_unit:.5g}{plus} m per unit"


def _overlays(page: CapturePage) -> str:
    if not page.overlays:
        return "<p>No frame has both a pose and a thermal image.</p>"
    words = "White lines are the photograph's edges. Warm and cold shapes should lie on them. "
    words += (
        "Left: where the search for the rig began. Middle: where it ended."
        if page.rig.determined
        else f"The rig was not determined: {page.rig.explanation}"
    )
    cells = "".join(
        f"<h3>{escape(one.name)}</h3><div class=three>"
        f"{_figure(one.start_url, 'start value')}{_figure(one.found_url, 'as written')}"
        f"{_figure(one.thermal_url, _colours_text(one.shown_c))}</div>"
        for one in page.overlays
    )
    return f"<p>{escape(words)}</p>{cells}"


def _colours_text(shown_c: tuple[float, float] | None) -> str:
    if shown_c is None:
        return "thermal image"
    return f"thermal image: {shown_c[0]:.1f} °C and less are black, {shown_c[1]:.1f} °C and more are bright yellow"


def _figure(url: str, words: str) -> str:
    return (
        f'<figure><img src="{url}" alt="{escape(words, quote=True)}"><figcaption>{escape(words)}</figcaption></figure>'
    )


def _dropped(dropped: Mapping[str, str]) -> str:
    if not dropped:
        return "<p>Nothing: every file is in a pair and every pair has a pose.</p>"
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(why)}</td></tr>" for name, why in dropped.items())
    head = "<tr><th>file or frame</th><th>why</th></tr>"
    return scrolling(f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>")


def _cameras(page: CapturePage) -> str:
    found = page.rig.standard_errors
    focal_error = found.get("log_focal", float("nan")) * page.rig.thermal_camera.fl_x
    errors = {"focal": focal_error, **{name: found[name] for name in ("cx", "cy") if name in found}}
    columns = (
        ("photographs", page.model.camera, {}),
        ("thermal, start value", page.start.thermal_camera, {}),
        ("thermal, as written", page.rig.thermal_camera, errors),
    )
    lines = [
        ("size, pixels", [f"{camera.width} x {camera.height}" for _, camera, _ in columns]),
        (
            "focal length, pixels",
            [with_error(camera.fl_x, own.get("focal", math.nan), 1) for _, camera, own in columns],
        ),
        ("angle of view, degrees", [f"{_angle(camera):.1f}" for _, camera, _ in columns]),
        ("principal point, pixels", [_principal_point(camera, own) for _, camera, own in columns]),
        ("distortion k1, k2", [f"{camera.k1:.4f}, {camera.k2:.4f}" for _, camera, _ in columns]),
    ]
    head = "".join(f"<th class=num>{escape(name)}</th>" for name, _, _ in columns)
    rows = "".join(
        f"<tr><td>{escape(name)}</td>{''.join(f'<td class=num>{escape(cell)}</td>' for cell in cells)}</tr>"
        for name, cells in lines
    )
    turn = with_error(turn_deg(page.rig), turn_error_deg(page.rig), 2)
    shift = float(np.linalg.norm(page.rig.visible_to_thermal[:3, 3]))
    metres = f" = {100 * shift * page.scale.metres_per_unit:.1f} cm" if page.scale is not None else ""
    names = sorted({frame.camera for frame in page.frames if frame.camera})
    extra = [
        ("camera", ", ".join(names) or "the files do not say"),
        ("between the two lenses", f"turned by {turn} degrees, {shift:.4g} units{metres} apart"),
        ("how the rig was found", page.rig.explanation),
    ]
    unsure = why_turn_is_unsure(page.rig)
    if unsure:
        extra.append(("how sure the turn is", unsure))
    if np.isfinite(page.rig.score_after):
        extra.append(("agreement of edges", f"{page.rig.score_before:.3f} before, {page.rig.score_after:.3f} after"))
    if np.isfinite(page.rig.projection_sigma_px):
        extra.append(("standard error of a point's place", f"{page.rig.projection_sigma_px:.2f} thermal pixels"))
    table = f"<table class=cameras><thead><tr><th></th>{head}</tr></thead><tbody>{rows}</tbody></table>"
    return scrolling(table) + _rows(extra)


def _principal_point(camera: CameraModel, errors: Mapping[str, float]) -> str:
    return ", ".join(
        with_error(value, errors.get(name, math.nan), 1) for name, value in (("cx", camera.cx), ("cy", camera.cy))
    )


def _angle(camera: CameraModel) -> float:
    return float(2 * np.degrees(np.arctan(camera.width / (2 * camera.fl_x))))


def _poses(page: CapturePage) -> str:
    error = page.model.sighting_error_px()
    if not len(error):
        return f"<p>{escape(page.poses_source)}</p>"
    limit = float(np.percentile(error, 99))
    chart = histogram(error, "reprojection error, pixels of the photographs", limits=(0.0, max(limit, 0.1)))
    rows = []
    for index, name in enumerate(page.model.frames):
        own = error[page.model.sighting_frame == index]
        median = f"{np.median(own):.2f}" if len(own) else "-"
        rows.append(
            f"<tr><td>{escape(page.scene_names[index])}</td><td>{escape(name)}</td><td class=num>{len(own)}</td>"
            f"<td class=num>{median}</td></tr>"
        )
    head = (
        "<tr><th>in the scene</th><th>frame</th><th class=num>points</th><th class=num>median error, pixels</th></tr>"
    )
    table = scrolling(f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>")
    details = f"<details><summary>Frame by frame</summary>{table}</details>"
    figures = [
        ("source", page.poses_source),
        ("points", f"{len(page.model.points)}"),
        ("mean and median error", f"{error.mean():.2f} and {np.median(error):.2f} pixels"),
    ]
    return _rows(figures) + chart + details


def _scale(page: CapturePage) -> str:
    rows = [("scale", _scale_text(page))]
    if page.scale is not None:
        rows.append(("from", page.scale.source))
    spread = "" if page.up.spread_deg is None else f" Single photographs differ by {page.up.spread_deg:.1f} degrees."
    direction = ", ".join(f"{value + 0.0:.3f}" for value in np.round(page.up.direction, 3))
    return _rows([*rows, ("up, as x, y, z", f"{direction}. {page.up.source}{spread}")])


def _temperatures(page: CapturePage) -> str:
    values = page.temperatures_c[np.isfinite(page.temperatures_c)]
    if not values.size:
        return "<p>No thermal pixel has a temperature.</p>"
    low, high = (float(value) for value in np.percentile(values, _PERCENTILES))
    rows = [
        *measurement_rows(page.frames),
        ("lowest, median, highest", f"{values.min():.1f}, {np.median(values):.1f}, {values.max():.1f} °C"),
        ("pixels without a temperature", f"{100 * page.masked_share:.2f} %"),
        ("stuck pixels of the sensor", str(page.dead_pixels) if len(page.frames) >= MIN_FRAMES else _TOO_FEW),
    ]
    if page.overlay_share is not None:
        rows.append(("photographs masked", f"{100 * page.overlay_share:.1f} %"))
    label = "temperature, °C; how many pixels of a sample, without the coldest and hottest 0.1 %"
    return _rows(rows) + histogram(values, label, limits=(low, high))


def _drift(page: CapturePage) -> str:
    drift = page.drift
    rows = [("result", drift.explanation)]
    if np.isfinite(drift.before_k):
        rows.append(("two frames at the same point, before", f"{drift.before_k:.3f} K"))
    if np.isfinite(drift.after_k):
        rows.append(("after, at points it was not fitted to", f"{drift.after_k:.3f} K"))
    chart = bars(drift.offsets_k.tolist(), "frame; how much it reads too high, K") if drift.used else ""
    return _rows(rows) + chart


def _pairs(page: CapturePage) -> str:
    rows = "".join(
        f"<tr><td>{escape(pair.name)}</td><td>{escape(pair.photograph.name)}</td><td>{escape(pair.thermal.name)}</td>"
        f"<td>{escape(pair.how)}</td></tr>"
        for pair in page.pairs
    )
    head = "<tr><th>frame</th><th>photograph</th><th>thermal</th><th>how</th></tr>"
    table = scrolling(f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>")
    return f"<details><summary>All pairs</summary>{table}</details>"


def _rows(rows: Sequence[tuple[str, str]]) -> str:
    body = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<div class=rows>{scrolling(f'<table><tbody>{body}</tbody></table>')}</div>"


_STYLE = """
.rows { max-width: 56rem; }
.rows td:first-child { width: 17rem; }
td { overflow-wrap: anywhere; }
td:first-child { min-width: 6rem; }
.three { display: grid; grid-template-columns: repeat(3, 1fr); gap: .6rem; align-items: start; break-inside: avoid; }
svg { max-width: 46rem; font-size: 11px; }
svg rect { fill: var(--accent); opacity: .8; }
svg line { stroke: var(--soft); }
svg text { fill: var(--soft); }
@media screen and (max-width: 640px) {
  .three { grid-template-columns: 1fr; }
  .rows td:first-child { width: 40%; }
  .cameras tr { display: grid; grid-template-columns: repeat(3, 1fr); border-bottom: 1px solid var(--line); }
  .cameras td, .cameras th { border: 0; text-align: left; white-space: normal; }
  .cameras td:first-child { grid-column: 1 / -1; padding-bottom: 0; color: var(--soft); }
  .cameras th:first-child { display: none; }
}
"""
