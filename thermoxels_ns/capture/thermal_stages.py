"""The stages that tie the thermal images to the photographs: checker board, rig and drift."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from thermoxels_ns.capture import results
from thermoxels_ns.capture.frames import CaptureFrame, CaptureFrames
from thermoxels_ns.capture.job import CaptureJob
from thermoxels_ns.capture.rig.board_photos import in_scene_units, rig_from_board_photos
from thermoxels_ns.capture.rig.drift import estimate_drift
from thermoxels_ns.capture.rig.inputs import kept_start, read_rig, rig_frames, rig_start
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.rig.summary import rig_lines
from thermoxels_ns.capture.sfm.metric_scale import MetricScale
from thermoxels_ns.capture.sfm.model import SfmModel
from thermoxels_ns.capture.stage_types import DriftEstimate, RigEstimate
from thermoxels_ns.capture.stages import files_of, fingerprint, given_fingerprints

_LEAST_SIGHTINGS = 50
"""Sightings of scene points below which thermal images and photographs cannot be compared."""


def board_stage(job: CaptureJob, model: SfmModel, read: CaptureFrames) -> RigEstimate | None:
    """Find the rig in metres where the user has pictures of a checker board; None: there are none.

    Raises:
        SceneError: The pictures do not say where the thermal camera is.
    """
    board, pictures, settings = job.board, job.settings.board_photos, job.settings
    if board is None or pictures is None:
        job.cache.leave_out("board", "no --board-photos")
        return None
    depends = {
        "board": board,
        "files": fingerprint(files_of(pictures), pictures),
        "angle": settings.thermal_field_of_view_deg,
    }

    def work(folder: Path) -> None:
        radiometry = job.radiometry()
        rig = rig_from_board_photos(
            pictures, board, model.camera, read.thermal_size, folder, settings, radiometry, job.say
        )
        results.save_rig(folder, rig)

    return results.load_rig(job.cache.run("board", depends, work))


def rig_stage(
    job: CaptureJob,
    model: SfmModel,
    frames: list[CaptureFrame],
    read: CaptureFrames,
    scale: MetricScale | None,
    scale_missing: str,
    board: RigEstimate | None,
) -> tuple[RigEstimate, RigEstimate]:
    """Find the rig, or take the one that the user or a checker board gives.

    Args:
        job: The capture.
        model: Poses and scene points.
        frames: The model's frames, in its order.
        read: All frames that were read.
        scale: Metres per unit of the model.
        scale_missing: Why there is none.
        board: The rig in metres from a checker board.

    Returns:
        The rig in the model's units, and where the search for it began.

    Raises:
        SceneError: The rig that is given cannot be used, or needs a scale.
    """
    settings = job.settings
    depends = {"angle": settings.thermal_field_of_view_deg, "rig": given_fingerprints([settings.rig])}

    def work(folder: Path) -> None:
        metres = None if scale is None else scale.metres_per_unit
        begin = rig_start(frames, model.camera, read.thermal_size, settings.thermal_field_of_view_deg, metres)
        results.save_rig(folder, kept_start(begin, "Where the search begins."), "start")
        if settings.rig is not None:
            rig = read_rig(settings.rig, read.thermal_size, metres)
        elif board is not None:
            rig = in_scene_units(board, scale, scale_missing)
        elif len(model.sighting_frame) < _LEAST_SIGHTINGS:
            rig = kept_start(begin, "There are no scene points to compare the images at.")
        else:
            rig = estimate_rig(
                rig_frames(model, frames),
                model.camera,
                begin,
                lambda message, share: job.say(f"rig: {message} ({100 * share:.0f} %)"),
            )
        results.save_rig(folder, rig)
        for line in rig_lines(rig, metres):
            job.say(f"rig: {line}")

    folder = job.cache.run("rig", depends, work)
    return results.load_rig(folder), results.load_rig(folder, "start")


def drift_stage(job: CaptureJob, model: SfmModel, frames: list[CaptureFrame], rig: RigEstimate) -> DriftEstimate:
    """Find how far each thermal image reads too high, unless the user switched that off."""

    def work(folder: Path) -> None:
        if job.settings.drift == "off" or len(model.sighting_frame) < _LEAST_SIGHTINGS:
            why = "Switched off." if job.settings.drift == "off" else "There are no scene points to compare at."
            drift = DriftEstimate(np.zeros(len(frames)), (), np.nan, np.nan, False, why)
        else:
            drift = estimate_drift(rig_frames(model, frames), rig.thermal_camera, rig.visible_to_thermal)
        results.save_drift(folder, drift)
        job.say(f"drift: {drift.explanation}")

    return results.load_drift(job.cache.run("drift", {"drift": job.settings.drift}, work))
