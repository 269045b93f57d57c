"""nerfstudio dataparser for scenes of paired colour and thermal photographs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Optional

import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError, ThermalFileError
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.units import ZERO_CELSIUS_K, TemperatureRange
from thermoxels_ns.data.colmap_tracks import TrackSource, find_feature_rays
from thermoxels_ns.data.pose_refinement import PoseSource, refine_poses
from thermoxels_ns.data.scene_box import BoxEvidence, find_scene_box
from thermoxels_ns.data.scene_file import BOUNDS_NAME, Frame, SceneFile, read_scene_file
from thermoxels_ns.radiometry.thermal_pixels import ThermalUnit, find_dead_pixels, read_thermal_file

SCENE_SIZE = 2.0  # longest side of the scene box in nerfstudio's world; learning rates of the field rely on it
_FAR_SIDES = 16.0
"""Farther from the origin than this many times its longest side, as in national coordinates, a box is far: shifts in
single precision are then off by more than a millionth of it."""
_LEAST_THAT_MEETS = 0.01  # share of the rays that must meet the scene box
_COLDEST_SKY_K = 150.0  # How far a clear sky may be below the lowest temperature that somebody declares, [K]
_LEAST_OF_KELVINS, _SAME_PLACE_K = 200.0, 40.0
"""Median from which on a file may hold kelvins, and how far it may then be from the other files."""
_MOST_FRAMES = 64  # frames per resolution that the search for dead pixels keeps in memory


SplitMode = Literal["auto", "filename", "lists", "interval"]
_KEYS = {"train": "train_filenames", "val": "val_filenames", "test": "test_filenames"}


@dataclass
class ThermalDataParserConfig(DataParserConfig):
    """Scenes of paired colour and thermal photographs: ThermoScenes layout, or a thermal camera of its own."""

    _target: type = field(default_factory=lambda: ThermalDataParser)
    """Class to instantiate."""
    data: Path = Path()
    """Scene folder (with transforms.json or transforms_thermal.json), or the json itself."""
    downscale_factor: Optional[int] = None  # noqa: UP045 - read by tyro
    """Divide the resolution of the colour photographs by this; they are resized when loaded, nothing is written.
    Thermal images keep their resolution. Default: full resolution."""
    scene_box: Optional[tuple[tuple[float, float, float], tuple[float, float, float]]] = None  # noqa: UP045
    """Box to reconstruct, in the coordinates of the input poses: xmin ymin zmin xmax ymax zmax. Default: scene_box in
    the json, else from the sparse points, else from depths that photographs agree on, else from the cameras."""
    eval_mode: SplitMode = "auto"
    """Which frames evaluate. auto takes the first that the scene has: names with frame_train_ / frame_eval_, the lists
    train_filenames / val_filenames / test_filenames in the json, every eval_interval-th frame."""
    eval_interval: int = 8
    """Every n-th frame by sorted name evaluates (eval_mode interval), from half of it on, so that the ends of the
    sequence stay in training."""
    missing_thermal: Literal["error", "skip"] = "error"
    """A frame without a thermal image: stop, or leave the frame out and name it."""
    valid_range_c: tuple[float, float] = (-100.0, 2000.0)
    """Temperatures outside this range are masked, in degrees Celsius."""
    tracks: TrackSource = "auto"
    """Which photographs saw which points, from structure from motion: they tell training what is air. auto: the file
    that the json names (tracks_file_path), else a COLMAP model in the scene's folder (colmap/sparse/0, colmap or
    sparse/0) whose poses are those of the json; given: only the file; off: none."""
    refine_poses: PoseSource = "auto"
    """Whose poses train. auto: where the scene has no tracks, and features that photographs share fit better with
    poses adjusted to them (bundle adjustment), those; given: the json's."""


