"""Gathers what the stages found, with pictures, for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermoxels_ns.capture.contract import RigEstimate
from thermoxels_ns.capture.frames import CaptureFrames
from thermoxels_ns.capture.overlays import colours, data_url, overlay, spread_out
from thermoxels_ns.capture.page import CapturePage, Overlay, write_page
from thermoxels_ns.capture.pairs import Pair
from thermoxels_ns.capture.rig_inputs import rig_frames
from thermoxels_ns.capture.scene_writer import Scene, scene_names

_SHOWN = 6
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
        urls = [
            data_url(overlay(paired[index], temperature_c, scene.model.camera, rig))
            for rig in (findings.start, scene.rig)
        ]
        alone = data_url(colours(temperature_c).astype(np.uint8))
        overlays.append(Overlay(f"{names[index]}: {scene.frames[index].photograph_source}", urls[0], urls[1], alone))
    samples, masked, pixels = [], 0, 0
    for index, frame in enumerate(scene.frames):
        temperature_c = scene.drift.corrected(index, np.load(frame.thermal)).ravel()
        samples.append(temperature_c[:: max(1, len(temperature_c) // _SAMPLED_PIXELS)])
        masked, pixels = masked + frame.masked, pixels + len(temperature_c)
    drawn = scene.masks.overlay
    write_page(
        CapturePage(
            title=f"Capture of {findings.source.resolve().name}",
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
        ),
        path,
    )
