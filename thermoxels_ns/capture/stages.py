"""All stages of a capture: from a folder of camera files to a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from thermoxels_ns.capture.folder_scan import SUFFIXES, files_below, scan_folder, shown_name
from thermoxels_ns.capture.frames import CaptureFrame, CaptureFrames, read_frames
from thermoxels_ns.capture.masks import PhotographMasks, find_masks, mask_files, user_masks
from thermoxels_ns.capture.pairs import Pair, PairOptions, read_pair_list, search_pairs
from thermoxels_ns.capture.rig.board import CheckerBoard, board_of, in_scene_units, rig_from_board_photos
from thermoxels_ns.capture.rig.drift import estimate_drift
from thermoxels_ns.capture.rig.search import estimate_rig
from thermoxels_ns.capture.rig.start import read_rig, rig_frames, rig_start
from thermoxels_ns.capture.rig_types import DriftEstimate, RigEstimate, with_error
from thermoxels_ns.capture.scene_writer import SCENE_CONTENT, Scene, write_scene_folder
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.feature_matching import PoseOptions
from thermoxels_ns.capture.sfm.given_poses import fitted_to_photographs, read_given_poses
from thermoxels_ns.capture.sfm.gravity import Up, find_up, level_rotation
from thermoxels_ns.capture.sfm.metric_scale import (
    MeasuredDistance,
    MetricScale,
    scale_from_distance,
    scale_from_gps,
    scale_from_markers,
)
from thermoxels_ns.capture.sfm.poses import add_points, find_poses
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.capture.stage_cache import (
    StageCache,
    files_of,
    fingerprint,
    given_fingerprints,
    locked,
    prepare_output,
)
from thermoxels_ns.core.checks import plain_os_errors, remove_stale_temporaries
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.radiometry.thermogram import RadiometryOptions

PAGE_NAME = "capture.html"  # of the page, in the output folder
_MOST_NAMED = 10  # files left out that are named while the command runs
_LEAST_SIGHTINGS = 50  # sightings of scene points below which thermal images and photographs cannot be compared

_Options = TypeVar("_Options")


@dataclass(frozen=True)
class CaptureResult:
    """What a capture found; the scene is in the output folder."""

    source: Path
    output: Path
    pairs: Sequence[Pair]
    dropped: dict[str, str]  # files and frames that are not in the scene, and why
    read: CaptureFrames
    scene: Scene
    start: RigEstimate  # where the search for the rig began
    scale_missing: str  # why there is no scale, where there is none
    poses_source: str
    seconds: Sequence[tuple[str, float]]  # stages and the time each took, [s]

    @property
    def page(self) -> Path:
        """The page about the capture."""
        return self.output / PAGE_NAME


def run_capture(
    source: Path,
    output: Path,
    settings: CaptureSettings,
    write_page: Callable[[CaptureResult], None],
    say: Callable[[str], None] = lambda _: None,
) -> CaptureResult:
    """Turn a folder of camera files into a scene, a page and the stages' results in `output`.

    `write_page` is the last stage; `say` is told how far it is, one line at a time.

    Raises:
        ThermoxelsError: A file cannot be read, there are no pairs or no poses, or an option is out of range.
        OutputError: The output cannot be written to, its disk is full, or another capture works in it.
    """
    if not source.is_dir():
        scan_folder(source)  # says what is wrong
    if source.resolve().is_relative_to(output.resolve()):
        expected = "another folder than the input, which does not hold it either"
        remedy = "Pass a new folder with --output; the camera's files stay as they are."
        raise SceneError("output", expected=expected, got=output, remedy=remedy)
    board = board_of(settings)
    if settings.board_photos is not None and not settings.board_photos.is_dir():
        scan_folder(settings.board_photos)
    folder = prepare_output(output)
    remedy = "Check free space and permissions, and run the command again: finished stages are kept."
    # Inverses and sums of BLAS depend on the number of its threads; one thread is no slower here.
    with (
        plain_os_errors(folder, "a file that can be read or written", remedy),
        locked(folder, say),
        threadpool_limits(1, "blas"),
    ):
        remove_stale_temporaries(folder, [PAGE_NAME])
        cache = StageCache(folder, settings.from_stage, say, source)
        return _Capture(source, folder, settings, cache, say, board).run(write_page)


@dataclass(frozen=True)
class _Paired:
    """Result of the stage that finds pairs."""

    pairs: tuple[Pair, ...]
    dropped: dict[str, str]  # why, by the file's name


@dataclass(frozen=True)
class _Posed:
    """Result of the stage that finds poses."""

    model: SfmModel
    dropped: dict[str, str]  # why, by the frame's name
    overlay: npt.NDArray[np.bool_] | None  # as in `PhotographMasks`


@dataclass(frozen=True)
class _Scaled:
    """Result of the stage that finds metres per unit and up."""

    model: SfmModel  # upright, if it was found here
    scale: MetricScale | None
    missing: str  # why there is no scale
    up: Up


@dataclass(frozen=True)
class _Rig:
    """Result of the stage that finds the rig."""

    found: RigEstimate
    start: RigEstimate


@dataclass
class _Capture:
    """One capture that is being made; a method for each stage."""

    source: Path
    output: Path
    settings: CaptureSettings
    cache: StageCache
    say: Callable[[str], None]
    board: CheckerBoard | None = None  # what the user's pictures of a checker board show

    def run(self, write_page: Callable[[CaptureResult], None]) -> CaptureResult:
        """Run all stages."""
        paired = self.pairs()
        read = self.temperatures(paired.pairs)
        posed = self.poses(read)
        by_name = {frame.name: frame for frame in read.frames}
        frames = [by_name[name] for name in posed.model.frames]
        scaled = self.scale(posed.model, frames)
        model = scaled.model
        rig = self.rig(scaled, frames, read, self.board_rig(model, read))
        drift = self.drift(model, frames, rig.found)
        # What the stage of the poses found drawn over the photographs, and the user's masks.
        size, drawn = (model.camera.width, model.camera.height), posed.overlay
        if drawn is not None and drawn.shape != size[::-1]:
            drawn = None
        masks = PhotographMasks(size, drawn, user_masks(frames, self.settings.masks))
        scene = Scene(frames, model, rig.found, drift, scaled.scale, scaled.up, masks)
        written = [self.output / name for name in SCENE_CONTENT]
        self.cache.run("scene", {}, lambda _: write_scene_folder(scene, self.output, self.say), written)
        given = self.settings.poses
        result = CaptureResult(
            source=self.source,
            output=self.output,
            pairs=paired.pairs,
            dropped=paired.dropped | read.dropped | posed.dropped,
            read=read,
            scene=scene,
            start=rig.start,
            scale_missing=scaled.missing,
            poses_source=f"Given in {given.name}." if given else "Structure from motion on the photographs (COLMAP).",
            seconds=self.cache.seconds,
        )
        self.cache.run("page", {}, lambda _: write_page(result), [result.page])
        return result

    def options(self, kind: type[_Options]) -> _Options:
        """Those of the user's settings that a dataclass of options has fields for."""
        settings = vars(self.settings)
        return kind(**{each.name: settings[each.name] for each in fields(kind) if each.name in settings})  # type: ignore[arg-type]

    def pairs(self) -> _Paired:
        """Find which photograph belongs to which thermal image."""
        settings, options = self.settings, self.options(PairOptions)
        inside, passed_over = files_below(self.source, [self.output])
        if settings.pairs is None:
            inside = [path for path in inside if path.suffix.lower() in SUFFIXES]
        depends = {
            "options": options,
            "files": fingerprint(inside, self.source),
            "passed_over": sorted(map(str, passed_over)),
            "list": given_fingerprints([settings.pairs]),
            "skip_bad": settings.skip_bad,
        }

        def work(_: Path) -> _Paired:
            if settings.pairs is not None:
                search, unreadable = read_pair_list(settings.pairs, self.source), dict[Path, str]()
            else:
                has_library = settings.dji_library is not None
                found = self.source, [self.output], options, settings.skip_bad, has_library
                search, unreadable = search_pairs(*found, self.say)
            self.say(f"pairs: {len(search.pairs)}, files without a partner: {len(search.unpaired)}")
            left_out = {shown_name(path, self.source): why for path, why in (unreadable | search.unpaired).items()}
            for name, why in list(left_out.items())[:_MOST_NAMED]:
                self.say(f"left out: {name}: {why}")
            if len(left_out) > _MOST_NAMED:
                self.say(f"left out: {len(left_out) - _MOST_NAMED} more; {PAGE_NAME} names all")
            return _Paired(search.pairs, left_out)

        return self.cache.result("pairs", depends, _Paired, work)

    def temperatures(self, pairs: tuple[Pair, ...]) -> CaptureFrames:
        """Read the pairs: degrees from thermal files, photographs out of files that hold both."""
        settings, options = self.settings, self.options(RadiometryOptions)
        library = settings.dji_library if settings.dji_library and settings.dji_library.is_file() else None
        depends = {
            "options": options,
            "library": given_fingerprints([library]),
            "skip_bad": settings.skip_bad,
            "mask": given_fingerprints([settings.thermal_mask]),
        }

        def work(folder: Path) -> CaptureFrames:
            read = read_frames(pairs, self.source, folder, options, settings.skip_bad, settings.thermal_mask, self.say)
            width, height = read.thermal_size
            self.say(f"temperatures: {len(read.frames)} thermal images of {width} x {height} pixels")
            return read

        return self.cache.result("temperatures", depends, CaptureFrames, work)

    def poses(self, read: CaptureFrames) -> _Posed:
        """Find camera, poses and scene points, or take those that the user gives."""
        settings, options = self.settings, self.options(PoseOptions)
        depends = {
            "options": options,
            "poses": given_fingerprints([] if settings.poses is None else files_of(settings.poses)),
            "masks": given_fingerprints([] if settings.masks is None else list(mask_files(settings.masks).values())),
            "overlays": settings.find_overlays,
        }

        def work(folder: Path) -> _Posed:
            photographs = {frame.name: frame.photograph for frame in read.frames}
            masks = find_masks(read.frames, settings.masks, settings.find_overlays)
            if masks.overlay is not None:
                self.say(f"masks: {100 * (1 - masks.overlay.mean()):.1f} % of every photograph is drawn over")
            if settings.poses is None:
                focal = [frame.focal_px for frame in read.frames if frame.focal_px]
                middle = float(np.median(focal)) if focal else None
                poses = find_poses(photographs, folder, middle, masks, options, self.say)
            else:
                given = read_given_poses(settings.poses, {f.name: f.photograph_source for f in read.frames})
                poses = fitted_to_photographs(given, photographs)
                if not len(poses.model.points):
                    model = add_points(poses.model, photographs, folder, masks, options, self.say)
                    poses = replace(poses, model=model)
            model = poses.model
            self.say(f"poses: {len(model.frames)} of {len(read.frames)} frames, {len(model.points)} points")
            return _Posed(model, dict(poses.dropped), masks.overlay)

        return self.cache.result("poses", depends, _Posed, work)

    def scale(self, found: SfmModel, frames: list[CaptureFrame]) -> _Scaled:
        """Find metres per unit and up; turn a model that was found here upright, keep one that was given."""
        settings = self.settings
        depends = {
            "known": [settings.known_distance, settings.known_distance_error_m],
            "markers": [settings.marker_side_m, settings.marker_error_m],
        }

        def work(_: Path) -> _Scaled:
            scale, missing = self._metric_scale(found, frames)
            gimbal, orientation = [frame.gimbal_deg for frame in frames], [frame.orientation for frame in frames]
            up = find_up(found.camera_to_world, gimbal, orientation)
            model = found
            if settings.poses is None:
                rotation = level_rotation(up.direction, -found.camera_to_world[:, :3, 2].mean(axis=0))
                origin = np.median(found.points, axis=0) if len(found.points) else found.centres.mean(axis=0)
                model = found.moved(rotation, origin)
                up = replace(up, direction=rotation @ up.direction)
            self.say(f"scale: {missing}" if scale is None else f"scale: {scale.metres_per_unit:.5g} m per unit")
            return _Scaled(model, scale, missing, up)

        return self.cache.result("scale", depends, _Scaled, work)

    def _metric_scale(self, model: SfmModel, frames: list[CaptureFrame]) -> tuple[MetricScale | None, str]:
        """Metres per unit from the surest source that there is; where there is none, why."""
        settings = self.settings
        if settings.known_distance is not None:
            name, x0, y0, x1, y1, metres = settings.known_distance
            measured = MeasuredDistance(name, (x0, y0), (x1, y1), metres, settings.known_distance_error_m)
            return scale_from_distance(model, measured, {f.name: f.photograph_source for f in frames}), ""
        if settings.marker_side_m is not None:
            photographs = {frame.name: frame.photograph for frame in frames}
            return scale_from_markers(model, photographs, settings.marker_side_m, settings.marker_error_m)
        return scale_from_gps(model.centres, [frame.gps for frame in frames])

    def board_rig(self, model: SfmModel, read: CaptureFrames) -> RigEstimate | None:
        """Find the rig in metres where the user has pictures of a checker board; None: there are none."""
        board, pictures, settings = self.board, self.settings.board_photos, self.settings
        if board is None or pictures is None:
            self.cache.leave_out("board", "no --board-photos")
            return None
        angle = settings.thermal_field_of_view_deg
        depends = {"board": board, "files": fingerprint(files_of(pictures), pictures), "angle": angle}

        def work(folder: Path) -> RigEstimate:
            radiometry, size = self.options(RadiometryOptions), read.thermal_size
            return rig_from_board_photos(pictures, board, model.camera, size, folder, settings, radiometry, self.say)

        return self.cache.result("board", depends, RigEstimate, work)

    def rig(self, scaled: _Scaled, frames: list[CaptureFrame], read: CaptureFrames, board: RigEstimate | None) -> _Rig:
        """Find the rig, or take the one that the user or a checker board gives."""
        settings, model, scale = self.settings, scaled.model, scaled.scale
        depends = {"angle": settings.thermal_field_of_view_deg, "rig": given_fingerprints([settings.rig])}

        def work(_: Path) -> _Rig:
            metres = None if scale is None else scale.metres_per_unit
            begin = rig_start(frames, model.camera, read.thermal_size, settings.thermal_field_of_view_deg, metres)
            if settings.rig is not None:
                rig = read_rig(settings.rig, read.thermal_size, metres)
            elif board is not None:
                rig = in_scene_units(board, scale, scaled.missing)
            elif len(model.sighting_frame) < _LEAST_SIGHTINGS:
                rig = begin.kept("there are no scene points to compare the images at")
            else:

                def tell(message: str, share: float) -> None:
                    self.say(f"rig: {message} ({100 * share:.0f} %)")

                rig = estimate_rig(rig_frames(model, frames), model.camera, begin, tell)
            self.say(f"rig: {rig_line(rig, metres)}")
            return _Rig(rig, begin.kept("where the search begins"))

        return self.cache.result("rig", depends, _Rig, work)

    def drift(self, model: SfmModel, frames: list[CaptureFrame], rig: RigEstimate) -> DriftEstimate:
        """Find how far each thermal image reads too high, unless the user switched that off."""

        def work(_: Path) -> DriftEstimate:
            if self.settings.drift == "off" or len(model.sighting_frame) < _LEAST_SIGHTINGS:
                why = "Switched off." if self.settings.drift == "off" else "There are no scene points to compare at."
                drift = DriftEstimate(np.zeros(len(frames)), (), np.nan, np.nan, False, why)
            else:
                drift = estimate_drift(rig_frames(model, frames), rig.thermal_camera, rig.visible_to_thermal)
            self.say(f"drift: {drift.explanation}")
            return drift

        return self.cache.result("drift", {"drift": self.settings.drift}, DriftEstimate, work)


def rig_line(rig: RigEstimate, metres_per_unit: float | None) -> str:
    """Say shortly what was found; of a rig that is given or not determined its explanation."""
    if not rig.determined or not np.isfinite(rig.projection_sigma_px):
        return rig.explanation
    focal_px = rig.thermal_camera.fl_x
    focal = with_error(focal_px, rig.standard_errors.get("log_focal", np.nan) * focal_px, 1)
    distance = float(np.linalg.norm(rig.visible_to_thermal[:3, 3]))
    apart = f"{distance:.3g} units" if metres_per_unit is None else f"{100.0 * distance * metres_per_unit:.1f} cm"
    turn = with_error(rig.turn_deg, rig.turn_error_deg, 2)
    points = f"points fall within {rig.projection_sigma_px:.2f} thermal pixels (standard error)"
    return f"turned by {turn} degrees, {apart} apart, focal length {focal} pixels; {points}"