@dataclass(frozen=True)
class ThermalSurvey:
    """What the thermal files of a scene have in common."""

    shapes: dict[Path, tuple[int, int]]  # height and width of every file
    temperature_range: TemperatureRange
    """From temperature_bounds.json and the extremes of the training files' valid pixels."""
    dead_pixels: dict[tuple[int, int], npt.NDArray[np.bool_]]  # mask of stuck pixels for every resolution that has some


@dataclass(frozen=True)
class _World:
    """The way from input coordinates to nerfstudio's: p_ns = scale * (p + translation); the axes stay.

    The middle of the scene box goes to the origin, and its longest side becomes `SCENE_SIZE`.
    """

    translation: npt.NDArray[np.float64]
    scale: float

    def poses(self, poses: npt.NDArray[np.float64]) -> torch.Tensor:
        """Move camera-to-world matrices, shape (n, 4, 4), to shape (n, 3, 4) float32."""
        moved = poses[:, :3].copy()
        moved[:, :, 3] = self.scale * (poses[:, :3, 3] + self.translation)
        return torch.from_numpy(moved.astype(np.float32))

    @property
    def transform(self) -> torch.Tensor:
        """nerfstudio's dataparser_transform, shape (3, 4): rotation and translation before the scale."""
        return torch.from_numpy(np.column_stack([np.eye(3), self.translation]).astype(np.float32))


@dataclass(frozen=True)
class _Scene:
    """All that training and evaluation share; made from all frames, so that both agree."""

    file: SceneFile
    split: Split
    survey: ThermalSurvey
    world: _World
    box: SceneBox
    input_box: tuple[tuple[float, ...], ...]  # the same in input coordinates
    pixel_size: float  # width of a photograph's pixel where most of what is seen stands, in nerfstudio's world
    feature_rays: FeatureRays | None  # what the training photographs see of the tracks; nerfstudio's world
    adjusted: bool  # whether the poses of training photographs are others than the json's
    fitted: dict[int, npt.NDArray[np.float64]]
    """Poses (4, 4) that held-out photographs themselves say, in input coordinates, by number of the frame."""


