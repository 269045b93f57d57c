"""All stages of a capture: from a folder of camera files to a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from thermoxels_ns.capture.folder_scan import scan_folder
from thermoxels_ns.capture.frames import CaptureFrames, read_frames
from thermoxels_ns.capture.pairs import Pair, search_pairs
from thermoxels_ns.capture.rig.drift import estimate_drift, sample_shared_points
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.rig.start import read_rig, rig_frames, rig_start
from thermoxels_ns.capture.rig_types import RigEstimate
from thermoxels_ns.capture.scene_writer import Scene, write_scene_folder
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.poses import MODEL_FOLDER, find_poses, read_poses
from thermoxels_ns.capture.sfm.scale_and_up import scale_from_gps, scale_from_markers, upright
from thermoxels_ns.capture.stage_cache import CACHE_FOLDER, fingerprint, load_rig, prepare_output, run_stage, save_rig
from thermoxels_ns.core.checks import hold_folder, plain_os_errors
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.radiometry.measurement_model import RadiometryOptions

PAGE_NAME = "capture.html"  # file name of the report, in the output folder


@dataclass(frozen=True)
class CaptureResult:
    """Everything that one finished capture found. The scene is in the folder `output`."""

    source: Path
    output: Path
    pairs: Sequence[Pair]
    dropped: dict[str, str]  # reason by name, for each file and frame that is not in the scene
    read: CaptureFrames
    scene: Scene
    start: RigEstimate  # the rig that the search started from
    scale_missing: str  # reason why no metric scale was found; empty if one was found

    @property
    def page(self) -> Path:
        """Path of the HTML page that reports on the capture."""
        return self.output / PAGE_NAME


def run_capture(
    source: Path,
    output: Path,
    settings: CaptureSettings,
    write_page: Callable[[CaptureResult], None],
    say: Callable[[str], None] = lambda _: None,
) -> CaptureResult:
    """Turn the folder `source` of camera files into a scene in the folder `output`.

    Poses and rig, which take minutes to find, are kept there for the next run. `write_page` writes the report at the
    end. `say` receives one line of progress at a time. Raises `ThermoxelsError` if a file cannot be read, no pairs or
    no poses are found, or an option is out of range. Raises `OutputError` if `output` cannot be written to, its disk is
    full, or another capture is working in it.
    """
    if not source.is_dir():
        scan_folder(source)  # says what is wrong
    if source.resolve().is_relative_to(output.resolve()):
        expected = "another folder than the input, which does not hold it either"
        remedy = "Pass a new folder with --output; the camera's files stay as they are."
        raise SceneError("output", expected=expected, got=output, remedy=remedy)
    folder = prepare_output(output)
    remedy = "Wait until it ends, or pass another folder with --output."
    lock = hold_folder(folder / CACHE_FOLDER / "lock", remedy, say)
    try:
        # Results of BLAS depend on its number of threads in the last bits; one thread is no slower here.
        remedy = "Check free space and permissions, and run the command again: poses and rig that were found are kept."
        with threadpool_limits(1, "blas"), plain_os_errors(folder, remedy=remedy):
            return _captured(source, folder, settings, write_page, say)
    finally:
        lock.release()


def _captured(
    source: Path,
    output: Path,
    settings: CaptureSettings,
    write_page: Callable[[CaptureResult], None],
    say: Callable[[str], None],
) -> CaptureResult:
    """Run all stages of a capture and return what they found, see `run_capture`."""
    kept = output / CACHE_FOLDER
    search = search_pairs(source, settings, [output], say)
    say(f"pairs: {len(search.pairs)}, files left out: {len(search.unpaired)}")
    read = read_frames(search.pairs, source, kept, settings, say)
    say(f"temperatures: {len(read.frames)} thermal images of {read.thermal_size[0]} x {read.thermal_size[1]} pixels")
    depends: dict[str, Any] = {
        "options": {
            name: getattr(settings, name) for name in ("image_size", "max_features", "lens", "seed", "threads")
        },
        "files": fingerprint([source / frame.name for frame in read.frames], source),
    }

    def search_poses(folder: Path) -> None:
        photographs = {frame.name: frame.photograph for frame in read.frames}
        focal = [frame.focal_px for frame in read.frames if frame.focal_px]
        middle = float(np.median(focal)) if focal else None
        find_poses(photographs, read.photograph_size, folder, settings, middle, say)

    key = run_stage(kept / "poses", depends, search_poses, settings.from_stage == "poses", say)
    found = read_poses(kept / "poses", [frame.name for frame in read.frames], read.photograph_size)
    say(f"poses: {len(found.frames)} of {len(read.frames)} frames, {len(found.points)} points")
    few = "too few matches with the largest group of photographs that fit together"
    alone = {frame.name: few for frame in read.frames if frame.name not in found.frames}
    frames = [frame for frame in read.frames if frame.name in found.frames]
    if settings.marker_side_m is not None:
        photographs = {frame.name: frame.photograph for frame in frames}
        scale, missing = scale_from_markers(found, photographs, settings.marker_side_m, settings.marker_error_m)
    else:
        scale, missing = scale_from_gps(found.centres, [frame.gps for frame in frames])
    metres = None if scale is None else scale.metres_per_unit
    say(f"scale: {missing}" if metres is None else f"scale: {metres:.5g} m per unit")
    model, up, moved = upright(found, frames)
    start = rig_start(frames, model.camera, read.thermal_size, settings.thermal_field_of_view_deg, metres)
    in_rig = rig_frames(model, frames)
    if settings.rig is not None:
        rig = read_rig(settings.rig, read.thermal_size, metres)
    else:
        depends = {
            "options": {each.name: getattr(settings, each.name) for each in fields(RadiometryOptions)},
            "start": [key, settings.thermal_field_of_view_deg, metres],
            "files": fingerprint([source / frame.thermal_source for frame in read.frames], source),
        }

        def search_rig(folder: Path) -> None:
            save_rig(folder / "rig.npz", estimate_rig(in_rig, model.camera, start, lambda line: say(f"rig: {line}")))

        run_stage(kept / "rig", depends, search_rig, settings.from_stage is not None, say)
        rig = load_rig(kept / "rig" / "rig.npz")
    say(f"rig: {rig.explanation}")
    drift = estimate_drift(sample_shared_points(in_rig, rig.thermal_camera, rig.visible_to_thermal))
    say(f"drift: {drift.explanation}")
    scene = Scene(frames, model, kept / "poses" / MODEL_FOLDER, moved, rig, drift, scale, up)
    write_scene_folder(scene, output, say)
    dropped = search.unpaired | read.dropped | alone
    result = CaptureResult(source, output, search.pairs, dropped, read, scene, start, missing)
    write_page(result)
    return result
