"""All stages of a capture in order: from a folder of camera files to a scene and a page about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from thermoxels_ns.capture import results
from thermoxels_ns.capture.board_photos import board_of, in_scene_units, rig_from_board_photos
from thermoxels_ns.capture.board_rig import CheckerBoard
from thermoxels_ns.capture.camera_files import SUFFIXES, files_below, scan_folder, shown_name
from thermoxels_ns.capture.contract import DriftEstimate, RigEstimate
from thermoxels_ns.capture.drift import estimate_drift
from thermoxels_ns.capture.frame_masks import find_masks, user_masks
from thermoxels_ns.capture.frames import CaptureFrame, CaptureFrames, read_frames
from thermoxels_ns.capture.given_poses import fitted_to_photographs, in_order, read_given_poses
from thermoxels_ns.capture.gravity import Up, find_up, level_rotation
from thermoxels_ns.capture.masks import PhotographMasks, mask_files
from thermoxels_ns.capture.metric_scale import (
    MeasuredDistance,
    MetricScale,
    scale_from_distance,
    scale_from_gps,
    scale_from_markers,
)
from thermoxels_ns.capture.no_pairs import no_pairs
from thermoxels_ns.capture.pairs import Pair, PairOptions, find_pairs, read_pair_list
from thermoxels_ns.capture.poses import PoseOptions, add_points, find_poses
from thermoxels_ns.capture.report import Findings, report_page
from thermoxels_ns.capture.rig import estimate_rig
from thermoxels_ns.capture.rig_inputs import kept_start, read_rig, rig_frames, rig_start
from thermoxels_ns.capture.scene_writer import JSON_NAME, POINTS_NAME, TRACKS_NAME, Scene, write_scene_folder
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm_model import SfmModel
from thermoxels_ns.capture.stages import (
    CACHE_FOLDER,
    StageCache,
    files_of,
    fingerprint,
    given_fingerprints,
    prepare_output,
    read_json,
    write_json,
)
from thermoxels_ns.checks import remove_stale_temporaries
from thermoxels_ns.data.radiometry import RadiometryOptions
from thermoxels_ns.errors import OutputError, SceneError, ThermoxelsError, explain

PAGE_NAME = "capture.html"
_MOST_NAMED = 10
"""Files left out that are named while the command runs."""
_LEAST_POINTS = 50
"""Sightings of scene points below which thermal images and photographs cannot be compared."""
_OVERLAY_FILE = "overlay.npy"


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
    """
    if not source.is_dir():
        scan_folder(source)  # says what is wrong
    if source.resolve().is_relative_to(output.resolve()):
        raise SceneError(
            explain(
                "output",
                expected="another folder than the input, which does not hold it either",
                got=output,
                remedy="Pass a new folder with --output; the camera's files stay as they are.",
            )
        )
    board = board_of(settings)
    if settings.board_photos is not None and not settings.board_photos.is_dir():
        scan_folder(settings.board_photos)
    folder = prepare_output(output)
    remove_stale_temporaries(folder, [PAGE_NAME])
    try:
        return _Run(source, folder, settings, StageCache(folder, settings.from_stage, say), say, board).all()
    except ThermoxelsError:
        raise
    except OSError as problem:
        raise OutputError(
            explain(
                str(problem.filename2 or problem.filename or folder),
                expected="a file that can be read or written",
                got=problem.strerror or str(problem),
                remedy="Check free space and permissions, and run the command again: finished stages are kept.",
            )
        ) from problem