class ThermalDataParser(DataParser):
    """Reads a scene of paired photographs; see `ThermalDataParserConfig`.

    The outputs' metadata hold: ``temperature_range`` (`TemperatureRange`), ``thermal_filenames``, ``thermal_cameras``
    (`Cameras` of the split, or None where a pair shares camera and resolution), ``thermal_unit``, ``valid_range_c``,
    ``thermal_dead_pixels`` (a mask per resolution), ``image_scale`` (1 / downscale_factor), ``pixel_size`` (width of a
    pixel where most of what is seen stands, in the world), ``input_box`` (the scene box in input coordinates),
    ``scene_name`` and, for train, ``feature_rays`` (`FeatureRays`, or None without tracks).
    ``fitted_poses`` (n, 3, 4) say where held-out photographs themselves say that they were taken, and
    ``adjusted_poses`` (camera to world in input coordinates, by the photograph's name) those of training, both None
    where no pose was adjusted.
    """

    config: ThermalDataParserConfig

    def __init__(self, config: ThermalDataParserConfig) -> None:
        super().__init__(config)
        self.downscale_factor = config.downscale_factor
        self._scene: _Scene | None = None

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        del kwargs
        if self._scene is None:
            self._scene = self._read_scene()
        scene = self._scene
        chosen = {"train": scene.split.train, "val": scene.split.val, "test": scene.split.test}.get(split)
        if chosen is None:
            raise SceneError("split", expected="train, val or test", got=split, remedy="Choose one of them.")
        frames = [scene.file.frames[index] for index in chosen]
        shapes = [scene.survey.shapes[frame.thermal] for frame in frames]
        factor = 1.0 / self._downscale()
        colour = [frame.intrinsics.scaled(factor) for frame in frames]
        thermal = [_thermal_intrinsics(frame, shape) for frame, shape in zip(frames, shapes)]
        cameras = _cameras(colour, scene.world.poses(np.stack([frame.pose for frame in frames])))
        thermal_poses = np.stack([f.pose if f.thermal_pose is None else f.thermal_pose for f in frames])
        thermal_cameras = _cameras(thermal, scene.world.poses(thermal_poses))
        masks = [frame.mask for frame in frames if frame.mask is not None]
        return DataparserOutputs(
            image_filenames=[frame.image for frame in frames],
            cameras=cameras,
            scene_box=scene.box,
            mask_filenames=masks or None,
            dataparser_transform=scene.world.transform,
            dataparser_scale=scene.world.scale,
            metadata={
                "image_scale": factor,
                "temperature_range": scene.survey.temperature_range,
                "thermal_filenames": [frame.thermal for frame in frames],
                "thermal_cameras": None if _same_cameras(cameras, thermal_cameras) else thermal_cameras,
                "thermal_unit": scene.file.unit,
                "valid_range_c": tuple(self.config.valid_range_c),
                "thermal_dead_pixels": scene.survey.dead_pixels,
                "pixel_size": scene.pixel_size / factor,
                "input_box": scene.input_box,
                "scene_name": scene.file.folder.resolve().name,
                "feature_rays": scene.feature_rays if split == "train" else None,
                "fitted_poses": self._fitted_poses(scene, chosen),
                "adjusted_poses": {f.image.name: f.pose for f in frames}
                if scene.adjusted and split == "train"
                else None,
            },
        )

    @staticmethod
    def _fitted_poses(scene: _Scene, chosen: Sequence[int]) -> torch.Tensor | None:
        """Poses (n, 3, 4) in nerfstudio's world that held-out photographs say; None where nobody's differ."""
        if not any(number in scene.fitted for number in chosen):
            return None
        frames = scene.file.frames
        return scene.world.poses(np.stack([scene.fitted.get(number, frames[number].pose) for number in chosen]))

    def _downscale(self) -> float:
        factor = self.config.downscale_factor
        if factor is None:
            return 1.0
        if not factor >= 1:
            expected = "a number of at least 1"
            raise SceneError("downscale_factor", expected=expected, got=factor, remedy="Pass 2, 4 or 8.")
        return float(factor)

    def _read_scene(self) -> _Scene:
        config = self.config
        low, high = config.valid_range_c
        if not -ZERO_CELSIUS_K <= low < high:
            expected, got = "a lower and a higher temperature in degrees Celsius", f"{low} and {high}"
            raise SceneError("valid_range_c", expected=expected, got=got, remedy="Pass --valid-range-c -100 2000.")
        file = read_scene_file(Path(config.data), config.missing_thermal)
        names = [frame.name for frame in file.frames]
        split = split_frames(names, file.meta, config.eval_mode, config.eval_interval, file.left_out)
        rays, given, fitted = find_feature_rays(file, split.train, config.tracks), file, {}
        if rays is None and config.refine_poses == "auto":
            file, fitted = refine_poses(given, split.train, CONSOLE.print)
        evidence = find_scene_box(file, config.scene_box, split.train)
        world, box, input_box, pixel_size = _place(evidence)
        paths, training = [f.thermal for f in file.frames], {file.frames[index].thermal for index in split.train}
        survey = survey_thermal_files(paths, file.unit, config.valid_range_c, file.bounds_c, training)
        _refuse_several_sizes(file.frames, survey.shapes)
        met = _share_that_meets([file.frames[index] for index in split.train], world, box, evidence.source)
        evaluation = set(split.val) | set(split.test)
        metres = file.meta.get("metres_per_unit")
        sides = (box.aabb[1] - box.aabb[0]).double() * (metres or 1.0) / world.scale
        size = f"{' x '.join(f'{side:.3g}' for side in sides.tolist())} {'m' if metres else 'units'}"
        CONSOLE.print(
            f"Scene {file.folder.resolve().name}: {len(names)} frames, {len(split.train)} train, {len(evaluation)} "
            f"evaluate ({split.how}); box from {evidence.source}, {size}, which {met:.0%} of the rays meet; "
            f"{survey.temperature_range.min_c:.2f} to {survey.temperature_range.max_c:.2f} C."
        )
        if file.bounds_swapped:
            low, high = file.bounds_c or (0.0, 0.0)
            said = f"{BOUNDS_NAME} has its lowest temperature above its highest; read as {low:g} to {high:g} C."
            CONSOLE.print(said, style="bold yellow")
        if file.left_out:
            CONSOLE.print(f"Left out, no pair: {', '.join(file.left_out)}", style="bold yellow")
        if rays is not None:
            rays = rays.moved(np.eye(3), world.translation, world.scale)
        return _Scene(file, split, survey, world, box, input_box, pixel_size, rays, file is not given, fitted)


