"""nerfstudio dataparser for scenes of paired colour and thermal photographs."""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Optional

import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import SceneError, ThermalFileError
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.units import ZERO_CELSIUS_K, TemperatureRange
from thermoxels_ns.data.layouts import BOUNDS_NAME, LayoutName
from thermoxels_ns.data.scene_box import find_scene_box
from thermoxels_ns.data.scene_file import Frame, SceneFile, read_scene_file
from thermoxels_ns.data.tracks import TrackSource, feature_rays, find_tracks
from thermoxels_ns.radiometry.thermal_pixels import VALID_RANGE_C, ThermalUnit, read_thermal_file

SCENE_SIZE = 2.0  # longest side of the scene box in nerfstudio's world; learning rates of the field rely on it
_FAR_SIDES = 16.0
"""Distance of the box from the origin, in longest sides of the box. Beyond it, the rounding of a shift to single
precision is more than a millionth of the box. National coordinates are so far away."""
_COLDEST_SKY_K = 150.0  # a file's median may be this far below the declared lowest temperature, if it shows a clear sky
_LEAST_OF_KELVINS, _SAME_PLACE_K = 200.0, 40.0
"""A file holds kelvins if its median is at least the first number, and the median less 273.15 differs by at most the
second from the median of the other files."""
_BYTES_PER_PIXEL = 8  # three colours; for masked photographs also the mask and the pixel's number
LONGEST_SIDE = 640  # pixels along the longer side of the pictures in which features are sought
MOST_PHOTOGRAPHS = 500  # with more, poses are not adjusted: the normal equations would take minutes
FEWEST_PHOTOGRAPHS = 3  # with fewer, poses are not adjusted

PoseSource = Literal["auto", "given"]
SplitMode = Literal["auto", "filename", "lists", "interval"]
_KEYS = {"train": "train_filenames", "val": "val_filenames", "test": "test_filenames"}


@dataclass
class ThermalDataParserConfig(DataParserConfig):
    """Scenes of paired colour and thermal photographs, or of photographs alone; docs/data.md has the layouts."""

    _target: type = field(default_factory=lambda: ThermalDataParser)
    """Class to instantiate."""
    data: Path = Path()
    """Scene folder, with a transforms.json or a COLMAP model, or the json itself."""
    layout: Optional[LayoutName] = None  # noqa: UP045 - read by tyro
    """Layout of the scene folder, see docs/data.md. Default: the first that fits; the log says which. rgb: photographs
    alone, also where there are thermal images."""
    thermal_bounds: Optional[tuple[float, float]] = None  # noqa: UP045
    """Degrees Celsius of black and of white in grey thermal pictures. Default: those of temperature_bounds.json."""
    downscale_factor: Optional[int] = None  # noqa: UP045 - read by tyro
    """Divide the resolution of the colour photographs by this number. Photographs are resized when loaded; no file is
    written. Thermal images keep their resolution. Default: full resolution, but for `photographs_gb`."""
    photographs_gb: float = 1.0
    """Memory for the pixels of photographs that train, [GB]. Photographs that need more are averaged down, and with
    them thermal images that have the same pixels; held-out photographs keep their resolution."""
    scene_box: Optional[tuple[tuple[float, float, float], tuple[float, float, float]]] = None  # noqa: UP045
    """Box to reconstruct, in the coordinates of the input poses: xmin ymin zmin xmax ymax zmax. Default: scene_box in
    the json, else found from the sparse points, else from depths that photographs agree on, else from the cameras."""
    eval_mode: SplitMode = "auto"
    """How frames are split into training and evaluation. filename: by frame_train_ / frame_eval_ in the names. lists:
    by train_filenames / val_filenames / test_filenames in the json. interval: every eval_interval-th frame evaluates.
    auto: the first of these three that suits the scene."""
    eval_interval: int = 8
    """With n here and eval_mode interval, every n-th frame by sorted name evaluates. Counting starts in the middle of
    the first n frames, so that the ends of the sequence stay in training."""
    missing_thermal: Literal["error", "skip"] = "error"
    """What happens to a frame without a thermal image. error: stop. skip: leave the frame out and print its name."""
    tracks: TrackSource = "auto"
    """Source of tracks: which photographs saw which points in structure from motion. Tracks tell training what is air.
    auto: a COLMAP model in the scene's folder (in colmap or sparse) whose poses are those of the json. Its points tell
    where the scene box is, too. off: no tracks."""
    refine_poses: PoseSource = "auto"
    """Poses to train with. auto: poses adjusted to features that photographs share (bundle adjustment), if the scene
    has no tracks and the adjusted poses fit better than the json's; else the json's. given: the json's."""


