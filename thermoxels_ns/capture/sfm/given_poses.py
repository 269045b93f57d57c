"""Poses that the user brings along: a COLMAP model, or the transforms.json of another program."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np

from thermoxels_ns.capture.sfm.colmap import model_of_colmap, read_colmap
from thermoxels_ns.capture.sfm.poses import Poses, common_size, why_other_size
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.json_values import read_json
from thermoxels_ns.data.transforms_json import path_inside, read_intrinsics, read_pose


def read_given_poses(path: Path, photographs: Mapping[str, str]) -> Poses:
    """Read poses from a COLMAP model's folder or a transforms.json; their world stays as it is.

    `photographs` are the camera's files, relative to the capture, by the frame's name. The model of a transforms.json
    has no points; the frames without a pose are named. A `SceneError` is raised where nothing readable is there, no
    photograph is in it, it has several cameras, or a name in it leads out of its folder.
    """
    if path.is_dir():
        reconstruction = read_colmap(path)
        names = [image.name for image in reconstruction.images.values()]
        model = model_of_colmap(reconstruction, _frames_of(names, photographs, path))
    elif path.is_file():
        model = _read_transforms(path, photographs)
    else:
        expected, got = "a COLMAP model's folder or a transforms.json", f"nothing at {path}"
        raise SceneError("poses", expected=expected, got=got, remedy="Check the path.")
    missing = {name: f"{path.name} has no pose of it" for name in photographs if name not in model.frames}
    return Poses(model, missing)


def fitted_to_photographs(poses: Poses, photographs: Mapping[str, Path]) -> Poses:
    """Express given poses in the pixels of the photographs; they may come from photographs that were reduced.

    Frames whose photographs have another size than most are left out; other proportions are a `SceneError`.
    """
    size, other = common_size({name: photographs[name] for name in poses.model.frames})
    dropped = dict(poses.dropped) | why_other_size(size, other)
    model, camera = poses.model.without(list(other)), poses.model.camera
    if size == (camera.width, camera.height):
        return Poses(model, dropped)
    factors = np.array([size[0] / camera.width, size[1] / camera.height])
    # The sides of a reduced image are rounded to whole pixels.
    if abs(factors[0] / factors[1] - 1.0) > 1.0 / min(*size, camera.width, camera.height):
        expected = f"photographs with the proportions of {camera.width} x {camera.height} pixels, as their camera has"
        remedy = "Use the photographs that the poses were computed from, neither cropped nor turned."
        raise SceneError("given poses", expected=expected, got=f"{size[0]} x {size[1]}", remedy=remedy)
    error_px, pixel = model.point_error_px * float(factors.mean()), model.sighting_pixel * factors
    return Poses(replace(model, camera=camera.resized(*size), point_error_px=error_px, sighting_pixel=pixel), dropped)


def _read_transforms(path: Path, photographs: Mapping[str, str]) -> SfmModel:
    content: Any = read_json(path)
    entries = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise SceneError(str(path), expected="a list 'frames'", got="none", remedy="Pass another transforms.json.")
    numbers = {}
    for index, entry in enumerate(entries):
        name = str(entry.get("file_path", ""))
        path_inside(path.parent, name, f"{path.name}: frame {index}")
        numbers[name] = index
    frames, poses, cameras = [], [], set()
    for name, frame in _frames_of(list(numbers), photographs, path).items():
        entry, where = entries[numbers[name]], f"{path.name}: frame {numbers[name]}"
        camera = read_intrinsics(content, entry, None, where)
        if camera.k3 or camera.k4 or camera.lens != "perspective":
            expected = "a perspective lens with distortion k1, k2, p1, p2"
            got = f"{camera.lens}, k3 {camera.k3}, k4 {camera.k4}"
            raise SceneError(where, expected=expected, got=got, remedy="Undistort first.")
        cameras.add(camera)
        frames.append(frame)
        poses.append(read_pose(entry.get("transform_matrix"), f"{where}: transform_matrix"))
    if len(cameras) != 1:
        remedy = "Give one set of intrinsics for all frames, or let thermoxels capture find the poses."
        got = f"{len(frames)} photographs of {len(cameras)} cameras"
        raise SceneError(str(path), expected="photographs of one camera", got=got, remedy=remedy)
    none, sightings = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    points = none, none.astype(np.uint8), none[:, 0]
    return SfmModel(tuple(frames), cameras.pop(), np.stack(poses), *points, sightings, sightings, none[:, :2])


def _frames_of(names: list[str], photographs: Mapping[str, str], path: Path) -> dict[str, str]:
    """Frame by name in a file of poses, in the photographs' order; a stem will do where it is clear."""
    by_file: dict[str, list[str]] = {}
    for frame, source in photographs.items():
        for key in {source, PurePosixPath(source).name, PurePosixPath(source).stem, frame}:
            by_file.setdefault(key.lower(), []).append(frame)
    found: dict[str, str] = {}
    for name in names:
        plain = PureWindowsPath(name).as_posix()
        for key in (plain, PurePosixPath(plain).name, PurePosixPath(plain).stem):
            frames = by_file.get(key.lower(), [])
            if len(frames) == 1:
                found[name] = frames[0]
                break
    twice = {frame for frame, count in Counter(found.values()).items() if count > 1}
    if not found or twice:
        remedy = "Pass the poses of these photographs; they are recognised by their file names."
        got = f"{sorted(twice)[0]} twice" if twice else f"{names[0] if names else 'no name'} and no known one"
        raise SceneError(str(path), expected="names of the capture's photographs", got=got, remedy=remedy)
    order = list(photographs)
    return dict(sorted(found.items(), key=lambda item: order.index(item[1])))
