"""Layouts of scene folders: recognises a folder's layout, and makes up a transforms.json for layouts without one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.json_values import read_json_object
from thermoxels_ns.data.colmap_model import (
    COLMAP_FOLDERS,
    camera_to_world,
    is_model,
    lens_entries,
    matched_names,
    read_model,
)

JSON_NAMES = ("transforms.json", "transforms_thermal.json")
BOUNDS_NAME = "temperature_bounds.json"
LayoutName = Literal["thermalnerf", "thermoscenes", "nerfstudio", "rgb", "rgbt-scenes", "thermalmix", "colmap"]
_FRAMES = "frames with "
_THERMAL_CAMERA = ("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True)
class Layout:
    """A layout of scene folders: the signs by which it is recognised, and the places of its parts."""

    name: LayoutName
    marks: tuple[str, ...]
    """Signs, of which a folder must have one: files, folders, keys of frames (``frames with KEY``). Empty: no sign."""
    thermal: tuple[str, ...] = ("thermal",)
    """Folders of thermal files with the photographs' stems; the first that exists is used. Empty: photographs only."""
    photographs: tuple[str, ...] = ()
    """Folders of photographs, one of which must exist, if poses are COLMAP's; empty: a json names and poses them."""


LAYOUTS = (
    Layout("thermalnerf", (f"{_FRAMES}is_thermal",), ("images_thermal",)),
    Layout("thermoscenes", (BOUNDS_NAME, "msx")),
    Layout("nerfstudio", ("thermal", f"{_FRAMES}thermal_file_path")),
    Layout("thermalmix", ("warped_thermal",), ("warped_thermal",), ("rgb", "images")),
    Layout("rgbt-scenes", ("raw_images", "thermal"), ("raw_images", "thermal"), ("rgb",)),
    Layout("colmap", ("thermal",), photographs=("images",)),
    Layout("rgb", (), ()),
    Layout("rgb", (), (), ("images", "rgb")),
)
"""All layouts in the order in which they are tried; the first that fits a folder is the folder's layout."""


@dataclass(frozen=True)
class SceneSource:
    """Places of a scene's parts, and the content of its transforms.json, which is made up if the scene has none."""

    layout: Layout
    folder: Path
    origin: Path  # the json, or the folder of the COLMAP model
    content: dict[str, Any]  # content in the form of transforms.json
    thermal: Path | None  # folder of thermal files; None: no such folder
    left_out: list[str] = field(default_factory=list)  # names of photographs that only the COLMAP model has


def scene_json(data: Path) -> tuple[Path | None, dict[str, Any]]:
    """Return path and unchecked content of a scene folder's json; None and {} if there is none, as with COLMAP.

    `data` is the folder or the json itself. Raises `SceneError` if the json cannot be read.
    """
    named = [data] if data.is_file() and data.suffix == ".json" else [data / name for name in JSON_NAMES]
    path = next((path for path in named if path.is_file()), None)
    return path, {} if path is None else read_json_object(path, "Write the file again.", SceneError)


def find_source(data: Path, wanted: LayoutName | None = None) -> SceneSource:
    """Return the parts of the scene at `data`, a folder or a json, in the layout `wanted`; None: the first that fits.

    Raises `SceneError` if poses or parts of the layout are missing, or the json or COLMAP model cannot be used.
    """
    json_path, content = scene_json(data)
    folder = data if json_path is None else json_path.parent
    frames = content.get("frames")
    keys = {key for frame in frames if isinstance(frame, dict) for key in frame} if isinstance(frames, list) else set()
    model = next((folder / place for place in COLMAP_FOLDERS if is_model(folder / place)), None)

    def there(mark: str) -> bool:
        return mark.removeprefix(_FRAMES) in keys if mark.startswith(_FRAMES) else (folder / mark).exists()

    for layout in LAYOUTS:
        # A json without frames beside a COLMAP model says what the model cannot: scale, up, box, thermal unit.
        origin = model if layout.photographs else json_path if "frames" in content or model is None else None
        root = next((name for name in layout.photographs if (folder / name).is_dir()), "")
        fits = wanted in (None, layout.name) and (not layout.marks or any(map(there, layout.marks)))
        if not fits or origin is None or bool(root) != bool(layout.photographs):
            continue
        left_out: list[str] = []
        if layout.photographs:
            posed, left_out = _content_of_model(folder, origin, root)
            content = content | posed if "frames" not in content else posed
        elif "is_thermal" in keys:
            content = _paired(content, origin.name, alone=not layout.thermal)
        thermal = next((folder / name for name in layout.thermal if (folder / name).is_dir()), None)
        if not layout.thermal and wanted is None and (found := _signs_of_thermal(folder, content)):
            remedy = "Put thermal images into thermal/, named as their photographs, or pass --layout rgb."
            raise SceneError(f"scene folder {folder}", expected="thermal images", got=found, remedy=remedy)
        return SceneSource(layout, folder, origin, content, thermal, left_out)
    expected = f"{' or '.join(JSON_NAMES)}, or a COLMAP model in {COLMAP_FOLDERS[-2]} beside images/ or rgb/"
    got = "none of them" if data.is_dir() else "no such folder"
    remedy = "Pass --data the folder that holds it (thermoxels capture and ns-process-data write it)."
    if wanted is not None and (json_path or model):
        expected, got = f"the parts of the layout {wanted}, which docs/data.md lists", "a folder without them"
        remedy = "Leave --layout out: it is then recognised."
    raise SceneError(f"scene folder {data}", expected=expected, got=got, remedy=remedy)