@dataclass(frozen=True)
class _Scene:
    """The content of one scene that training and evaluation share, read once from all frames.

    A point p in input coordinates has the coordinates scale * (p + translation) in nerfstudio's world.
    """

    file: SceneFile
    split: Split
    shapes: dict[Path, tuple[int, int]]  # height and width of every thermal file
    translation: FloatArray
    scale: float
    metadata: dict[str, Any]  # entries that the outputs of all splits hold
    box: SceneBox  # in nerfstudio's world
    feature_rays: FeatureRays | None  # rays from training photographs to points of tracks, in nerfstudio's world
    adjusted: bool  # True if `refine_poses` changed the poses of the training photographs
    fitted: dict[int, FloatArray]
    """Poses (4, 4) fitted to held-out photographs, in input coordinates, by the frame's index in `file.frames`."""

    def placed(self, poses: Sequence[FloatArray]) -> torch.Tensor:
        """Return `poses` (4, 4) of input coordinates as camera-to-world matrices of nerfstudio's world, (n, 3, 4)."""
        moved = np.stack(poses)[:, :3]
        moved[:, :, 3] = self.scale * (moved[:, :, 3] + self.translation)
        return torch.from_numpy(moved.astype(np.float32))


class ThermalDataParser(DataParser):
    """Reader of a scene of paired photographs, with the options of `ThermalDataParserConfig`.

    The metadata of its outputs hold: ``temperature_range`` (`TemperatureRange`; None for photographs alone),
    ``thermal_filenames`` (None for photographs alone), ``thermal_cameras`` (`Cameras`; None if all pairs share camera
    and resolution), ``thermal_unit``, ``image_scale`` (used over original resolution of photographs), ``pixel_size``
    (width of a pixel at the typical distance of surfaces, in nerfstudio's world), ``input_box`` (the scene box in input
    coordinates) and ``feature_rays`` (`FeatureRays`; None for val and test, and without tracks).
    If `refine_poses` adjusted poses, ``adjusted_poses`` of train maps file names to poses (camera to world, input
    coordinates), and ``fitted_poses`` of val and test are camera to world in nerfstudio's world, (n, 3, 4); else None.
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
        if split not in _KEYS:
            raise SceneError("split", expected="train, val or test", got=split, remedy="Choose one of them.")
        chosen: list[int] = getattr(scene.split, split)
        frames = [scene.file.frames[index] for index in chosen]
        poses, training = [frame.pose for frame in frames], split == "train"
        thermal_poses = scene.placed([f.pose if f.thermal_pose is None else f.thermal_pose for f in frames])
        lenses = [frame.intrinsics for frame in frames]
        pixels_averaged = self.pixels_averaged(lenses) if training else 1
        factor = 1.0 / (self.config.downscale_factor or pixels_averaged)
        cameras = _cameras(lenses, scene.placed(poses))
        thermal_cameras = _cameras([_thermal_intrinsics(frame, scene.shapes) for frame in frames], thermal_poses)
        shared = _same_cameras(cameras, thermal_cameras)
        if factor < 1.0:
            cameras = _cameras([lens.scaled(factor) for lens in lenses], scene.placed(poses))
            shared &= pixels_averaged > 1 or not scene.file.has_thermal
        fitted = [scene.fitted.get(number, pose) for number, pose in zip(chosen, poses)]
        return DataparserOutputs(
            image_filenames=[frame.image for frame in frames],
            cameras=cameras,
            scene_box=scene.box,
            mask_filenames=[frame.mask for frame in frames if frame.mask is not None] or None,
            dataparser_transform=torch.from_numpy(np.column_stack([np.eye(3), scene.translation]).astype(np.float32)),
            dataparser_scale=scene.scale,
            metadata={
                **scene.metadata,
                "image_scale": factor,
                "thermal_filenames": [frame.thermal for frame in frames] if scene.file.has_thermal else None,
                "thermal_cameras": None if shared else thermal_cameras,
                "pixel_size": scene.metadata["pixel_size"] / (1.0 if "pixel_size" in scene.file.meta else factor),
                "feature_rays": scene.feature_rays if training else None,
                "fitted_poses": scene.placed(fitted) if scene.fitted.keys() & set(chosen) else None,
                "adjusted_poses": {f.image.name: f.pose for f in frames} if scene.adjusted and training else None,
            },
        )

    def pixels_averaged(self, lenses: Sequence[Camera]) -> int:
        """Return the least k for which photographs averaged over k x k pixels fit into the option `photographs_gb`.

        `lenses` are the photographs' cameras. With the option `downscale_factor`, k is 1. Above 1, k is printed.
        """
        need_gb = _BYTES_PER_PIXEL * sum(lens.width * lens.height for lens in lenses) / 1e9
        if self.config.downscale_factor is not None or need_gb <= self.config.photographs_gb:
            return 1
        side = math.ceil(math.sqrt(need_gb / self.config.photographs_gb))
        CONSOLE.print(
            f"{len(lenses)} photographs need {need_gb:.2g} GB: for training they are averaged over {side} x {side} "
            f"pixels, {need_gb / side**2:.2g} GB, and voxels get no finer than these pixels allow (--photographs-gb "
            f"{math.ceil(need_gb)} keeps all pixels)."
        )
        return side

    def _read_scene(self) -> _Scene:
        config = self.config
        if not config.photographs_gb > 0.0:
            got, remedy = config.photographs_gb, "Pass --photographs-gb 1."
            raise SceneError("photographs_gb", expected="a number above 0", got=got, remedy=remedy)
        if config.downscale_factor is not None and not config.downscale_factor >= 1:
            expected, got = "a number of at least 1", config.downscale_factor
            raise SceneError("downscale_factor", expected=expected, got=got, remedy="Pass 2, 4 or 8.")
        file = read_scene_file(Path(config.data), config.missing_thermal, config.layout, config.thermal_bounds)
        CONSOLE.print(f"Layout {file.layout} (--layout takes another).", markup=False)
        names = [frame.name for frame in file.frames]
        split = split_frames(names, file.meta, config.eval_mode, config.eval_interval, file.left_out)
        tracks = rays = None
        try:
            tracks = None if config.tracks == "off" else find_tracks(file, CONSOLE.print)
            rays = None if tracks is None else feature_rays(tracks, [file.frames[index] for index in split.train])
        except SceneError as problem:
            tracks = None
            CONSOLE.print(f"Tracks: the COLMAP model is not used (--tracks off leaves it alone): {problem}")
        given, fitted = file, {}
        if rays is None and config.refine_poses == "auto" and not file.meta.get("poses_refined"):
            file, fitted = refine_poses(given, split.train, CONSOLE.print)
        found = find_scene_box(file, config.scene_box, split.train, tracks)
        box = found.box
        translation, longest = -box.mean(axis=0), float((box[1] - box[0]).max())
        if np.abs(box).max() > _FAR_SIDES * longest:
            # nerfstudio keeps dataparser_transform in single precision; unrounded, the two would differ by metres.
            translation = translation.astype(np.float32).astype(np.float64)
        scale = SCENE_SIZE / longest
        given_size = file.meta.get("pixel_size")  # in the blocks of a scene, whose voxels are to have one size
        pixel_size = found.pixel_size(file.frames)
        if given_size is not None:
            pixel_size = check_positive("pixel_size", given_size, "Correct the json, or remove the entry.", SceneError)
        if math.isinf(pixel_size):
            expected = f"photographs that look at the scene box, from {found.source}"
            remedy = (
                "Check that poses are camera to world with x right, y up, z back, or pass --scene-box with its corners "
                "in their coordinates: xmin ymin zmin xmax ymax zmax."
            )
            raise SceneError("cameras", expected=expected, got="none that has it in view", remedy=remedy)
        training, shapes, temperatures = [file.frames[index] for index in split.train], {}, None
        if file.has_thermal:
            paths, those = ([f.thermal for f in some if f.thermal is not None] for some in (file.frames, training))
            shapes, temperatures = survey_thermal_files(paths, file.unit, file.bounds_c, set(those))
            _refuse_several_sizes(file.frames, shapes)
        metadata = {
            "temperature_range": temperatures,
            "thermal_unit": file.unit,
            "pixel_size": scale * pixel_size,
            "input_box": tuple(map(tuple, box.tolist())),
        }
        placed = SceneBox(aabb=torch.from_numpy((scale * (box + translation)).astype(np.float32)))
        if rays is not None:
            rays = rays.moved(np.eye(3), translation, scale)
        scene = _Scene(file, split, shapes, translation, scale, metadata, placed, rays, file is not given, fitted)
        metres = file.meta.get("metres_per_unit")
        sides = (placed.aabb[1] - placed.aabb[0]).double() * (metres or 1.0) / scale
        size = f"{' x '.join(f'{side:.3g}' for side in sides.tolist())} {'m' if metres else 'units'}"
        CONSOLE.print(
            f"Scene {file.folder.resolve().name}: {len(names)} frames, {len(split.train)} train, "
            f"{len({*split.val, *split.test})} evaluate ({split.how}); box from {found.source}, {size}; "
            + (f"{temperatures.min_c:.2f} to {temperatures.max_c:.2f} C." if temperatures else "no temperatures.")
        )
        if file.left_out:
            CONSOLE.print(f"Left out, no pair: {', '.join(file.left_out)}", style="bold yellow")
        return scene


def _refuse_several_sizes(frames: list[Frame], shapes: dict[Path, tuple[int, int]]) -> None:
    """Raise `SceneError` if photographs of one size have thermal images of several sizes, without thermal cameras."""
    shared = [(f.thermal, f.intrinsics) for f in frames if f.thermal_intrinsics is None and f.thermal is not None]
    sizes: defaultdict[tuple[int, int], Counter[tuple[int, int]]] = defaultdict(Counter)
    for thermal, camera in shared:
        sizes[camera.width, camera.height][shapes[thermal]] += 1
    for thermal, camera in shared:
        ((height, width), _), *_ = sizes[camera.width, camera.height].most_common(1)
        found = shapes[thermal]
        if found != (height, width):
            expected = f"thermal images of one size, {width} x {height} pixels as most have"
            remedy = "Remove the frame, or give it a 'thermal_camera' of its own in the json."
            raise SceneError(thermal.name, expected=expected, got=f"{found[1]} x {found[0]}", remedy=remedy)


def _refuse_other_units(middles_c: dict[Path, float], bounds_c: tuple[float, float] | None) -> None:
    """Raise `ThermalFileError` for the first file whose median `middles_c` shows that it does not hold degrees Celsius.
    With `bounds_c`, the median of such a file is far outside the bounds. Without bounds, it is about 273.15 degrees
    above the medians of the other files."""
    usual = [middle for middle in middles_c.values() if middle < _LEAST_OF_KELVINS]
    if bounds_c is None and not usual:
        return
    low, high = bounds_c or 2 * (float(np.median(usual)),)
    for path, middle in middles_c.items():
        if bounds_c is None:
            strange = middle >= _LEAST_OF_KELVINS and abs(middle - ZERO_CELSIUS_K - low) < _SAME_PLACE_K
        else:
            width = high - low
            strange = not low - max(width, _COLDEST_SKY_K) <= middle <= high + max(width, _SAME_PLACE_K)
        if strange:
            where = f"{BOUNDS_NAME} or --thermal-bounds says" if bounds_c else "in most of the other files"
            expected, got = f"temperatures near {low:g} to {high:g} C, as {where}", f"{middle:.2f} C in the middle"
            other = "correct the bounds" if bounds_c else "pass its lowest and highest degrees, --thermal-bounds"
            remedy = f"Subtract 273.15 if the file holds kelvins; else {other}."
            raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)


def survey_thermal_files(
    paths: Sequence[Path], unit: ThermalUnit, bounds_c: tuple[float, float] | None, training: Collection[Path]
) -> tuple[dict[Path, tuple[int, int]], TemperatureRange]:
    """Read all thermal files; return the shape (h, w) of each by its path, and the temperature range of the scene.

    The range is `bounds_c` [degrees Celsius] (None: empty), widened to the extremes of the files in `training`. Raises
    `ThermalFileError` if a file cannot be read or has no valid pixel, or if its median shows that its unit is another.
    """
    shapes: dict[Path, tuple[int, int]] = {}
    middles: dict[Path, float] = {}
    low, high = bounds_c or (math.inf, -math.inf)
    for path in paths:
        temperature_c = read_thermal_file(path, unit)
        height, width = temperature_c.shape
        shapes[path] = (height, width)
        if not np.isfinite(temperature_c).any():
            expected = "temperatures from {:g} to {:g} C".format(*VALID_RANGE_C)
            remedy = "Check thermal_unit or temperature_bounds.json."
            raise ThermalFileError(str(path), expected=expected, got="no valid pixel", remedy=remedy)
        if path not in training:
            continue
        low, high = min(low, float(np.nanmin(temperature_c))), max(high, float(np.nanmax(temperature_c)))
        middles[path] = float(np.nanmedian(temperature_c))
    _refuse_other_units(middles, bounds_c)
    return shapes, TemperatureRange.spanning(low, high)


def _thermal_intrinsics(frame: Frame, shapes: Mapping[Path, tuple[int, int]]) -> Camera:
    """Return the camera of a frame's thermal image, or the photograph's camera if the frame has no thermal image.
    `shapes` holds the shape (h, w) of each thermal image. Raises `SceneError` if the shape does not fit the camera."""
    if frame.thermal is None:
        return frame.intrinsics
    height, width = shape = shapes[frame.thermal]
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
    lens = torch.tensor([(c.fl_x, c.fl_y, c.cx, c.cy) for c in intrinsics], dtype=torch.float32)
    width, height = torch.tensor([(c.width, c.height) for c in intrinsics]).split(1, dim=1)
    distortion = torch.tensor([c.distortion for c in intrinsics], dtype=torch.float32)
    return Cameras(poses, *lens.split(1, dim=1), width=width, height=height, distortion_params=distortion)


def _same_cameras(first: Cameras, second: Cameras) -> bool:
    """Return whether two sets of cameras have equal numbers of pixels, and equal rays through them up to rounding."""
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in ("width", "height")) and all(
        torch.allclose(getattr(first, name), getattr(second, name), rtol=1e-6, atol=1e-7)
        for name in ("fx", "fy", "cx", "cy", "distortion_params", "camera_to_worlds")
    )


@dataclass(frozen=True)
class Split:
    """Frames that train and frames that evaluate, as indices into the list of frames sorted by name."""

    train: list[int]
    val: list[int]
    test: list[int]  # often the same as `val`
    how: str  # how the split was made, in words for the report


def split_frames(
    names: Sequence[str], meta: Mapping[str, Any], mode: SplitMode, interval: int, left_out: Sequence[str] = ()
) -> Split:
    """Return a split of the frames, given by their sorted `names`, into training and evaluation.

    The `mode` "filename" splits by frame_train_ and frame_eval_ in the names, "lists" by train_filenames, val_filenames
    and test_filenames in the json's content `meta`. "interval" evaluates every `interval`-th frame from index
    interval // 2 on, so that the ends of the sequence train. "auto" takes the first of these three that suits the
    scene. Names in lists that are in `left_out` are ignored. Raises `SceneError` if a side is empty, a frame is on both
    sides, a name has no tag or is unknown, or `interval` is below 2.
    """
    tagged = [("frame_train_" in Path(n).name, "frame_eval_" in Path(n).name) for n in names]
    if mode == "filename" or (mode == "auto" and any(train or test for train, test in tagged)):
        unclear = [name for name, (train, evaluate) in zip(names, tagged) if train == evaluate]
        if unclear:
            expected, got = "frame_train_ or frame_eval_ in every name", f"{unclear[0]} ({len(unclear)} such)"
            remedy = "Rename them or pass --eval-mode interval."
            raise SceneError("split by file name", expected=expected, got=got, remedy=remedy)
        train, val = ([i for i, tags in enumerate(tagged) if tags[side]] for side in (0, 1))
        split = Split(train, val, val, "by file name")
    elif mode == "lists" or (mode == "auto" and not meta.keys().isdisjoint(_KEYS.values())):
        split = _by_lists(names, meta, left_out)
    else:
        if interval < 2:
            expected, remedy = "an interval of at least 2", "Pass --eval-interval 8."
            raise SceneError("eval_interval", expected=expected, got=interval, remedy=remedy)
        start = interval // 2
        val = list(range(start, len(names), interval))
        train = [i for i in range(len(names)) if i % interval != start]
        split = Split(train, val, val, f"every {interval}th frame from number {start}")
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


def _by_lists(names: Sequence[str], meta: Mapping[str, Any], left_out: Sequence[str]) -> Split:
    """Return the split by the lists in the json's content `meta`, see `split_frames`. If training or evaluation has no
    list, it gets all frames that the other lists do not name. If only one of val and test has a list, both get its
    frames."""
    position = {Path(name).as_posix(): i for i, name in enumerate(names)}
    found: dict[str, list[int]] = {}
    for side, key in _KEYS.items():
        given = meta.get(key, [])
        if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
            remedy = 'Write ["images/a.jpg", "images/b.jpg"], for example.'
            raise SceneError(key, expected="a list of file names", got=repr(given)[:80], remedy=remedy)
        listed = [name for name in (Path(each).as_posix() for each in given) if name not in left_out]
        unknown = [name for name in listed if name not in position]
        if unknown:
            remedy = "Correct the list; it must write names as 'file_path' does."
            got = f"{unknown[0]} ({len(unknown)} unknown)"
            raise SceneError(key, expected="names that are in 'frames'", got=got, remedy=remedy)
        found[side] = sorted({position[name] for name in listed})
    train, val, test = found["train"], found["val"] or found["test"], found["test"] or found["val"]
    if _KEYS["train"] not in meta:
        train = [i for i in range(len(names)) if i not in {*val, *test}]
    if not {_KEYS["val"], _KEYS["test"]} & meta.keys():
        val = test = [i for i in range(len(names)) if i not in set(train)]
    return Split(train, val, test, f"by {', '.join(key for key in _KEYS.values() if key in meta)} in the json")


def refine_poses(
    scene: SceneFile, training: Sequence[int], say: Callable[[str], None]
) -> tuple[SceneFile, dict[int, FloatArray]]:
    """Return the scene with poses of training photographs from bundle adjustment, if features held back fit better.

    `training` holds indices of frames. All other frames are held out and keep their poses, so that evaluation remains
    independent. A thermal camera with a pose of its own moves with its photograph. `say` receives a line of text.

    Returns:
        The scene with adjusted poses (`scene` itself if the poses were kept), and the poses (4, 4) that fit the
        features of held-out photographs best, by index of the frame.
    """
    began = time.perf_counter()
    frames = scene.frames
    others = [number for number in range(len(frames)) if number not in set(training)]
    if not FEWEST_PHOTOGRAPHS <= len(training) <= MOST_PHOTOGRAPHS:
        return scene, {}
    from thermoxels_ns.multiview.bundle_adjustment import adjust_poses, features_of, find_tracks

    pictures = [_picture(frames[number]) for number in training]
    features, cameras = [features_of(picture, mask) for picture, mask, _ in pictures], [each[2] for each in pictures]
    poses, focal = np.stack([frames[number].pose for number in training]), np.array([c.fl_x for c in cameras])
    found = adjust_poses(find_tracks(features, cameras, poses), poses, focal)
    if found is None:
        say(f"poses: kept, features that photographs share ask for no others; {time.perf_counter() - began:.1f} s")
        return scene, {}
    moved = list(frames)
    for number, pose in zip(training, found.poses):
        frame = frames[number]
        thermal = None if frame.thermal_pose is None else pose @ np.linalg.inv(frame.pose) @ frame.thermal_pose
        moved[number] = replace(frame, pose=pose, thermal_pose=thermal)
    for number in others:
        picture, mask, camera = _picture(frames[number])
        features.append(features_of(picture, mask))
        cameras.append(camera)
    every = np.concatenate((found.poses, [frames[number].pose for number in others])) if others else found.poses
    tracks, fitted = find_tracks(features, cameras, every), {}
    held_out = np.zeros(tracks.points, dtype=bool)
    held_out[tracks.point[tracks.photograph >= len(training)]] = True
    focal = np.array([camera.fl_x for camera in cameras])
    theirs = adjust_poses(tracks.of_points(held_out), every, focal, fixed=len(training)) if held_out.any() else None
    if theirs is not None:
        fitted = dict(zip(others, theirs.poses[len(training) :]))
    say(
        f"poses: those given are off, adjusted to {found.tracks} points that photographs share; features that took no "
        f"part lie {found.after_px:.2f} pixels from their points, {found.before_px:.2f} with the poses given; "
        f"{time.perf_counter() - began:.1f} s (--refine-poses given keeps them)"
    )
    return replace(scene, frames=moved), fitted


def _picture(frame: Frame) -> tuple[npt.NDArray[np.uint8], BoolArray | None, Camera]:
    """Return a photograph in grey, at most `LONGEST_SIDE` pixels long, its mask (None: none), and its scaled camera."""
    grey, mask = frame.read_picture("L", LONGEST_SIDE)
    factor = LONGEST_SIDE / max(grey.size)
    if factor < 1.0:
        size = (max(1, round(factor * grey.size[0])), max(1, round(factor * grey.size[1])))
        grey, mask = grey.resize(size, Image.Resampling.BOX), mask and mask.resize(size, Image.Resampling.NEAREST)
    use = None if mask is None else np.array(mask) > 0
    return np.array(grey), use, frame.intrinsics.resized(*grey.size)