def _place(evidence: BoxEvidence) -> tuple[_World, SceneBox, tuple[tuple[float, ...], ...], float]:
    """Choose origin and scale, and express the scene box and a pixel's width in the new world."""
    box = evidence.box()
    translation, longest = -box.mean(axis=0), float((box[1] - box[0]).max())
    if np.abs(box).max() > _FAR_SIDES * longest:
        # As nerfstudio keeps it for the way back: five million metres from the origin that is off by half a metre.
        translation = translation.astype(np.float32).astype(np.float64)
    scale = SCENE_SIZE / longest
    placed = SceneBox(aabb=torch.from_numpy((scale * (box + translation)).astype(np.float32)))
    return _World(translation, scale), placed, tuple(map(tuple, box.tolist())), scale * evidence.pixel_size(box)


def _share_that_meets(frames: list[Frame], world: _World, box: SceneBox, source: str) -> float:
    """Share of the rays of photographs that meet the scene box, on a grid of 8 x 8 rays each.

    Lenses other than perspective ones count as seeing it. A `SceneError` is raised where next to no ray does.
    """
    corners, shares = box.aabb.double().numpy(), []
    poses = world.poses(np.stack([frame.pose for frame in frames])).double().numpy()
    x, y = (each.ravel() for each in np.meshgrid(*2 * [(np.arange(8) + 0.5) / 8]))
    for frame, pose in zip(frames, poses):
        lens = frame.intrinsics
        if lens.lens != "perspective":
            return 1.0
        rays = (lens.rays(np.column_stack([x * lens.width, y * lens.height])) * (1.0, -1.0, -1.0)) @ pose[:, :3].T
        rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
        enter, leave = np.sort((corners[:, None] - pose[:, 3]) / rays, axis=0)
        shares.append(np.mean(np.maximum(enter.max(axis=1), 0.0) <= leave.min(axis=1)))
    share = float(np.mean(shares))
    if share < _LEAST_THAT_MEETS:
        away = float(np.mean(np.array(shares) == 0.0))
        expected = f"photographs that look at the scene box, from {source}"
        got = f"{share:.1%} of their rays meeting it, and {away:.0%} of the {len(frames)} cameras looking past it"
        remedy = (
            "Check that poses are camera to world with x right, y up, z back, or pass --scene-box with its corners in "
            "their coordinates: xmin ymin zmin xmax ymax zmax."
        )
        raise SceneError("cameras", expected=expected, got=got, remedy=remedy)
    return share


def _refuse_several_sizes(frames: list[Frame], shapes: dict[Path, tuple[int, int]]) -> None:
    """Refuse thermal images of several sizes beside photographs of one, unless each has a camera of its own."""
    sizes: dict[tuple[int, int], list[tuple[int, int]]] = {}
    shared = [frame for frame in frames if frame.thermal_intrinsics is None]
    for frame in shared:
        sizes.setdefault((frame.intrinsics.height, frame.intrinsics.width), []).append(shapes[frame.thermal])
    usual = {photograph: Counter(each).most_common(1)[0][0] for photograph, each in sizes.items()}
    for frame in shared:
        (height, width), found = usual[frame.intrinsics.height, frame.intrinsics.width], shapes[frame.thermal]
        if found != (height, width):
            expected = f"thermal images of one size, {width} x {height} pixels as most have"
            remedy = "Remove the frame, or give it a 'thermal_camera' of its own in the json."
            raise SceneError(frame.thermal.name, expected=expected, got=f"{found[1]} x {found[0]}", remedy=remedy)


