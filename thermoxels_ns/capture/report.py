"""Gathers what the stages found, with pictures, for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermoxels_ns.capture.camera_files import shown_name
from thermoxels_ns.capture.frames import CaptureFrames
from thermoxels_ns.capture.overlays import colours, jpeg_of, overlay, spread_out
from thermoxels_ns.capture.pairs import Pair
from thermoxels_ns.capture.rig.inputs import rig_frames
from thermoxels_ns.capture.scene_writer import Scene, scene_names
from thermoxels_ns.capture.stage_types import RigEstimate
from thermoxels_ns.reports.capture_page import CapturePage, Overlay, build_page
from thermoxels_ns.reports.page import write_page

_SHOWN = 6
_SHOWN_PERCENTILES = (2.0, 98.0)
"""Of a thermal image's temperatures, for its darkest and brightest colours."""
_SAMPLED_PIXELS = 4000
"""Of every thermal image, for the histogram."""


@dataclass(frozen=True)
class Findings:
    """What the page is made from."""

    source: Path
    pairs: Sequence[Pair]
    dropped: Mapping[str, str]
    read: CaptureFrames
    scene: Scene
    start: RigEstimate
    """The rig's start value."""
    scale_missing: str
    poses_source: str
    seconds: Sequence[tuple[str, float]]


def report_page(findings: Findings, path: Path) -> None:
    """Draw the overlays and write the page."""
    scene, names = findings.scene, scene_names(len(findings.scene.frames))
    paired = rig_frames(scene.model, scene.frames)
    overlays = []
    for index in spread_out(len(paired), _SHOWN):
        temperature_c = scene.drift.corrected(index, np.load(scene.frames[index].thermal))
        drawn_over = [
            jpeg_of(overlay(paired[index], temperature_c, scene.model.camera, rig))
            for rig in (findings.start, scene.rig)
        ]
        known = temperature_c[np.isfinite(temperature_c)]
        low, high = (float(each) for each in np.percentile(known, _SHOWN_PERCENTILES)) if known.size else (0.0, 1.0)
        alone = jpeg_of(colours(temperature_c, (low, high)).astype(np.uint8))
        title = f"{names[index]}: {scene.frames[index].photograph_source}"
        overlays.append(Overlay(title, *drawn_over, alone, (low, high) if known.size else None))
    samples, masked, pixels = [], 0, 0
    for index, frame in enumerate(scene.frames):
        temperature_c = scene.drift.corrected(index, np.load(frame.thermal)).ravel()
        samples.append(temperature_c[:: max(1, len(temperature_c) // _SAMPLED_PIXELS)])
        masked, pixels = masked + frame.masked, pixels + len(temperature_c)
    drawn = scene.masks.overlay
    page = CapturePage(
        title=f"Capture of {shown_name(findings.source.resolve())}",
        pairs=findings.pairs,
        dropped=findings.dropped,
        frames=scene.frames,
        scene_names=names,
        model=scene.model,
        rig=scene.rig,
        start=findings.start,
        drift=scene.drift,
        scale=scene.scale,
        scale_missing=findings.scale_missing,
        up=scene.up,
        overlays=overlays,
        temperatures_c=np.concatenate(samples),
        masked_share=masked / max(pixels, 1),
        dead_pixels=findings.read.dead_pixels,
        poses_source=findings.poses_source,
        overlay_share=None if drawn is None else float(1.0 - drawn.mean()),
        seconds=list(findings.seconds),
    )
    write_page(path, build_page(page))