def _signs_of_thermal(folder: Path, content: dict[str, Any]) -> str:
    """Return a text that lists signs of thermal images in a scene without a thermal layout; empty if there are none."""
    keys = [key for key in ("thermal_camera", "thermal_unit") if key in content]
    folders = [path.name for path in sorted(folder.iterdir()) if path.is_dir()]
    named = [f"{name}/" for name in folders if "therm" in name.lower() or name == "raw_images"]
    return f"photographs alone, beside {', '.join(keys + named)}" if keys or named else ""


def _content_of_model(folder: Path, place: Path, root: str) -> tuple[dict[str, Any], list[str]]:
    """Return the COLMAP model `place` in the form of transforms.json, and the names of images that are left out. Images
    are matched with the photographs in ``folder / root``; images without a clear match (`matched_names`) are left out.
    Photographs in subfolders val and test are also listed in ``val_filenames`` and ``test_filenames``. Raises
    `SceneError` if no image has a match."""
    from PIL import Image  # the help of commands does not need it

    cameras, images, _ = read_model(place)
    pictures = Image.registered_extensions()
    there = (path for path in sorted((folder / root).rglob("*")) if path.suffix.lower() in pictures)
    files = [path.relative_to(folder).as_posix() for path in there]
    posed = sorted(images.values(), key=lambda image: image.name)
    file_of = dict(matched_names([image.name for image in posed], files))
    left_out = [image.name for number, image in enumerate(posed) if number not in file_of]
    frames = []
    for number, image in enumerate(posed):
        if number in file_of:
            camera = cameras[image.camera_id]
            lens = {"camera_model": camera.model, "w": camera.width, "h": camera.height}
            lens |= lens_entries(camera.model, camera.params)
            pose = camera_to_world(image).tolist()
            frames.append({"file_path": files[file_of[number]], "transform_matrix": pose, **lens})
    if not frames:
        got = f"{len(images)} others, such as {', '.join(left_out[:2]) or 'none'}"
        remedy = "Put the photographs there that COLMAP saw, with the names that it saw."
        raise SceneError(str(place), expected=f"photographs in {folder / root}", got=got, remedy=remedy)
    lists = {
        f"{side}_filenames": [one["file_path"] for one in frames if side in PurePosixPath(one["file_path"]).parts[:-1]]
        for side in ("val", "test")
    }
    return {"frames": frames} | {key: names for key, names in lists.items() if names}, left_out


def _paired(content: dict[str, Any], name: str, alone: bool) -> dict[str, Any]:
    """Return the content of a ThermalNeRF json, which has a frame per image, with one frame per pair. The i-th
    photograph's partner is the thermal image with its stem, else the i-th thermal image. With `alone`, there are no
    pairs: the frames are the photographs. `name` names the json in messages. Raises `SceneError` if there are not as
    many thermal images as photographs (but with `alone`)."""
    frames = content["frames"]
    if not all(isinstance(frame, dict) and isinstance(frame.get("file_path"), str) for frame in frames):
        return content  # the reader of frames says which is wrong
    thermal = [frame for frame in frames if frame.get("is_thermal")]
    photographs = [frame for frame in frames if not frame.get("is_thermal")]
    if len(thermal) != len(photographs) and not alone:
        got = f"{len(photographs)} photographs and {len(thermal)} thermal images"
        remedy = "Remove the frames without a partner, or pass --layout rgb to train on photographs alone."
        raise SceneError(f"{name}: is_thermal", expected="as many of both kinds", got=got, remedy=remedy)
    by_stem = {PurePosixPath(frame["file_path"]).stem: frame for frame in thermal}
    pairs, partner = photographs if alone else [], dict[str, str]()
    for photograph, warm in zip([] if alone else photographs, thermal):
        warm = by_stem.get(PurePosixPath(photograph["file_path"]).stem, warm)
        pair = {**photograph, "thermal_file_path": warm["file_path"]}
        partner[PurePosixPath(warm["file_path"]).as_posix()] = photograph["file_path"]
        if "fl_x" in warm:
            pair["thermal_camera"] = {key: both[key] for key in _THERMAL_CAMERA if key in (both := {**content, **warm})}
        if warm.get("transform_matrix") != photograph.get("transform_matrix"):
            pair["thermal_transform_matrix"] = warm.get("transform_matrix")
        pairs.append(pair)
    lists = {key: names for key, names in content.items() if key.endswith("_filenames") and isinstance(names, list)}
    left = {PurePosixPath(frame["file_path"]).as_posix() for frame in thermal}
    for key, names in lists.items():  # a thermal image that a list names stands for its pair
        written = [PurePosixPath(name).as_posix() if isinstance(name, str) else name for name in names]
        lists[key] = list(
            dict.fromkeys(partner.get(name, name) for name in written if name in partner or name not in left)
        )
    return content | {"frames": pairs} | lists
