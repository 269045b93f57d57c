"""The stages that place the photographs: poses, then scale and up."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from thermoxels_ns.capture import results
from thermoxels_ns.capture.frame_masks import find_masks, user_masks
from thermoxels_ns.capture.frames import CaptureFrame, CaptureFrames
from thermoxels_ns.capture.job import CaptureJob
from thermoxels_ns.capture.masks import PhotographMasks, mask_files
from thermoxels_ns.capture.sfm.given_poses import fitted_to_photographs, in_order, read_given_poses
from thermoxels_ns.capture.sfm.gravity import Up, find_up, level_rotation
from thermoxels_ns.capture.sfm.metric_scale import (
    MeasuredDistance,
    MetricScale,
    scale_from_distance,
    scale_from_gps,
    scale_from_markers,
)
from thermoxels_ns.capture.sfm.model import SfmModel
from thermoxels_ns.capture.sfm.poses import PoseOptions, add_points, find_poses
from thermoxels_ns.capture.stages import CACHE_FOLDER, files_of, given_fingerprints, read_json, write_json

_OVERLAY_FILE = "overlay.npy"


def pose_stage(job: CaptureJob, read: CaptureFrames) -> SfmModel:
    """Find camera, poses and scene points, or take those that the user gives.

    Raises:
        SceneError: Too few photographs fit together, or given poses or masks cannot be used.
        OutputError: The disk is full.
    """
    settings = job.settings
    options = PoseOptions(
        settings.image_size,
        settings.max_features,
        settings.matching,
        settings.lens,
        settings.seed,
        settings.threads,
    )
    files = [] if settings.poses is None else files_of(settings.poses)
    user = [] if settings.masks is None else list(mask_files(settings.masks).values())
    depends = {
        "options": options,
        "poses": given_fingerprints(files),
        "masks": given_fingerprints(user),
        "overlays": settings.find_overlays,
    }

    def work(folder: Path) -> None:
        photographs = {frame.name: frame.photograph for frame in read.frames}
        masks = find_masks(read.frames, settings.masks, settings.find_overlays)
        if masks.overlay is not None:
            np.save(folder / _OVERLAY_FILE, masks.overlay)
            job.say(f"masks: {100 * (1 - masks.overlay.mean()):.1f} % of every photograph is drawn over")
        if settings.poses is None:
            focal = [frame.focal_px for frame in read.frames if frame.focal_px]
            poses = find_poses(photographs, folder, float(np.median(focal)) if focal else None, masks, options, job.say)
            order = {name: number for number, name in enumerate(photographs)}
            model = in_order(poses.model, lambda name: order[name])
        else:
            given = read_given_poses(settings.poses, {f.name: f.photograph_source for f in read.frames})
            poses = fitted_to_photographs(given, photographs)
            model = poses.model
            if not len(model.points):
                model = add_points(model, photographs, folder, masks, options, job.say)
        results.save_model(folder, model)
        write_json(folder / "dropped.json", dict(poses.dropped))
        job.say(f"poses: {len(model.frames)} of {len(read.frames)} frames, {len(model.points)} points")

    folder = job.cache.run("poses", depends, work)
    job.dropped |= read_json(folder / "dropped.json")
    return results.load_model(folder)


def photograph_masks(job: CaptureJob, frames: list[CaptureFrame], model: SfmModel) -> PhotographMasks:
    """What the stage of the poses found drawn over the photographs, and the user's masks."""
    size = (model.camera.width, model.camera.height)
    file = job.output / CACHE_FOLDER / "poses" / _OVERLAY_FILE
    drawn = np.load(file) if file.is_file() else None
    if drawn is not None and drawn.shape != (size[1], size[0]):
        drawn = None
    return PhotographMasks(size, drawn, user_masks(frames, job.settings.masks))


def scale_stage(job: CaptureJob, found: SfmModel, read: CaptureFrames) -> tuple[SfmModel, MetricScale | None, str, Up]:
    """Find metres per unit and up; turn a model that was found here upright, keep one that was given.

    Returns:
        The model, its scale, why there is none, and up in the model's axes.

    Raises:
        SceneError: A length that the user gives cannot be used.
    """
    settings = job.settings
    depends = {
        "known": [settings.known_distance, settings.known_distance_error_m],
        "markers": [settings.marker_side_m, settings.marker_error_m],
    }
    by_name = {frame.name: frame for frame in read.frames}
    frames = [by_name[name] for name in found.frames]

    def work(folder: Path) -> None:
        scale, missing = _metric_scale(job, found, frames)
        up = find_up(
            found.camera_to_world, [frame.gimbal_deg for frame in frames], [frame.orientation for frame in frames]
        )
        model = found
        if settings.poses is None:
            rotation = level_rotation(up.direction, -found.camera_to_world[:, :3, 2].mean(axis=0))
            origin = np.median(found.points, axis=0) if len(found.points) else found.centres.mean(axis=0)
            model = found.moved(rotation, origin)
            up = Up(rotation @ up.direction, up.source, up.spread_deg)
        results.save_model(folder, model)
        results.save_scale(folder, scale, missing, up)
        job.say(f"scale: {missing}" if scale is None else f"scale: {scale.metres_per_unit:.5g} m per unit")

    folder = job.cache.run("scale", depends, work)
    return results.load_model(folder), *results.load_scale(folder)


def _metric_scale(job: CaptureJob, model: SfmModel, frames: list[CaptureFrame]) -> tuple[MetricScale | None, str]:
    """Metres per unit from the surest source that there is; where there is none, why."""
    settings = job.settings
    if settings.known_distance is not None:
        name, x0, y0, x1, y1, metres = settings.known_distance
        measured = MeasuredDistance(name, (x0, y0), (x1, y1), metres, settings.known_distance_error_m)
        return scale_from_distance(model, measured, {f.name: f.photograph_source for f in frames}), ""
    if settings.marker_side_m is not None:
        photographs = {frame.name: frame.photograph for frame in frames}
        return scale_from_markers(model, photographs, settings.marker_side_m, settings.marker_error_m)
    return scale_from_gps(model.centres, [frame.gps for frame in frames])
