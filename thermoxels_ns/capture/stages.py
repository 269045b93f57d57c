"""All stages of a capture: from a folder of camera files to a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from thermoxels_ns.capture.folder_scan import scan_folder
from thermoxels_ns.capture.frames import CaptureFrame, CaptureFrames, read_frames
from thermoxels_ns.capture.pairs import Pair, search_pairs
from thermoxels_ns.capture.rig.drift import estimate_drift
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.rig.start import read_rig, rig_frames, rig_start
from thermoxels_ns.capture.rig_types import RigEstimate
from thermoxels_ns.capture.scene_writer import Scene, write_scene_folder
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.poses import MODEL_FOLDER, find_poses, read_poses
from thermoxels_ns.capture.sfm.scale_and_up import scale_from_gps, scale_from_markers, upright
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.capture.stage_cache import CACHE_FOLDER, fingerprint, load_rig, prepare_output, run_stage, save_rig
from thermoxels_ns.core.checks import hold_folder, plain_os_errors
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data.scene_scale import SceneScale
from thermoxels_ns.radiometry.measurement_model import RadiometryOptions

PAGE_NAME = "capture.html"  # file name of the report, in the output folder


@dataclass(frozen=True)
class CaptureResult:
    """Everything that one finished capture found; `run_capture` also wrote the scene to the folder `output`."""

    source: Path
    output: Path
    pairs: Sequence[Pair]
    dropped: dict[str, str]  # reason by name, for each file and frame that is not in the scene
    read: CaptureFrames
    scene: Scene
    start: RigEstimate  # the rig that the search started from
    scale_missing: str  # reason why no metric scale was found; empty where a scale was found

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
    """Turn a folder of camera files into a scene, a page and the stages' results in `output`.

    `write_page` writes the report at the end. `say` is called with one line of progress at a time.

    Raises:
        ThermoxelsError: A file cannot be read, no pairs or no poses are found, or an option is out of range.
        OutputError: `output` cannot be written to, its disk is full, or another capture is working in it.
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
        remedy = "Check free space and permissions, and run the command again: finished stages are kept."
        with threadpool_limits(1, "blas"), plain_os_errors(folder, remedy=remedy):
            return _Capture(source, folder, settings, say).run(write_page)
    finally:
        lock.release()


@dataclass
class _Capture:
    """One capture while it runs. `poses` and `rig`, which take minutes, keep what they find."""

    source: Path
    output: Path
    settings: CaptureSettings
    say: Callable[[str], None]
    dropped: dict[str, str] = field(default_factory=dict)
    """Reason by name, for each file and frame that is left out; the stages add to this dictionary."""

    def run(self, write_page: Callable[[CaptureResult], None]) -> CaptureResult:
        """Run all stages in order and return what they found."""
        search = search_pairs(self.source, self.settings, [self.output], self.say)
        self.say(f"pairs: {len(search.pairs)}, files left out: {len(search.unpaired)}")
        self.dropped |= search.unpaired
        read = self.temperatures(search.pairs)
        found, key = self.poses(read)
        frames = [frame for frame in read.frames if frame.name in found.frames]
        scale, scale_missing = self.scale(found, frames)
        model, up = upright(found, frames)
        rig, start = self.rig(model, frames, read, scale, key)
        drift = estimate_drift(rig_frames(model, frames), rig.thermal_camera, rig.visible_to_thermal)
        self.say(f"drift: {drift.explanation}")
        moved = model.camera_to_world[0] @ np.linalg.inv(found.camera_to_world[0])
        scene = Scene(frames, model, self.kept / "poses" / MODEL_FOLDER, moved, rig, drift, scale, up)
        write_scene_folder(scene, self.output, self.say)
        result = CaptureResult(self.source, self.output, search.pairs, self.dropped, read, scene, start, scale_missing)
        write_page(result)
        return result

    def temperatures(self, pairs: tuple[Pair, ...]) -> CaptureFrames:
        """Return the frames: thermal images in degrees C, and photographs, extracted where one file holds both."""
        read = read_frames(pairs, self.source, self.kept, self.settings, self.say)
        width, height = read.thermal_size
        self.say(f"temperatures: {len(read.frames)} thermal images of {width} x {height} pixels")
        self.dropped |= read.dropped
        return read

    @property
    def kept(self) -> Path:
        """Folder of what is found before the scene is written."""
        return self.output / CACHE_FOLDER

    def poses(self, read: CaptureFrames) -> tuple[SfmModel, str]:
        """Return camera, poses and scene points, which are found from the photographs, and the key of this result."""
        settings = self.settings
        names = ("image_size", "max_features", "lens", "seed", "threads")
        depends = {
            "options": {name: getattr(settings, name) for name in names},
            "files": fingerprint([self.source / frame.name for frame in read.frames], self.source),
        }

        def work(folder: Path) -> None:
            photographs = {frame.name: frame.photograph for frame in read.frames}
            focal = [frame.focal_px for frame in read.frames if frame.focal_px]
            middle = float(np.median(focal)) if focal else None
            find_poses(photographs, read.photograph_size, folder, settings, middle, self.say)

        folder, again = self.kept / "poses", settings.from_stage == "poses"
        key = run_stage(folder, depends, work, again, self.say)
        model = read_poses(folder, [frame.name for frame in read.frames], read.photograph_size)
        self.say(f"poses: {len(model.frames)} of {len(read.frames)} frames, {len(model.points)} points")
        few = "too few matches with the largest group of photographs that fit together"
        self.dropped |= {frame.name: few for frame in read.frames if frame.name not in model.frames}
        return model, key

    def scale(self, model: SfmModel, frames: list[CaptureFrame]) -> tuple[SceneScale | None, str]:
        """Return metres per unit from markers, else from GPS; or None and the reason for None."""
        settings = self.settings
        if settings.marker_side_m is not None:
            photographs = {frame.name: frame.photograph for frame in frames}
            scale, missing = scale_from_markers(model, photographs, settings.marker_side_m, settings.marker_error_m)
        else:
            scale, missing = scale_from_gps(model.centres, [frame.gps for frame in frames])
        self.say(f"scale: {missing}" if scale is None else f"scale: {scale.metres_per_unit:.5g} m per unit")
        return scale, missing

    def rig(
        self, model: SfmModel, frames: list[CaptureFrame], read: CaptureFrames, scale: SceneScale | None, poses: str
    ) -> tuple[RigEstimate, RigEstimate]:
        """Return the rig (found from the images, or given by the user) and the start of its search.

        `poses` is the key of the result that `model` came from.
        """
        settings = self.settings
        angle, metres = settings.thermal_field_of_view_deg, None if scale is None else scale.metres_per_unit
        begin = rig_start(frames, model.camera, read.thermal_size, angle, metres)
        if settings.rig is not None:
            rig = read_rig(settings.rig, read.thermal_size, metres)
        else:
            depends = {
                "options": {each.name: getattr(settings, each.name) for each in fields(RadiometryOptions)},
                "start": [poses, angle, metres],
                "files": fingerprint([self.source / frame.thermal_source for frame in read.frames], self.source),
            }

            def work(folder: Path) -> None:
                say = lambda line: self.say(f"rig: {line}")  # noqa: E731
                save_rig(folder / "rig.npz", estimate_rig(rig_frames(model, frames), model.camera, begin, say))

            run_stage(self.kept / "rig", depends, work, settings.from_stage is not None, self.say)
            rig = load_rig(self.kept / "rig" / "rig.npz")
        self.say(f"rig: {rig.explanation}")
        return rig, begin
