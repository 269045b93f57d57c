"""capture.html: what the capture found, on one page that fetches nothing and runs no script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.charts import bars, histogram
from thermoxels_ns.capture.contract import CameraModel, DriftEstimate, RigEstimate
from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.gravity import Up
from thermoxels_ns.capture.metric_scale import MetricScale
from thermoxels_ns.capture.pairs import Pair
from thermoxels_ns.capture.sfm_model import SfmModel
from thermoxels_ns.checks import replace_when_done

_PERCENTILES = (0.1, 99.9)


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
    title = escape(page.title)
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
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n{body}\n"
        "</main>\n</body>\n</html>\n"
    )


def _summary(page: CapturePage) -> str:
    registered, pairs = len(page.model.frames), len(page.pairs)
    error = page.model.sighting_error_px()
    rows = [
        ("Pairs found", str(pairs)),
        ("Frames in the scene", f"{registered} of {pairs}"),
        ("Rig", "found from the images" if page.rig.determined else "not determined: the start value is kept"),
        ("Drift and vignetting", "corrected" if page.drift.used else "not corrected"),
        ("Scale", _scale_text(page)),
    ]
    if len(error):
        rows.insert(2, ("Median reprojection error", f"{np.median(error):.2f} pixels"))
    return _rows(rows)


def _scale_text(page: CapturePage) -> str:
    if page.scale is None:
        return f"unknown: {page.scale_missing}"
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
        f"{_figure(one.thermal_url, 'thermal image')}</div>"
        for one in page.overlays
    )
    return f"<p>{escape(words)}</p>{cells}"


def _figure(url: str, words: str) -> str:
    return (
        f'<figure><img src="{url}" alt="{escape(words, quote=True)}"><figcaption>{escape(words)}</figcaption></figure>'
    )


def _dropped(dropped: Mapping[str, str]) -> str:
    if not dropped:
        return "<p>Nothing: every file is in a pair and every pair has a pose.</p>"
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(why)}</td></tr>" for name, why in dropped.items())
    return f"<table><thead><tr><th>file or frame</th><th>why</th></tr></thead><tbody>{rows}</tbody></table>"


def _cameras(page: CapturePage) -> str:
    errors = page.rig.standard_errors
    focal_error = errors.get("log_focal", float("nan")) * page.rig.thermal_camera.fl_x
    columns = (
        ("photographs", page.model.camera, float("nan")),
        ("thermal, start value", page.start.thermal_camera, float("nan")),
        ("thermal, as written", page.rig.thermal_camera, focal_error),
    )
    lines = [
        ("size, pixels", [f"{camera.width} x {camera.height}" for _, camera, _ in columns]),
        ("focal length, pixels", [_with_error(camera.fl_x, error) for _, camera, error in columns]),
        ("angle of view, degrees", [f"{_angle(camera):.1f}" for _, camera, _ in columns]),
        ("principal point, pixels", [f"{camera.cx:.1f}, {camera.cy:.1f}" for _, camera, _ in columns]),
        ("distortion k1, k2", [f"{camera.k1:.4f}, {camera.k2:.4f}" for _, camera, _ in columns]),
    ]
    head = "".join(f"<th class=num>{escape(name)}</th>" for name, _, _ in columns)
    rows = "".join(
        f"<tr><td>{escape(name)}</td>{''.join(f'<td class=num>{escape(cell)}</td>' for cell in cells)}</tr>"
        for name, cells in lines
    )
    transform = page.rig.visible_to_thermal
    turn = np.degrees(np.arccos(np.clip((np.trace(transform[:3, :3]) - 1) / 2, -1, 1)))
    shift = float(np.linalg.norm(transform[:3, 3]))
    metres = f" = {100 * shift * page.scale.metres_per_unit:.1f} cm" if page.scale is not None else ""
    names = sorted({frame.camera for frame in page.frames if frame.camera})
    extra = [
        ("camera", ", ".join(names) or "the files do not say"),
        ("between the two lenses", f"turned by {turn:.2f} degrees, {shift:.4g} units{metres} apart"),
        ("how the rig was found", page.rig.explanation),
    ]
    if np.isfinite(page.rig.score_after):
        extra.append(("agreement of edges", f"{page.rig.score_before:.3f} before, {page.rig.score_after:.3f} after"))
    if np.isfinite(page.rig.projection_sigma_px):
        extra.append(("standard error of a point's place", f"{page.rig.projection_sigma_px:.2f} thermal pixels"))
    return f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{rows}</tbody></table>{_rows(extra)}"


def _with_error(value: float, error: float) -> str:
    return f"{value:.1f} ± {error:.1f}" if np.isfinite(error) else f"{value:.1f}"


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
    table = (
        "<details><summary>Frame by frame</summary><table><thead><tr><th>in the scene</th><th>frame</th>"
        "<th class=num>points</th><th class=num>median error, pixels</th></tr></thead><tbody>"
        + "".join(rows)
        + "</tbody></table></details>"
    )
    figures = [
        ("source", page.poses_source),
        ("points", f"{len(page.model.points)}"),
        ("mean and median error", f"{error.mean():.2f} and {np.median(error):.2f} pixels"),
    ]
    return _rows(figures) + chart + table


def _scale(page: CapturePage) -> str:
    rows = [("scale", _scale_text(page))]
    if page.scale is not None:
        rows.append(("from", page.scale.source))
    spread = "" if page.up.spread_deg is None else f" Single photographs differ by {page.up.spread_deg:.1f} degrees."
    direction = ", ".join(f"{value:.3f}" for value in page.up.direction)
    return _rows([*rows, ("up", f"({direction}). {page.up.source}{spread}")])


def _temperatures(page: CapturePage) -> str:
    values = page.temperatures_c[np.isfinite(page.temperatures_c)]
    if not values.size:
        return "<p>No thermal pixel has a temperature.</p>"
    low, high = (float(value) for value in np.percentile(values, _PERCENTILES))
    rows = [
        ("lowest, median, highest", f"{values.min():.1f}, {np.median(values):.1f}, {values.max():.1f} degrees C"),
        ("pixels without a temperature", f"{100 * page.masked_share:.2f} %"),
        ("stuck pixels of the sensor", str(page.dead_pixels)),
    ]
    if page.overlay_share is not None:
        rows.append(("photographs masked", f"{100 * page.overlay_share:.1f} %"))
    return _rows(rows) + histogram(values, "temperature, degrees C", limits=(low, high))


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
    return (
        "<details><summary>All pairs</summary><table><thead><tr><th>frame</th><th>photograph</th><th>thermal</th>"
        f"<th>how</th></tr></thead><tbody>{rows}</tbody></table></details>"
    )


def _rows(rows: Sequence[tuple[str, str]]) -> str:
    body = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table><tbody>{body}</tbody></table>"


_STYLE = """
:root { color-scheme: light; --ink: #1d2430; --soft: #5c6675; --line: #e1e5ea; --accent: #b3431e; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1150px; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.8rem; margin: 0 0 .5rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .7rem; padding-bottom: .3rem; border-bottom: 2px solid var(--accent); }
h3 { font-size: .85rem; font-weight: 600; color: var(--soft); margin: 1rem 0 .3rem; }
table { border-collapse: collapse; width: 100%; max-width: 56rem; margin-bottom: .8rem; }
th, td { text-align: left; padding: .35rem .75rem .35rem 0; border-bottom: 1px solid var(--line); vertical-align: top;
  overflow-wrap: anywhere; }
th { font-size: .85rem; font-weight: 600; color: var(--soft); }
.num { text-align: right; font-variant-numeric: tabular-nums; }
.three { display: grid; grid-template-columns: repeat(3, 1fr); gap: .6rem; align-items: start; }
figure { margin: 0; }
figcaption { font-size: .8rem; color: var(--soft); }
img { display: block; width: 100%; height: auto; border-radius: 3px; }
svg { display: block; width: 100%; max-width: 46rem; font-size: 11px; }
svg rect { fill: var(--accent); opacity: .8; }
svg line { stroke: var(--soft); }
svg text { fill: var(--soft); }
summary { cursor: pointer; color: var(--soft); }
@media (max-width: 640px) { .three { grid-template-columns: 1fr; } main { padding: 1.25rem .9rem 3rem; } }
"""