@dataclass
class _Run:
    source: Path
    output: Path
    settings: CaptureSettings
    cache: StageCache
    say: Callable[[str], None]
    board: CheckerBoard | None = None
    """What the user's pictures of a checker board show."""
    dropped: dict[str, str] = field(default_factory=dict)

    def all(self) -> CaptureResult:
        pairs = self.find_pairs()
        read = self.read_temperatures(pairs)
        found = self.find_poses(read)
        model, scale, missing, up = self.find_scale(found, read)
        by_name = {frame.name: frame for frame in read.frames}
        frames = [by_name[name] for name in model.frames]
        board = self.find_board_rig(model, read)
        rig, start = self.find_rig(model, frames, read, scale, missing, board)
        drift = self.find_drift(model, frames, rig)
        scene = Scene(frames, model, rig, drift, scale, up, self.masks(frames, model))
        written = [self.output / name for name in (JSON_NAME, POINTS_NAME, TRACKS_NAME, "images", "thermal", "masks")]
        self.cache.run("scene", {}, lambda _: self._write_scene(scene), written)
        findings = Findings(
            source=self.source,
            pairs=pairs,
            dropped=self.dropped,
            read=read,
            scene=scene,
            start=start,
            scale_missing=missing,
            poses_source=self._poses_source(),
            seconds=self.cache.seconds,
        )
        page = self.output / PAGE_NAME
        self.cache.run("page", {}, lambda _: report_page(findings, page), [page])
        return CaptureResult(
            self.output / JSON_NAME, page, len(pairs), len(frames), self.dropped, rig, drift, scale, missing
        )

    def find_pairs(self) -> tuple[Pair, ...]:
        settings = self.settings
        options = PairOptions(settings.time_limit_s, settings.clock_offset_s)
        listed = [] if settings.pairs is None else [settings.pairs]
        inside, passed_over = files_below(self.source, [self.output])
        if settings.pairs is None:
            inside = [path for path in inside if path.suffix.lower() in SUFFIXES]
        depends = {
            "options": options,
            "files": fingerprint(inside, self.source),
            "passed_over": sorted(map(str, passed_over)),
            "list": given_fingerprints(listed),
            "skip_bad": settings.skip_bad,
        }

        def work(folder: Path) -> None:
            unreadable: dict[Path, str] = {}
            if settings.pairs is not None:
                search = read_pair_list(settings.pairs, self.source)
            else:
                found = scan_folder(self.source, [self.output], self.say)
                search, unreadable = find_pairs(found, options), found.unreadable
                if unreadable and not settings.skip_bad:
                    first = next(iter(unreadable.values()))
                    more = f" {len(unreadable) - 1} more cannot be read." if len(unreadable) > 1 else ""
                    remedy = "" if "--skip-bad" in first else " To go on without such files, pass --skip-bad True."
                    raise SceneError(f"{first}{more}{remedy}")
                if not search.pairs:
                    raise no_pairs(found, search.unpaired, settings.dji_library is not None)
            results.save_pairs(folder, search, self.source)
            write_json(folder / "unreadable.json", {shown_name(path): why for path, why in unreadable.items()})
            self.say(f"pairs: {len(search.pairs)}, files without a partner: {len(search.unpaired)}")
            left_out = [(shown_name(path), why) for path, why in (unreadable | search.unpaired).items()]
            for name, why in left_out[:_MOST_NAMED]:
                self.say(f"left out: {name}: {why}")
            if len(left_out) > _MOST_NAMED:
                self.say(f"left out: {len(left_out) - _MOST_NAMED} more; {PAGE_NAME} names all")

        folder = self.cache.run("pairs", depends, work)
        pairs, unpaired = results.load_pairs(folder, self.source)
        self.dropped |= read_json(folder / "unreadable.json") | unpaired
        return pairs

    def read_temperatures(self, pairs: tuple[Pair, ...]) -> CaptureFrames:
        settings = self.settings
        options = self.radiometry()
        library = settings.dji_library if settings.dji_library and settings.dji_library.is_file() else None
        depends = {
            "options": options,
            "library": given_fingerprints([library]),
            "skip_bad": settings.skip_bad,
            "mask": given_fingerprints([settings.thermal_mask]),
        }

        def work(folder: Path) -> None:
            read = read_frames(pairs, self.source, folder, options, settings.skip_bad, settings.thermal_mask, self.say)
            self.say(
                f"temperatures: {len(read.frames)} thermal images of {read.thermal_size[0]} x "
                f"{read.thermal_size[1]} pixels"
            )

        read = CaptureFrames.load(self.cache.run("temperatures", depends, work), self.source)
        self.dropped |= read.dropped
        return read

    def radiometry(self) -> RadiometryOptions:
        settings = self.settings
        return RadiometryOptions(
            camera=settings.camera,
            celsius_per_count=settings.celsius_per_count,
            celsius_offset=settings.celsius_offset,
            dji_library=settings.dji_library,
            emissivity=settings.emissivity,
            reflected_c=settings.reflected_c,
            distance_m=settings.distance_m,
            relative_humidity=settings.relative_humidity,
            air_c=settings.air_c,
        )

    def find_poses(self, read: CaptureFrames) -> SfmModel:
        settings = self.settings
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
                self.say(f"masks: {100 * (1 - masks.overlay.mean()):.1f} % of every photograph is drawn over")
            if settings.poses is None:
                focal = [frame.focal_px for frame in read.frames if frame.focal_px]
                poses = find_poses(
                    photographs, folder, float(np.median(focal)) if focal else None, masks, options, self.say
                )
                order = {name: number for number, name in enumerate(photographs)}
                model = in_order(poses.model, lambda name: order[name])
            else:
                given = read_given_poses(settings.poses, {f.name: f.photograph_source for f in read.frames})
                poses = fitted_to_photographs(given, photographs)
                model = poses.model
                if not len(model.points):
                    model = add_points(model, photographs, folder, masks, options, self.say)
            results.save_model(folder, model)
            write_json(folder / "dropped.json", dict(poses.dropped))
            self.say(f"poses: {len(model.frames)} of {len(read.frames)} frames, {len(model.points)} points")

        folder = self.cache.run("poses", depends, work)
        self.dropped |= read_json(folder / "dropped.json")
        return results.load_model(folder)

    def find_scale(self, found: SfmModel, read: CaptureFrames) -> tuple[SfmModel, MetricScale | None, str, Up]:
        settings = self.settings
        depends = {
            "known": [settings.known_distance, settings.known_distance_error_m],
            "markers": [settings.marker_side_m, settings.marker_error_m],
        }
        by_name = {frame.name: frame for frame in read.frames}
        frames = [by_name[name] for name in found.frames]

        def work(folder: Path) -> None:
            scale, missing = self._metric_scale(found, frames)
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
            self.say(f"scale: {missing}" if scale is None else f"scale: {scale.metres_per_unit:.5g} m per unit")

        folder = self.cache.run("scale", depends, work)
        return results.load_model(folder), *results.load_scale(folder)

    def find_board_rig(self, model: SfmModel, read: CaptureFrames) -> RigEstimate | None:
        """The rig in metres, where the user has pictures of a checker board; None: there are none."""
        board, pictures, settings = self.board, self.settings.board_photos, self.settings
        if board is None or pictures is None:
            return None
        depends = {
            "board": board,
            "files": fingerprint(files_of(pictures), pictures),
            "angle": settings.thermal_field_of_view_deg,
        }

        def work(folder: Path) -> None:
            radiometry = self.radiometry()
            rig = rig_from_board_photos(
                pictures, board, model.camera, read.thermal_size, folder, settings, radiometry, self.say
            )
            results.save_rig(folder, rig)

        return results.load_rig(self.cache.run("board", depends, work))

    def find_rig(
        self,
        model: SfmModel,
        frames: list[CaptureFrame],
        read: CaptureFrames,
        scale: MetricScale | None,
        scale_missing: str,
        board: RigEstimate | None,
    ) -> tuple[RigEstimate, RigEstimate]:
        settings = self.settings
        depends = {"angle": settings.thermal_field_of_view_deg, "rig": given_fingerprints([settings.rig])}

        def work(folder: Path) -> None:
            metres = None if scale is None else scale.metres_per_unit
            begin = rig_start(frames, model.camera, read.thermal_size, settings.thermal_field_of_view_deg, metres)
            results.save_rig(folder, kept_start(begin, "Where the search begins."), "start")
            if settings.rig is not None:
                rig = read_rig(settings.rig, read.thermal_size, metres)
            elif board is not None:
                rig = in_scene_units(board, scale, scale_missing)
            elif len(model.sighting_frame) < _LEAST_POINTS:
                rig = kept_start(begin, "There are no scene points to compare the images at.")
            else:
                rig = estimate_rig(
                    rig_frames(model, frames),
                    model.camera,
                    begin,
                    lambda message, share: self.say(f"rig: {message} ({100 * share:.0f} %)"),
                )
            results.save_rig(folder, rig)
            self.say(f"rig: {rig.explanation}")

        folder = self.cache.run("rig", depends, work)
        return results.load_rig(folder), results.load_rig(folder, "start")

    def find_drift(self, model: SfmModel, frames: list[CaptureFrame], rig: RigEstimate) -> DriftEstimate:
        def work(folder: Path) -> None:
            if self.settings.drift == "off" or len(model.sighting_frame) < _LEAST_POINTS:
                why = "Switched off." if self.settings.drift == "off" else "There are no scene points to compare at."
                drift = DriftEstimate(np.zeros(len(frames)), (), np.nan, np.nan, False, why)
            else:
                drift = estimate_drift(rig_frames(model, frames), rig.thermal_camera, rig.visible_to_thermal)
            results.save_drift(folder, drift)
            self.say(f"drift: {drift.explanation}")

        return results.load_drift(self.cache.run("drift", {"drift": self.settings.drift}, work))

    def masks(self, frames: list[CaptureFrame], model: SfmModel) -> PhotographMasks:
        size = (model.camera.width, model.camera.height)
        file = self.output / CACHE_FOLDER / "poses" / _OVERLAY_FILE
        drawn = np.load(file) if file.is_file() else None
        if drawn is not None and drawn.shape != (size[1], size[0]):
            drawn = None
        return PhotographMasks(size, drawn, user_masks(frames, self.settings.masks))

    def _metric_scale(self, model: SfmModel, frames: list[CaptureFrame]) -> tuple[MetricScale | None, str]:
        settings = self.settings
        if settings.known_distance is not None:
            name, x0, y0, x1, y1, metres = settings.known_distance
            measured = MeasuredDistance(name, (x0, y0), (x1, y1), metres, settings.known_distance_error_m)
            return scale_from_distance(model, measured, {f.name: f.photograph_source for f in frames}), ""
        if settings.marker_side_m is not None:
            photographs = {frame.name: frame.photograph for frame in frames}
            return scale_from_markers(model, photographs, settings.marker_side_m, settings.marker_error_m)
        return scale_from_gps(model.centres, [frame.gps for frame in frames])

    def _write_scene(self, scene: Scene) -> None:
        write_scene_folder(scene, self.output, self.say)

    def _poses_source(self) -> str:
        if self.settings.poses is not None:
            return f"Given in {self.settings.poses.name}."
        return "Structure from motion on the photographs (COLMAP)."
