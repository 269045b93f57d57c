"""All stages of a capture in order: from a folder of camera files to a scene and a page about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from thermoxels_ns.capture.camera_files import scan_folder
from thermoxels_ns.capture.file_stages import pair_stage, temperature_stage
from thermoxels_ns.capture.job import PAGE_NAME, CaptureJob
from thermoxels_ns.capture.output_lock import only_capture
from thermoxels_ns.capture.pose_stages import photograph_masks, pose_stage, scale_stage
from thermoxels_ns.capture.report import Findings, report_page
from thermoxels_ns.capture.rig.board_photos import board_of
from thermoxels_ns.capture.scene_writer import JSON_NAME, SCENE_CONTENT, Scene, write_scene_folder
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.metric_scale import MetricScale
from thermoxels_ns.capture.stage_types import DriftEstimate, RigEstimate
from thermoxels_ns.capture.stages import StageCache, prepare_output
from thermoxels_ns.capture.thermal_stages import board_stage, drift_stage, rig_stage
from thermoxels_ns.core.checks import remove_stale_temporaries
from thermoxels_ns.core.errors import OutputError, SceneError, ThermoxelsError


@dataclass(frozen=True)
class CaptureResult:
    """What a capture wrote, and the figures to judge it by."""

    scene: Path
    """transforms.json."""
    page: Path
    pairs: int
    frames: int
    """In the scene."""
    dropped: dict[str, str]
    """Files and frames that are not in it, and why."""
    rig: RigEstimate
    drift: DriftEstimate
    scale: MetricScale | None
    scale_missing: str
    """Why there is no scale, where there is none."""


def run_capture(
    source: Path, output: Path, settings: CaptureSettings, say: Callable[[str], None] = lambda _: None
) -> CaptureResult:
    """Turn a folder of camera files into a scene.

    Args:
        source: The folder; nothing is written to it, unless the output lies in it.
        output: For the scene, the page and the stages' results.
        settings: How.
        say: Told how far it is, one line at a time.

    Raises:
        ThermoxelsError: A file cannot be read, there are no pairs or no poses, or an option is out of range.
        OutputError: The output cannot be written to, its disk is full, or another capture works in it.
    """
    if not source.is_dir():
        scan_folder(source)  # says what is wrong
    if source.resolve().is_relative_to(output.resolve()):
        raise SceneError(
            "output",
            expected="another folder than the input, which does not hold it either",
            got=output,
            remedy="Pass a new folder with --output; the camera's files stay as they are.",
        )
    board = board_of(settings)
    if settings.board_photos is not None and not settings.board_photos.is_dir():
        scan_folder(settings.board_photos)
    folder = prepare_output(output)
    try:
        # Inverses and sums of BLAS depend on the number of its threads; one thread is no slower here.
        with only_capture(folder, say), threadpool_limits(1, "blas"):
            remove_stale_temporaries(folder, [PAGE_NAME])
            cache = StageCache(folder, settings.from_stage, say)
            return _run_stages(CaptureJob(source, folder, settings, cache, say, board))
    except ThermoxelsError:
        raise
    except OSError as problem:
        raise OutputError(
            str(problem.filename2 or problem.filename or folder),
            expected="a file that can be read or written",
            got=problem.strerror or str(problem),
            remedy="Check free space and permissions, and run the command again: finished stages are kept.",
        ) from problem


def _run_stages(job: CaptureJob) -> CaptureResult:
    pairs = pair_stage(job)
    read = temperature_stage(job, pairs)
    found = pose_stage(job, read)
    model, scale, scale_missing, up = scale_stage(job, found, read)
    by_name = {frame.name: frame for frame in read.frames}
    frames = [by_name[name] for name in model.frames]
    board = board_stage(job, model, read)
    rig, start = rig_stage(job, model, frames, read, scale, scale_missing, board)
    drift = drift_stage(job, model, frames, rig)
    scene = Scene(frames, model, rig, drift, scale, up, photograph_masks(job, frames, model))
    written = [job.output / name for name in SCENE_CONTENT]
    job.cache.run("scene", {}, lambda _: write_scene_folder(scene, job.output, job.say), written)
    findings = Findings(
        source=job.source,
        pairs=pairs,
        dropped=job.dropped,
        read=read,
        scene=scene,
        start=start,
        scale_missing=scale_missing,
        poses_source=_poses_source(job),
        seconds=job.cache.seconds,
    )
    page = job.output / PAGE_NAME
    job.cache.run("page", {}, lambda _: report_page(findings, page), [page])
    return CaptureResult(
        scene=job.output / JSON_NAME,
        page=page,
        pairs=len(pairs),
        frames=len(frames),
        dropped=job.dropped,
        rig=rig,
        drift=drift,
        scale=scale,
        scale_missing=scale_missing,
    )


def _poses_source(job: CaptureJob) -> str:
    if job.settings.poses is not None:
        return f"Given in {job.settings.poses.name}."
    return "Structure from motion on the photographs (COLMAP)."
