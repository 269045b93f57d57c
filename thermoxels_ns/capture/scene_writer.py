"""Writes the scene folder that the dataparser reads: photographs, temperatures, COLMAP's model, transforms.json."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.capture.rig_types import OPENGL_FROM_OPENCV, DriftEstimate, RigEstimate
from thermoxels_ns.capture.sfm.poses import scene_names
from thermoxels_ns.capture.sfm.scale_and_up import Up
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.capture.stage_cache import CACHE_FOLDER
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import remove_file, writable_folder
from thermoxels_ns.core.json_values import write_json
from thermoxels_ns.data.colmap_model import COLMAP_FOLDERS
from thermoxels_ns.data.scene_scale import SceneScale

JSON_NAME = "transforms.json"
_FOLDERS = ("images", "thermal", COLMAP_FOLDERS[0])
_COPIED = {"JPEG": ".jpg", "PNG": ".png"}


@dataclass(frozen=True)
class Scene:
    """Everything that a scene folder is written from; `frames` are in the order of `model.frames`."""

    frames: Sequence[CaptureFrame]
    model: SfmModel
    colmap: Path  # folder of COLMAP's model of the same photographs and points
    moved: FloatArray  # matrix from the coordinates of COLMAP's model to those of `model`, shape (4, 4)
    rig: RigEstimate
    drift: DriftEstimate
    scale: SceneScale | None
    up: Up


def write_scene_folder(scene: Scene, output: Path, say: Callable[[str], None] = lambda _: None) -> None:
    """Write a scene into `output`, in place of an earlier one. The last file, transforms.json, marks it as complete."""
    new = output / CACHE_FOLDER / "new_scene"
    shutil.rmtree(new, ignore_errors=True)
    for name in _FOLDERS:
        writable_folder(new / name)
    entries = []
    for number, (frame, name) in enumerate(zip(scene.frames, scene_names(len(scene.frames)))):
        entries.append(_write_frame(scene, number, frame, name, new))
        if (number + 1) % 20 == 0:
            say(f"scene: {number + 1} of {len(scene.frames)} frames")
    shutil.copytree(scene.colmap, new / COLMAP_FOLDERS[0], dirs_exist_ok=True)
    write_json(new / JSON_NAME, _content(scene, entries))
    remove_file(output / JSON_NAME)
    for name in _FOLDERS:
        shutil.rmtree(output / name, ignore_errors=True)
        writable_folder((output / name).parent)
        (new / name).rename(output / name)
    (new / JSON_NAME).replace(output / JSON_NAME)
    shutil.rmtree(new, ignore_errors=True)


def _write_frame(scene: Scene, number: int, frame: CaptureFrame, name: str, folder: Path) -> dict[str, Any]:
    with Image.open(frame.photograph) as image:
        suffix = _COPIED.get(image.format or "") if image.mode == "RGB" else None
    photograph = folder / "images" / f"{name}{suffix or '.png'}"
    if suffix is not None:
        shutil.copyfile(frame.photograph, photograph)
    else:
        open_photograph(frame.photograph).save(photograph)
    temperature_c = scene.drift.corrected(number, np.load(frame.thermal))
    Image.fromarray(temperature_c).save(folder / "thermal" / f"{name}.tiff")
    pose = scene.model.camera_to_world[number]
    thermal_pose = pose @ OPENGL_FROM_OPENCV @ np.linalg.inv(scene.rig.visible_to_thermal) @ OPENGL_FROM_OPENCV
    return {
        "file_path": f"images/{photograph.name}",
        "thermal_file_path": f"thermal/{name}.tiff",
        "transform_matrix": pose.tolist(),
        "thermal_transform_matrix": thermal_pose.tolist(),
        "source": frame.name,
        "thermal_source": frame.thermal_source,
    }


def _content(scene: Scene, entries: list[dict[str, Any]]) -> dict[str, Any]:
    rig, drift = scene.rig, scene.drift
    disagreement = {"before": drift.before_k, "after": drift.after_k}
    content: dict[str, Any] = {
        **scene.model.camera.entries(),
        "thermal_camera": rig.thermal_camera.entries(),
        "pixel_convention": "the centre of the top left pixel is at (0.5, 0.5)",
        "up": scene.up.direction.tolist(),
        "applied_transform": scene.moved[:3].tolist(),
        "rig": rig.visible_to_thermal.tolist(),
        "rig_info": {
            "meaning": "x_thermal = rig @ x_visible, both in OpenCV camera axes, translation in units of the scene",
            "determined": rig.determined,
            "explanation": rig.explanation,
            "standard_errors": {k: v for k, v in rig.standard_errors.items() if np.isfinite(v)},
        },
        "drift": {
            "corrected": drift.used,
            "offsets_k": drift.offsets_k.tolist(),
            "radial_k": list(drift.radial),
            **{f"disagreement_{name}_k": k for name, k in disagreement.items() if np.isfinite(k)},
            "explanation": drift.explanation,
        },
    }
    if scene.scale is not None:
        content["metres_per_unit"] = scene.scale.metres_per_unit
        if scene.scale.standard_error is not None:
            content["metres_per_unit_standard_error"] = scene.scale.standard_error
    return content | {"frames": entries}
