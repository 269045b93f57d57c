"""All stages of a capture: from a folder of camera files to a scene."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from thermoxels_ns.capture.folder_scan import SUFFIXES, files_below, scan_folder
from thermoxels_ns.capture.frames import CaptureFrame, CaptureFrames, read_frames
from thermoxels_ns.capture.pairs import Pair, search_pairs
from thermoxels_ns.capture.rig.drift import estimate_drift, no_drift
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.rig.start import kept_start, read_rig, rig_frames, rig_start
from thermoxels_ns.capture.rig_types import DriftEstimate, RigEstimate
from thermoxels_ns.capture.scene_writer import SCENE_CONTENT, Scene, write_scene_folder
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.poses import find_poses
from thermoxels_ns.capture.sfm.scale_and_up import (
    Up,
    find_up,
    level_rotation,
    scale_from_distance,
    scale_from_gps,
    scale_from_markers,
)
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.capture.stage_cache import (
    CACHE_FOLDER,
    StageCache,
    fingerprint,
    given_fingerprints,
    load,
    load_json,
    prepare_output,
    save,
)
from thermoxels_ns.core.checks import hold_folder, plain_os_errors
from thermoxels_ns.core.errors import SceneError, printable
from thermoxels_ns.core.json_values import write_json
from thermoxels_ns.data.scene_scale import SceneScale
from thermoxels_ns.radiometry.thermogram import RadiometryOptions

PAGE_NAME = "capture.html"  # file name of the report, in the output folder
_MOST_NAMED = 10  # how many of the files left out are named while the command runs; the page names all
_LEAST_SIGHTINGS = 50  # with fewer sightings of scene points, thermal images and photographs cannot be compared


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
    seconds: Sequence[tuple[str, float]]  # stages and the time each took, [s]

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

    The last stage calls `write_page`, which writes the report. `say` is called with one line of progress at a time.

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
            cache = StageCache(folder, settings.from_stage, say)
            return _Capture(source, folder, settings, cache, say).run(write_page)
    finally:
        lock.release()


@dataclass
class _Capture:
    """One capture while it runs; each public method runs one stage, except `run`."""

    source: Path
    output: Path
    settings: CaptureSettings
    cache: StageCache
    say: Callable[[str], None]
    dropped: dict[str, str] = field(default_factory=dict)
    """Reason by name, for each file and frame that is left out; the stages add to this dictionary."""

    def run(self, write_page: Callable[[CaptureResult], None]) -> CaptureResult:
        """Run all stages in order and return what they found."""
        pairs = self.pairs()
        read = self.temperatures(pairs)
        found = self.poses(read)
        model, scale, scale_missing, up = self.scale(found, read)
        by_name = {frame.name: frame for frame in read.frames}
        frames = [by_name[name] for name in model.frames]
        rig, start = self.rig(model, frames, read, scale)
        drift = self.drift(model, frames, rig)
        scene = Scene(frames, model, rig, drift, scale, up)
        written = [self.output / name for name in SCENE_CONTENT]
        self.cache.run("scene", {}, lambda _: write_scene_folder(scene, self.output, self.say), written)
        left_out, seconds = self.dropped, self.cache.seconds
        result = CaptureResult(self.source, self.output, pairs, left_out, read, scene, start, scale_missing, seconds)
        self.cache.run("page", {}, lambda _: write_page(result), [result.page])
        return result

    @property
    def radiometry(self) -> RadiometryOptions:
        """The user's settings of the same names."""
        given = vars(self.settings)
        return RadiometryOptions(**{each.name: given[each.name] for each in fields(RadiometryOptions)})

    def pairs(self) -> tuple[Pair, ...]:
        """Return the pairs of photograph and thermal image that are found in the folder."""
        settings = self.settings
        inside = [path for path in files_below(self.source, [self.output]) if path.suffix.lower() in SUFFIXES]
        depends = {
            "times": [settings.time_limit_s, settings.clock_offset_s],
            "files": fingerprint(inside, self.source),
            "skip_bad": settings.skip_bad,
        }

        def name_of(path: Path) -> str:
            return Path(os.path.relpath(path, self.source)).as_posix()

        def work(folder: Path) -> None:
            search = search_pairs(self.source, settings, [self.output], self.say)
            rows = [(each.name, name_of(each.photograph), name_of(each.thermal), each.how) for each in search.pairs]
            left_out = {printable(name_of(path)): why for path, why in search.unpaired.items()}
            write_json(folder / "pairs.json", {"pairs": rows, "left_out": left_out})
            self.say(f"pairs: {len(search.pairs)}, files left out: {len(search.unpaired)}")
            for name, why in list(left_out.items())[:_MOST_NAMED]:
                self.say(f"left out: {name}: {why}")
            if len(left_out) > _MOST_NAMED:
                self.say(f"left out: {len(left_out) - _MOST_NAMED} more; {PAGE_NAME} names all")

        content = load_json(self.cache.run("pairs", depends, work) / "pairs.json")
        self.dropped |= content["left_out"]
        return tuple(Pair(name, self.source / a, self.source / b, how) for name, a, b, how in content["pairs"])

    def temperatures(self, pairs: tuple[Pair, ...]) -> CaptureFrames:
        """Return the frames: thermal images in degrees C, and photographs, extracted where one file holds both."""
        settings, options = self.settings, self.radiometry
        library = settings.dji_library if settings.dji_library and settings.dji_library.is_file() else None
        depends = {"options": options, "library": given_fingerprints([library]), "skip_bad": settings.skip_bad}

        def work(folder: Path) -> None:
            read = read_frames(pairs, self.source, folder, options, settings.skip_bad, self.say)
            width, height = read.thermal_size
            self.say(f"temperatures: {len(read.frames)} thermal images of {width} x {height} pixels")

        read = CaptureFrames.load(self.cache.run("temperatures", depends, work), self.source)
        self.dropped |= read.dropped
        return read

    def poses(self, read: CaptureFrames) -> SfmModel:
        """Return camera, poses and scene points, which are found from the photographs."""
        settings = self.settings
        names = ("image_size", "max_features", "lens", "seed", "threads")
        depends = {"options": {name: getattr(settings, name) for name in names}}

        def work(folder: Path) -> None:
            photographs = {frame.name: frame.photograph for frame in read.frames}
            focal = [frame.focal_px for frame in read.frames if frame.focal_px]
            middle = float(np.median(focal)) if focal else None
            model, dropped = find_poses(photographs, folder, settings, middle, self.say)
            save(folder / "model.npz", model)
            write_json(folder / "dropped.json", dropped)
            self.say(f"poses: {len(model.frames)} of {len(read.frames)} frames, {len(model.points)} points")

        folder = self.cache.run("poses", depends, work)
        self.dropped |= load_json(folder / "dropped.json")
        return load(folder / "model.npz", SfmModel)

    def scale(self, found: SfmModel, read: CaptureFrames) -> tuple[SfmModel, SceneScale | None, str, Up]:
        """Return the model turned upright, scale or None, reason for None, and up."""
        settings = self.settings
        markers = [settings.marker_side_m, settings.marker_error_m]
        depends = {"known": settings.known_distance, "markers": markers}
        by_name = {frame.name: frame for frame in read.frames}
        frames = [by_name[name] for name in found.frames]

        def work(folder: Path) -> None:
            scale, missing = self._metric_scale(found, frames)
            gimbal, orientation = [frame.gimbal_deg for frame in frames], [frame.orientation for frame in frames]
            up = find_up(found.camera_to_world, gimbal, orientation)
            rotation = level_rotation(up.direction, -found.camera_to_world[:, :3, 2].mean(axis=0))
            origin = np.median(found.points, axis=0) if len(found.points) else found.centres.mean(axis=0)
            model = found.moved(rotation, origin)
            up = Up(rotation @ up.direction, up.source, up.spread_deg)
            save(folder / "model.npz", model)
            write_json(folder / "scale.json", {"scale": scale, "missing": missing, "up": up})
            self.say(f"scale: {missing}" if scale is None else f"scale: {scale.metres_per_unit:.5g} m per unit")

        folder = self.cache.run("scale", depends, work)
        content = load_json(folder / "scale.json")
        scale, up = content["scale"], content["up"]
        up["direction"] = np.array(up["direction"], dtype=np.float64)
        scale = None if scale is None else SceneScale(**scale)
        return load(folder / "model.npz", SfmModel), scale, content["missing"], Up(**up)

    def _metric_scale(self, model: SfmModel, frames: list[CaptureFrame]) -> tuple[SceneScale | None, str]:
        """Return metres per unit from a known distance, else markers, else GPS; or None and the reason for None."""
        settings = self.settings
        if settings.known_distance is not None:
            files = {frame.name: frame.photograph_source for frame in frames}
            return scale_from_distance(model, settings.known_distance, files), ""
        if settings.marker_side_m is not None:
            photographs = {frame.name: frame.photograph for frame in frames}
            return scale_from_markers(model, photographs, settings.marker_side_m, settings.marker_error_m)
        return scale_from_gps(model.centres, [frame.gps for frame in frames])

    def rig(
        self, model: SfmModel, frames: list[CaptureFrame], read: CaptureFrames, scale: SceneScale | None
    ) -> tuple[RigEstimate, RigEstimate]:
        """Return the rig (found from the images, or given by the user) and the start of its search."""
        settings = self.settings
        angle, metres = settings.thermal_field_of_view_deg, None if scale is None else scale.metres_per_unit
        begin = rig_start(frames, model.camera, read.thermal_size, angle, metres)
        depends = {"angle": angle, "rig": given_fingerprints([settings.rig])}

        def work(folder: Path) -> None:
            if settings.rig is not None:
                rig = read_rig(settings.rig, read.thermal_size, metres)
            elif len(model.sighting_frame) < _LEAST_SIGHTINGS:
                rig = kept_start(begin, "There are no scene points to compare the images at.")
            else:
                rig = estimate_rig(
                    rig_frames(model, frames), model.camera, begin, lambda line: self.say(f"rig: {line}")
                )
            save(folder / "rig.npz", rig)
            self.say(f"rig: {rig.explanation}")

        rig = load(self.cache.run("rig", depends, work) / "rig.npz", RigEstimate)
        return rig, kept_start(begin, "Where the search begins.")

    def drift(self, model: SfmModel, frames: list[CaptureFrame], rig: RigEstimate) -> DriftEstimate:
        """Return how far each thermal image reads too high; all zeros if switched off or without scene points."""

        def work(folder: Path) -> None:
            if self.settings.drift == "off" or len(model.sighting_frame) < _LEAST_SIGHTINGS:
                why = "Switched off." if self.settings.drift == "off" else "There are no scene points to compare at."
                drift = no_drift(len(frames), why)
            else:
                drift = estimate_drift(rig_frames(model, frames), rig.thermal_camera, rig.visible_to_thermal)
            save(folder / "drift.npz", drift)
            self.say(f"drift: {drift.explanation}")

        folder = self.cache.run("drift", {"drift": self.settings.drift}, work)
        return load(folder / "drift.npz", DriftEstimate)
