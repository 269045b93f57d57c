"""Write a synthetic scene as a scene folder, and load the exact scene that belongs to a folder."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image
from rich.progress import track
from scipy.spatial.transform import Rotation

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_ranges, remove_file, replace_when_done, writable_folder
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.json_values import read_json_object, write_json
from thermoxels_ns.synthetic.drawn_scenes import make_scene
from thermoxels_ns.synthetic.imperfections import PERFECT, DrawnFlaws, Imperfections
from thermoxels_ns.synthetic.raycast import first_surface, render_view
from thermoxels_ns.synthetic.scene_truth import SyntheticScene

_Frames = list[dict[str, Any]]
LayoutName = Literal["thermoscenes", "nerfstudio", "thermalnerf", "rgbt-scenes", "thermalmix", "colmap", "rgb"]
PhotoFormat = Literal["jpg", "png"]  # JPEG as cameras write; PNG, which loses nothing

_IN_DEGREES = ("nerfstudio", "thermalmix")  # layouts with thermal images as .npy [C]; all others have 16-bit PNG
_FOLDERS: dict[LayoutName, tuple[str, str, str]] = {
    "thermoscenes": ("images", "thermal", ""),
    "nerfstudio": ("images", "thermal", ""),
    "thermalnerf": ("images", "images_thermal", ""),
    "rgbt-scenes": ("rgb/{}", "thermal/{}", "sparse/0"),
    "thermalmix": ("rgb", "warped_thermal", "colmap_sparse/0"),
    "colmap": ("images", "thermal", "sparse/0"),
    "rgb": ("images", "", ""),
}
"""Folders of photographs ({}: train or test), of thermal images and of the COLMAP model ("": none) in each layout."""
_BOUNDS, _JSON = "temperature_bounds.json", "transforms.json"
_SAME_POINT = 1e-6  # tolerance for rounding, as a share of the distance from the camera to a point
_POINTS_PER_VIEW = 50  # number of random pixels in each view whose surface points are put into the COLMAP model
_JPEG_QUALITY = 92
TRUTH = "truth.json"
_LARGEST_COUNT = 65535
_MOST_SIDE = 4096  # most pixels along a side of an image: all rays of an image are in memory at once
# Lens, turn (1 degree) and shift (2 % of the scene) of a separate thermal camera, relative to the photographs' camera.
_THERMAL_ASPECT, _THERMAL_ZOOM, _THERMAL_CENTRE_SHIFT = 0.8, 0.95, (-0.012, 0.008)
_RIG_ROTATION_RAD = (0.005, -0.018, 0.003)
_RIG_SHIFT_SHARE = (0.02, 0.004, 0.006)


def write_scene(
    scene: SyntheticScene,
    folder: Path | str,
    num_train: int = 42,
    num_eval: int = 6,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    own_thermal_camera: bool = False,
    photo_format: PhotoFormat = "jpg",
    imperfections: Imperfections = PERFECT,
    progress: bool = True,
    layout: LayoutName = "thermoscenes",
) -> Path:
    """Write photographs and thermal images of a scene, and their poses, into a folder, and return the folder's path.

    The `layout` "thermoscenes" has ``images/``, ``thermal/`` with 16-bit PNG that span the temperature bounds,
    ``temperature_bounds.json`` and, written last, ``transforms.json`` with poses, scale (metres) and up (z). Its files
    are named ``frame_train_`` and ``frame_eval_``. ``docs/data.md`` describes the other layouts; the thermal images of
    "nerfstudio" and "thermalmix" are degrees Celsius as ``.npy``. The scene's name and exact box and the drawn
    `imperfections` are written to ``truth.json``, which training never reads.

    An earlier synthetic scene in the folder is removed. Held-out views (`num_eval`) lie between training views
    (`num_train`). Photographs have `width` x `height` pixels. With `own_thermal_camera`, thermal images are half as
    wide and have a lens (``thermal_camera``) and poses (``thermal_transform_matrix``) of their own. The same `seed`
    writes the same bytes.

    Raises:
        SceneError: An option is out of range, or the folder contains a scene that is not synthetic.
        OutputError: The folder cannot be written to.
    """
    thermal_camera, offset = _thermal_camera(scene, width, height, own_thermal_camera)
    photographs, thermals, model = _FOLDERS[layout]
    if own_thermal_camera and (model or not thermals):
        expected = "one camera for both, which is all that this layout can say"
        remedy = "Leave --own-thermal-camera out, or pass --layout thermalnerf."
        raise SceneError("own_thermal_camera", expected=expected, got=f"True and layout {layout}", remedy=remedy)
    camera = scene.camera(width, height)
    train, held_out = scene.poses(num_train, num_eval)
    names = [f"frame_{kind}_{i + 1:05d}" for kind, n in (("train", num_train), ("eval", num_eval)) for i in range(n)]
    poses = np.concatenate([train, held_out])
    flaws = DrawnFlaws(imperfections, seed, poses, np.mean(scene.scene_box, axis=0))
    given_poses = flaws.given_poses()
    bounds = flaws.bounds_c(*scene.temperature_bounds_c)
    celsius_per_count, suffix = (bounds[1] - bounds[0]) / _LARGEST_COUNT, ".npy" if layout in _IN_DEGREES else ".png"

    target = _prepared_folder(folder, layout)
    frames: _Frames = []
    for number, name in enumerate(track(names, description=f"Photographing {scene.name}", disable=not progress)):
        view = thermal_view = render_view(scene, poses[number], camera)
        if thermal_camera != camera:
            thermal_view = render_view(scene, poses[number] @ offset, thermal_camera)
        measured_c = flaws.thermogram(number, thermal_view.temperature_c)
        side = "train" if number < num_train else "test"
        frame: dict[str, Any] = {
            "file_path": f"{photographs.format(side)}/{name}.{photo_format}",
            "thermal_file_path": f"{thermals.format(side)}/{name}{suffix}",
            "transform_matrix": given_poses[number].tolist(),
        }
        if own_thermal_camera:
            frame["thermal_transform_matrix"] = (given_poses[number] @ offset).tolist()
        with replace_when_done(target / frame["file_path"]) as path:
            Image.fromarray(flaws.photograph(number, view.rgb)).save(path, quality=_JPEG_QUALITY)
        frames.append(frame)
        if not thermals:
            continue
        with replace_when_done(target / frame["thermal_file_path"]) as path:
            if layout in _IN_DEGREES:
                np.save(path, measured_c.astype(np.float32))
            else:
                counts = np.round((measured_c - bounds[0]) / celsius_per_count)
                Image.fromarray(np.clip(counts, 0, _LARGEST_COUNT).astype(np.uint16)).save(path)

    if thermals and layout not in _IN_DEGREES:
        named = {"absolute_min_temperature": bounds[0], "absolute_max_temperature": bounds[1]}
        write_json(target / _BOUNDS, named)
    transforms: dict[str, Any] = flaws.given_camera(camera).entries()
    if layout == "thermalnerf":
        # All photographs, then all thermal images, each with the entries of its camera; the model is the same for all.
        own = thermal_camera.entries()
        kept = {key: transforms.pop(key) for key in own if key != "camera_model"}
        seen = [{k: frame[k] for k in ("file_path", "transform_matrix")} | kept | {"is_thermal": 0} for frame in frames]
        for frame in frames:
            pose = frame.get("thermal_transform_matrix", frame["transform_matrix"])
            warm = {"file_path": frame["thermal_file_path"], "transform_matrix": pose}
            seen.append(warm | own | {"is_thermal": 1})
        frames = seen
    elif layout != "thermoscenes":  # thermal images belong to the photographs of the same name
        frames = [{key: value for key, value in frame.items() if key != "thermal_file_path"} for frame in frames]
    if own_thermal_camera and layout != "thermalnerf":
        transforms["thermal_camera"] = thermal_camera.entries()
    transforms |= {"metres_per_unit": 1.0, "up": [0, 0, 1], "frames": frames}
    truth = {"synthetic_scene": scene.name, "scene_box": scene.scene_box, "seed": seed}
    write_json(target / TRUTH, truth | flaws.truth())
    if model:
        _write_colmap_model(target / model, scene, poses, frames, camera, flaws.given_camera(camera), seed)
    else:
        write_json(target / _JSON, transforms)
    return target


def _write_colmap_model(
    folder: Path, scene: SyntheticScene, poses: FloatArray, frames: _Frames, camera: Camera, given: Camera, seed: int
) -> None:
    """Write a COLMAP model as text into `folder`: random surface points, and the photographs that see each point. The
    true `poses` (n, 4, 4) and `camera` decide what is seen. The written poses are those in `frames` and the written
    lens is `given`; both may have errors."""
    generator, points = np.random.default_rng(seed), []
    for pose in poses:
        rays = camera.directions(pose).reshape(-1, 3)
        rays = rays[generator.choice(len(rays), min(_POINTS_PER_VIEW, len(rays)), replace=False)]
        length, own = first_surface(scene, pose[:3, 3], rays)
        points.append(pose[:3, 3] + length[own, None] * rays[own])
    points = np.concatenate(points)
    tracks: list[list[str]] = [[] for _ in points]
    images = []
    for number, (pose, frame) in enumerate(zip(poses, frames), start=1):
        pixels = camera.project_world(pose, points)
        (inside,) = np.nonzero(camera.contains(pixels))
        reached, _ = first_surface(scene, pose[:3, 3], points[inside] - pose[:3, 3])
        shown = inside[reached >= 1.0 - _SAME_POINT]
        for place, point in enumerate(shown):
            tracks[point].append(f"{number} {place}")
        world = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0]))
        x, y, z, w = Rotation.from_matrix(world[:3, :3]).as_quat()
        placed = " ".join(map(repr, map(float, (w, x, y, z, *world[:3, 3]))))
        images.append(f"{number} {placed} 1 {Path(frame['file_path']).name}")
        images.append(" ".join(f"{u:.3f} {v:.3f} {point + 1}" for (u, v), point in zip(pixels[shown], shown)))
    _, _, _, *lens = given.entries().values()
    seen = [
        f"{number} {x!r} {y!r} {z!r} 128 128 128 0.5 {' '.join(track)}"
        for number, ((x, y, z), track) in enumerate(zip(points.tolist(), tracks), start=1)
        if len(track) > 1
    ]
    writable_folder(folder)
    for name, lines in (
        ("cameras", [f"1 OPENCV {given.width} {given.height} {' '.join(repr(float(value)) for value in lens)}"]),
        ("images", images),
        ("points3D", seen),
    ):
        with replace_when_done(folder / f"{name}.txt") as path:
            path.write_text("\n".join(lines) + "\n")


def load_truth(scene_folder: Path | str) -> SyntheticScene | None:
    """Return the exact scene from which a folder was written; None without a ``truth.json``, as for real photographs.

    Raises `SceneError` if ``truth.json`` is unreadable, or names a scene that does not exist.
    """
    path = Path(scene_folder) / TRUTH
    if not path.is_file():
        return None
    truth = read_json_object(path, "Check the scene folder, or write the scene again.", SceneError)
    if not isinstance(truth.get("synthetic_scene"), str):
        expected = 'an object with the text "synthetic_scene"'
        remedy = "Write the scene again, or remove the file for real photographs."
        raise SceneError(TRUTH, expected=expected, got=json.dumps(truth), remedy=remedy)
    return make_scene(truth["synthetic_scene"])


def _thermal_camera(scene: SyntheticScene, width: int, height: int, own: bool) -> tuple[Camera, FloatArray]:
    """Return the camera of the thermal images and its pose (4, 4) in the frame of the photographs' camera. With `own`,
    the thermal camera has half as many columns, a slightly different field of view and an off-centre principal point;
    otherwise it is the photographs' camera."""
    sizes = {"width": width, "height": height}
    check_ranges("--", {name: (value, 1, _MOST_SIDE, f"1 to {_MOST_SIDE} pixels") for name, value in sizes.items()})
    offset = np.eye(4)
    if not own:
        return scene.camera(width, height), offset
    columns = max(width // 2, 1)
    plain = scene.camera(columns, max(round(columns * _THERMAL_ASPECT), 1))
    focal, (dx, dy) = plain.fl_x * _THERMAL_ZOOM, (columns * shift for shift in _THERMAL_CENTRE_SHIFT)
    offset[:3, :3] = Rotation.from_euler("xyz", _RIG_ROTATION_RAD).as_matrix()
    offset[:3, 3] = np.multiply(_RIG_SHIFT_SHARE, scene.size)
    return replace(plain, fl_x=focal, fl_y=focal, cx=plain.cx + dx, cy=plain.cy + dy), offset


def _prepared_folder(folder: Path | str, layout: LayoutName) -> Path:
    """Make the folders of a layout, remove an earlier synthetic scene, and return the path; refuse any other scene."""
    target = writable_folder(folder)
    folders = {model for *_, model in _FOLDERS.values() if model}
    models = [f"{model}/{part}.txt" for model in folders for part in ("cameras", "images", "points3D")]
    if (target / TRUTH).is_file():
        pictures = {f"{name.format('*')}/frame_*" for one in _FOLDERS.values() for name in one[:2] if name}
        for pattern in (_JSON, _BOUNDS, *models, *pictures):
            for path in target.glob(pattern):
                remove_file(path)  # truth.json stays until it is replaced: it marks the folder as synthetic
        for one in sorted((path for path in target.rglob("*") if path.is_dir()), reverse=True):
            with suppress(OSError):  # an empty folder would tell of another layout
                one.rmdir()
    elif any((target / name).exists() for name in (_JSON, *models)):
        expected = "an empty folder or one with an earlier synthetic scene"
        got = f"{target}, which holds a scene of other photographs"
        raise SceneError("output folder", expected=expected, got=got, remedy="Choose another folder.")
    for name in _FOLDERS[layout][:2]:
        for side in ("train", "test") if name else ():
            writable_folder(target / name.format(side))
    return target