def _refuse_beyond_bounds(middles_c: dict[Path, float], bounds_c: tuple[float, float]) -> None:
    """Refuse files whose median is further from the declared bounds than these are wide: they have another unit.

    Below the bounds that is at least `_COLDEST_SKY_K`: a clear sky may be colder than anybody declares.
    """
    width = bounds_c[1] - bounds_c[0]
    least, most = bounds_c[0] - max(width, _COLDEST_SKY_K), bounds_c[1] + max(width, _SAME_PLACE_K)
    for path, middle in middles_c.items():
        if not least <= middle <= most:
            expected = f"temperatures near {bounds_c[0]:g} to {bounds_c[1]:g} C, as {BOUNDS_NAME} says"
            got = f"{middle:.2f} C in the middle"
            remedy = f"Subtract 273.15 if the file holds kelvins; else correct {BOUNDS_NAME}, or remove it."
            raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)


def _refuse_mixed_units(middles_c: dict[Path, float]) -> None:
    """Refuse files that read 273 K more than the others, by their medians: they hold kelvins."""
    usual = [middle for middle in middles_c.values() if middle < _LEAST_OF_KELVINS]
    shifted = [
        path.name
        for path, middle in middles_c.items()
        if usual and middle >= _LEAST_OF_KELVINS and abs(middle - ZERO_CELSIUS_K - np.median(usual)) < _SAME_PLACE_K
    ]
    if shifted:
        got = f"{len(shifted)} of {len(middles_c)} files 273 degrees above the others, such as {shifted[0]}"
        remedy = "Subtract 273.15 in these files. If they are as hot as that, pass --valid-range-c -100 1999."
        raise ThermalFileError("thermal images", expected="one unit in all files", got=got, remedy=remedy)


