"""Scene folders read and checked: transforms.json, photographs and their thermal partners."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from PIL import Image

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import is_number, plain_os_errors
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.json_values import read_json_object
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.data.layouts import BOUNDS_NAME, LayoutName, find_source
from thermoxels_ns.data.scene_scale import scale_from_scene_file
from thermoxels_ns.data.transforms_json import DAMAGED_PHOTOGRAPH, read_intrinsics, read_pose
from thermoxels_ns.radiometry.decoders import errors_name
from thermoxels_ns.radiometry.thermal_pixels import THERMAL_SUFFIXES, ThermalUnit

_HOTTEST_C = 10_000  # no thermal camera measures more


@dataclass(frozen=True)
class Frame:
    """One photograph with its thermal image, pose and camera."""

    name: str  # `file_path` of the photograph in the json, with forward slashes
    image: Path
    thermal: Path | None  # None in a scene of photographs alone
    mask: Path | None  # image that is white in pixels of the photograph that may be used; None: no mask
    pose: FloatArray  # camera to world, shape (4, 4), OpenGL axes (x right, y up, z back), input coordinates
    intrinsics: Camera  # camera of the photograph
    thermal_pose: FloatArray | None  # pose of the thermal camera, in the form of `pose`; None: the photograph's pose
    thermal_intrinsics: Camera | None
    """Camera of the thermal image; None: the photograph's, scaled to the thermal image's resolution."""

    def read_picture(self, mode: Literal["RGB", "L"], longest_side: int) -> tuple[Image.Image, Image.Image | None]:
        """Return the photograph in colour or grey, and its mask at the photograph's returned size (None: no mask).

        A large JPEG is decoded at a fraction of its size, but with at least `longest_side` pixels on its longest side.
        Raises `SceneError` if a file cannot be read.
        """
        with errors_name(self.image, "a readable photograph", DAMAGED_PHOTOGRAPH), Image.open(self.image) as opened:
            opened.draft(mode, (longest_side, longest_side))
            picture = opened.convert(mode)
        if self.mask is None:
            return picture, None
        with errors_name(self.mask, "a readable mask", "Write the mask again."), Image.open(self.mask) as opened:
            return picture, opened.convert("L").resize(picture.size, Image.Resampling.NEAREST)


@dataclass(frozen=True)
class SceneFile:
    """The checked content of a scene folder."""

    folder: Path
    json_path: Path  # the json, or the folder of the COLMAP model that poses come from
    frames: list[Frame]  # sorted by name
    unit: ThermalUnit  # unit of the numbers in thermal files
    bounds_c: tuple[float, float] | None  # lowest and highest temperature of temperature_bounds.json, [degrees Celsius]
    meta: dict[str, Any]  # content of the json (split lists, scene_box, ply_file_path, ...), see `SceneSource.content`
    left_out: list[str] = field(default_factory=list)  # names of frames that missing_thermal="skip" left out
    layout: str = ""  # text for the log: the layout and the places of its parts

    @property
    def has_thermal(self) -> bool:
        """False for a scene of photographs alone."""
        return self.frames[0].thermal is not None


@plain_os_errors("scene folder", "a file or folder that can be read", "Check permissions and names.", SceneError)
def read_scene_file(
    data: Path,
    missing_thermal: Literal["error", "skip"] = "error",
    layout: LayoutName | None = None,
    thermal_bounds: tuple[float, float] | None = None,
) -> SceneFile:
    """Return the content of a scene folder (or of the json in it), with all checks that need no decoded image.

    `layout` is one of `thermoxels_ns.data.layouts`; None: the first that fits. A photograph's thermal image is the file
    that `thermal_file_path` names, else the file with the same stem in the layout's folder of thermal files. With
    `missing_thermal` "skip", frames without a thermal image are left out and listed in `SceneFile.left_out`.
    `thermal_bounds`, the temperatures [degrees Celsius] of black and white, replace those of temperature_bounds.json.
    Raises `SceneError` if an entry or a file is missing, doubled, not finite or contradictory; the message names it.
    """
    source = find_source(data, layout)
    json_path, folder, meta = source.origin, source.folder, source.content
    alone, thermal_folder = not source.layout.thermal, source.thermal or folder / "thermal"
    entries = meta.get("frames")
    if not isinstance(entries, list) or not entries:
        expected = "a list 'frames' with one posed photograph per entry"
        remedy = "Run structure from motion (ns-process-data) on the photographs first."
        raise SceneError(json_path.name, expected=expected, got="no frames: the scene has no poses", remedy=remedy)
    by_stem: dict[str, list[Path]] = {}
    for path in sorted(thermal_folder.rglob("*")) if source.thermal else []:
        if path.suffix.lower() in THERMAL_SUFFIXES and not path.name.startswith("."):
            by_stem.setdefault(path.stem, []).append(path)
    there = sum(map(len, by_stem.values()))
    named = [entry["file_path"] for entry in entries if isinstance(entry, dict) and "file_path" in entry]
    folders = {Path(str(name)).parent.name for name in named}  # a thermal image in one of these is of its photographs
    frames, left_out, place = [], [], f"{thermal_folder.name}/"
    for index, entry in enumerate(entries):
        where = f"{json_path.name}: frame {index}"
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
            raise SceneError(where, expected="an object with 'file_path'", got=entry, remedy="Correct the json.")
        name = Path(entry["file_path"]).as_posix()
        where = f"{where} ({name})"
        image = _existing(folder, name, where, "file_path")
        if alone:
            frames.append(_frame(meta, entry, name, image, None, folder, where))
            continue
        if "thermal_file_path" in entry:
            partners = [path] if (path := folder / str(entry["thermal_file_path"])).is_file() else []
        else:
            every = by_stem.get(image.stem, [])
            beside = [path for path in every if path.parent.name == image.parent.name]  # as in rgb/train, thermal/train
            here = [path for path in every if path.parent == thermal_folder]
            partners = beside or here or [path for path in every if path.parent.name not in folders]
        if len(partners) > 1:
            remedy = "Keep one of them, or name it with 'thermal_file_path' in the frame."
            got = ", ".join(path.name for path in partners)
            raise SceneError(f"thermal partner of {image.name}", expected="one file", got=got, remedy=remedy)
        if partners:
            frames.append(_frame(meta, entry, name, image, partners[0], folder, where))
        else:
            left_out.append(name)
    if not frames:
        remedy = (
            f"Put them in {place}, named like the photographs, or name them with 'thermal_file_path' in the json; or "
            "pass --layout rgb to train on the photographs alone."
        )
        got = f"{len(entries)} frames, none with one ({there} files in {place})"
        raise SceneError(json_path.name, expected="frames with a thermal image", got=got, remedy=remedy)
    if missing_thermal == "error" and left_out:
        expected = f"a thermal image for each of the {len(entries)} frames (thermal_file_path, or the stem in {place})"
        got = f"none for {len(left_out)}: {_some(left_out)} ({there} files in {place})"
        remedy = "Restore the thermal images, remove these frames, or pass --missing-thermal skip."
        raise SceneError(json_path.name, expected=expected, got=got, remedy=remedy)
    warm = [frame.thermal for frame in frames if frame.thermal is not None]
    for kind, paths in (("photograph", [frame.image for frame in frames]), ("thermal image", warm)):
        twice = [path.name for path, count in Counter(path.resolve() for path in paths).items() if count > 1]
        if twice:
            remedy = "Remove the duplicate frames: one of them could leak from training to evaluation."
            got = f"{_some(twice)} more than once"
            raise SceneError(json_path.name, expected=f"every {kind} in one frame only", got=got, remedy=remedy)
    masks = sum(frame.mask is not None for frame in frames)
    if masks not in (0, len(frames)):
        expected, got = "a mask for every frame or for none", f"{masks} masks for {len(frames)} frames"
        remedy = "Add the missing ones (white: use the pixel)."
        raise SceneError(f"{json_path.name}: mask_path", expected=expected, got=got, remedy=remedy)
    scale_from_scene_file(meta)  # raises for a wrong scale, and for a wrong direction up
    bounds = _read_bounds(folder) if thermal_bounds is None else thermal_bounds
    if thermal_bounds is not None and not -ZERO_CELSIUS_K <= thermal_bounds[0] < thermal_bounds[1] <= _HOTTEST_C:
        expected, got = "degrees Celsius of black and, higher, of white", "{:g} and {:g}".format(*thermal_bounds)
        remedy = "Pass --thermal-bounds -5 42, for example."
        raise SceneError("thermal_bounds", expected=expected, got=got, remedy=remedy)
    frames.sort(key=lambda frame: frame.name)
    read = "photographs alone" if alone else f"thermal images {f'in {place}' if there else 'named in the json'}"
    if bounds and bounds[0] > bounds[1]:  # as in some published scenes
        bounds, read = (bounds[1], bounds[0]), f"{read}, the two keys of {BOUNDS_NAME} swapped"
    unit = _unit({} if thermal_bounds else meta, json_path, bounds)
    words = f"{source.layout.name}: poses from {json_path.relative_to(folder).as_posix()}, {read}"
    left_out = [*source.left_out, *left_out]
    return SceneFile(folder, json_path, frames, unit, bounds, meta, left_out, words)


def _read_bounds(folder: Path) -> tuple[float, float] | None:
    path = folder / BOUNDS_NAME
    if not path.exists():
        return None
    if not path.is_file():
        remedy = "Move it away; bounds are a json file of this name."
        raise SceneError(str(path), expected="a file", got="a folder", remedy=remedy)
    content = read_json_object(path, "Write the file again.", SceneError)
    keys = ("absolute_min_temperature", "absolute_max_temperature")
    given = [content.get(key) for key in keys]
    bounds = [float(value) for value in given if is_number(value) and -ZERO_CELSIUS_K <= value <= _HOTTEST_C]
    if len(bounds) < 2:
        expected = f"{keys[0]} and {keys[1]}, degrees Celsius from absolute zero to {_HOTTEST_C:.0f}"
        remedy = "Correct the file, or remove it if the thermal files hold degrees Celsius."
        raise SceneError(str(path), expected=expected, got=dict(zip(keys, given)), remedy=remedy)
    return bounds[0], bounds[1]


def _unit(meta: dict[str, Any], json_path: Path, bounds: tuple[float, float] | None) -> ThermalUnit:
    if "thermal_unit" in meta:
        unit = meta["thermal_unit"]
        try:
            numbers = [unit["celsius_per_count"], unit["celsius_offset"]]
            if not all(map(is_number, numbers)):
                raise ValueError("text, or true or false")
            return ThermalUnit.linear(*map(float, numbers))
        except (KeyError, TypeError, ValueError, OverflowError) as problem:
            expected, where = "numbers celsius_per_count (not 0) and celsius_offset", f"{json_path.name}: thermal_unit"
            raise SceneError(where, expected=expected, got=unit, remedy="Correct the json.") from problem
    return ThermalUnit.bounds(*bounds) if bounds else ThermalUnit()


def _frame(
    meta: dict[str, Any], entry: dict[str, Any], name: str, image: Path, thermal: Path | None, folder: Path, where: str
) -> Frame:
    thermal_pose = thermal_intrinsics = None
    if thermal is not None and "thermal_transform_matrix" in entry:
        thermal_pose = read_pose(entry["thermal_transform_matrix"], f"{where}: thermal_transform_matrix")
    camera = None if thermal is None else entry.get("thermal_camera", meta.get("thermal_camera"))
    if camera is not None:
        if not isinstance(camera, dict):
            raise SceneError(where, expected="'thermal_camera' as an object", got=camera, remedy="Correct the json.")
        thermal_intrinsics = read_intrinsics({}, camera, None, f"{where}: thermal_camera")
    elif thermal_pose is not None:
        expected = "'thermal_camera' (w, h, fl_x, fl_y, cx, cy) beside 'thermal_transform_matrix'"
        remedy = "Add it at the top of the json or in every frame."
        raise SceneError(where, expected=expected, got="no thermal_camera", remedy=remedy)
    mask, named = None, entry.get("mask_path")
    if "mask_path" in entry:
        if not isinstance(named, str):
            remedy = "Name the mask; or leave mask_path out of all frames if none has a mask."
            raise SceneError(f"{where}: mask_path", expected="a file name", got=repr(named), remedy=remedy)
        mask = _existing(folder, named, where, "mask_path")
    if "transform_matrix" not in entry:
        remedy = "Remove the frame or run structure from motion again."
        raise SceneError(where, expected="'transform_matrix', the camera's pose", got="none", remedy=remedy)
    pose = read_pose(entry["transform_matrix"], f"{where}: transform_matrix")
    intrinsics = read_intrinsics(meta, entry, image, where)
    return Frame(name, image, thermal, mask, pose, intrinsics, thermal_pose, thermal_intrinsics)


def _existing(folder: Path, name: str, where: str, key: str) -> Path:
    if (folder / name).is_file():
        return folder / name
    remedy = "Restore it or remove the frame."
    raise SceneError(where, expected=f"the file of '{key}'", got=f"nothing at {folder / name}", remedy=remedy)


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