def survey_thermal_files(
    paths: Sequence[Path],
    unit: ThermalUnit,
    valid_range_c: tuple[float, float],
    bounds_c: tuple[float, float] | None,
    training: Collection[Path] | None = None,
) -> ThermalSurvey:
    """Read every thermal file once.

    Range and stuck pixels come from the files in `training` alone (None: all). The range that the scene declares,
    `bounds_c`, is widened to the extremes of training files that hold temperatures of their own; files that hold shares
    of the range cannot exceed it. Temperatures in degrees Celsius.

    Raises:
        ThermalFileError: A file cannot be read or has no valid pixel at all.
    """
    shapes: dict[Path, tuple[int, int]] = {}
    extremes: dict[Path, tuple[float, float]] = {}
    middles: dict[Path, float] = {}
    kept: dict[tuple[int, int], list[npt.NDArray[np.float32]]] = {}
    trains = [training is None or path in training for path in paths]
    # Counted among the training files: every other file of all may be an evaluation's.
    step = -(-sum(trains) // _MOST_FRAMES)
    for path, is_training in zip(paths, trains):
        temperature_c = read_thermal_file(path, unit, valid_range_c).temperature_c
        height, width = temperature_c.shape
        shapes[path] = (height, width)
        if not np.isfinite(temperature_c).any():
            expected = f"temperatures from {valid_range_c[0]} to {valid_range_c[1]} C"
            remedy = "Check thermal_unit or temperature_bounds.json, or widen --valid-range-c."
            raise ThermalFileError(str(path), expected=expected, got="no valid pixel", remedy=remedy)
        if not is_training:
            continue
        if len(extremes) % step == 0:
            kept.setdefault((height, width), []).append(temperature_c)
        extremes[path] = (float(np.nanmin(temperature_c)), float(np.nanmax(temperature_c)))
        middles[path] = float(np.nanmedian(temperature_c))
    if bounds_c is not None:
        _refuse_beyond_bounds(middles, bounds_c)
    if tuple(valid_range_c) == ThermalDataParserConfig.valid_range_c:
        _refuse_mixed_units(middles)
    dead = {shape: find_dead_pixels(np.stack(frames)) for shape, frames in kept.items()}
    dead = {shape: mask for shape, mask in dead.items() if mask.any()}
    for path in extremes:
        if shapes[path] in dead:  # the extremes of these files may be a stuck pixel's
            live = read_thermal_file(path, unit, valid_range_c).temperature_c[~dead[shapes[path]]]
            if np.isfinite(live).any():
                extremes[path] = (float(np.nanmin(live)), float(np.nanmax(live)))
    lows, highs = zip(*extremes.values())
    low, high = min(lows), max(highs)
    if bounds_c is not None:
        low, high = min(low, bounds_c[0]), max(high, bounds_c[1])
    return ThermalSurvey(shapes, TemperatureRange.spanning(low, high), dead)


def _thermal_intrinsics(frame: Frame, shape: tuple[int, int]) -> Camera:
    """The projection of a thermal image: its own camera's, or the photograph's at the thermal resolution."""
    height, width = shape
    own = frame.thermal_intrinsics
    if own is not None:
        if (own.height, own.width) != shape:
            expected = f"{own.width} x {own.height} pixels as thermal_camera says"
            remedy = "Correct w and h of thermal_camera, or use the thermal images it was calibrated with."
            raise SceneError(frame.thermal.name, expected=expected, got=f"{width} x {height}", remedy=remedy)
        return own
    colour = frame.intrinsics
    fitting = colour.height * width / colour.width
    if abs(height - fitting) > max(1.0, 0.03 * fitting):
        expected = f"the photograph's aspect ratio {colour.width} x {colour.height}"
        remedy = "Give the thermal camera its own intrinsics as 'thermal_camera' in the json."
        raise SceneError(frame.thermal.name, expected=expected, got=f"{width} x {height}", remedy=remedy)
    return colour.resized(width, height)


def _cameras(intrinsics: list[Camera], poses: torch.Tensor) -> Cameras:
    def column(name: str, kind: torch.dtype) -> torch.Tensor:
        return torch.tensor([[getattr(one, name)] for one in intrinsics], dtype=kind)

    return Cameras(
        camera_to_worlds=poses,
        fx=column("fl_x", torch.float32),
        fy=column("fl_y", torch.float32),
        cx=column("cx", torch.float32),
        cy=column("cy", torch.float32),
        width=column("width", torch.int64),
        height=column("height", torch.int64),
        distortion_params=torch.tensor([one.distortion for one in intrinsics], dtype=torch.float32),
        camera_type=torch.tensor([[CameraType[one.lens.upper()].value] for one in intrinsics]),
    )


def _same_cameras(first: Cameras, second: Cameras) -> bool:
    """True if both give the same rays for the same pixels."""
    for name in ("width", "height", "camera_type"):
        if not torch.equal(getattr(first, name), getattr(second, name)):
            return False
    return all(
        torch.allclose(getattr(first, name), getattr(second, name), rtol=1e-6, atol=1e-7)
        for name in ("fx", "fy", "cx", "cy", "distortion_params", "camera_to_worlds")
    )


@dataclass(frozen=True)
class Split:
    """Positions of frames in the sorted list of names."""

    train: list[int]
    val: list[int]
    test: list[int]
    how: str  # how the split was made, for the report


def split_frames(
    names: Sequence[str],
    meta: Mapping[str, Any],
    mode: SplitMode,
    interval: int,
    left_out: Sequence[str] = (),
) -> Split:
    """Split frames, given by their sorted names, into training and evaluation.

    "auto" takes the first that the scene has: names with frame_train_ and frame_eval_, lists in the json
    (train_filenames, val_filenames, test_filenames), every n-th frame from half the interval on, so that the ends of
    the sequence, which the others see least, stay in training. Lists may hold names left out.

    Raises:
        SceneError: A side is empty, a frame is on both sides or a listed name is unknown.
    """
    tagged = [("frame_train_" in Path(n).name, "frame_eval_" in Path(n).name) for n in names]
    lists = any(key in meta for key in _KEYS.values())
    if mode == "filename" or (mode == "auto" and any(train or test for train, test in tagged)):
        split = _by_name(names, tagged)
    elif mode == "lists" or (mode == "auto" and lists):
        split = _by_lists(names, meta, left_out)
    else:
        split = _by_interval(names, interval)
    for side, chosen in (("training", split.train), ("evaluation", split.val), ("evaluation", split.test)):
        if not chosen:
            expected = f"at least one of the {len(names)} frames ({split.how})"
            remedy = "Add frames or choose another split, e.g. --eval-mode interval --eval-interval 2."
            raise SceneError(f"{side} frames", expected=expected, got="none", remedy=remedy)
    both = set(split.train) & (set(split.val) | set(split.test))
    if both:
        remedy = "Remove them from one list: evaluation frames must never train."
        got = ", ".join(names[i] for i in sorted(both)) + " in training and in evaluation"
        raise SceneError("split lists", expected="no frame on both sides", got=got, remedy=remedy)
    return split


def _by_name(names: Sequence[str], tagged: list[tuple[bool, bool]]) -> Split:
    unclear = [name for name, (train, evaluate) in zip(names, tagged) if train == evaluate]
    if unclear:
        expected, got = "frame_train_ or frame_eval_ in every name", f"{unclear[0]} ({len(unclear)} such)"
        remedy = "Rename them or pass --eval-mode interval."
        raise SceneError("split by file name", expected=expected, got=got, remedy=remedy)
    evaluate = [i for i, (_, test) in enumerate(tagged) if test]
    return Split([i for i, (train, _) in enumerate(tagged) if train], evaluate, evaluate, "by file name")


def _by_lists(names: Sequence[str], meta: Mapping[str, Any], left_out: Sequence[str]) -> Split:
    position = {Path(name).as_posix(): i for i, name in enumerate(names)}
    found: dict[str, list[int] | None] = {}
    for side, key in _KEYS.items():
        given = meta.get(key, [])
        if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
            remedy = 'Write ["images/a.jpg", "images/b.jpg"], for example.'
            raise SceneError(key, expected="a list of file names", got=repr(given)[:80], remedy=remedy)
        listed = [Path(name).as_posix() for name in given] if key in meta else None
        listed = None if listed is None else [name for name in listed if name not in left_out]
        unknown = [name for name in listed or [] if name not in position]
        if unknown:
            remedy = "Correct the list; it must write names as 'file_path' does."
            got = f"{unknown[0]} ({len(unknown)} unknown)"
            raise SceneError(key, expected="names that are in 'frames'", got=got, remedy=remedy)
        found[side] = None if listed is None else sorted({position[name] for name in listed})
    val = found["val"] or found["test"]
    test = found["test"] or found["val"]
    held = set(val or []) | set(test or [])
    train = found["train"]
    if train is None:
        train = [i for i in range(len(names)) if i not in held]
    if val is None or test is None:
        val = test = [i for i in range(len(names)) if i not in set(train)]
    return Split(train, val, test, f"by {', '.join(key for key in _KEYS.values() if key in meta)} in the json")


def _by_interval(names: Sequence[str], interval: int) -> Split:
    start = interval // 2
    if interval < 2:
        expected, remedy = "an interval of at least 2", "Pass --eval-interval 8."
        raise SceneError("eval_interval", expected=expected, got=interval, remedy=remedy)
    evaluate = list(range(start, len(names), interval))
    train = [i for i in range(len(names)) if i % interval != start]
    return Split(train, evaluate, evaluate, f"every {interval}th frame from number {start}")
