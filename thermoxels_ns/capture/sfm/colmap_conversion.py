"""Turns COLMAP's models into ours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data.tracks import camera_to_world, read_model

_FIELDS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""COLMAP's lens models that ours can hold, and the order of their numbers."""


def model_of_colmap(
    reconstruction: Any, frame_of_image: Mapping[str, str], size: tuple[int, int] | None = None
) -> SfmModel:
    """Turn a pycolmap reconstruction into our model, without the images that are not in `frame_of_image`.

    `size` is the photographs' width and height where the model was made from smaller ones. A `SceneError` is raised
    where no frame has a pose, or there are several cameras or an unknown lens model.
    """
    posed = {i: image for i, image in reconstruction.images.items() if image.has_pose and image.name in frame_of_image}
    posed = dict(sorted(posed.items(), key=lambda item: frame_of_image[item[1].name]))
    cameras = {image.camera_id for image in posed.values()}
    if len(cameras) != 1:
        remedy = "Give a model of these photographs with one camera (--ImageReader.single_camera 1)."
        got = f"{len(posed)} of the {len(frame_of_image)} photographs, of {len(cameras)} cameras"
        raise SceneError("COLMAP model", expected="photographs of one camera", got=got, remedy=remedy)
    camera = reconstruction.cameras[cameras.pop()]
    name = camera.model.name
    if name not in _FIELDS:
        remedy = "Run COLMAP with --ImageReader.camera_model OPENCV, or let thermoxels capture find the poses."
        raise SceneError("COLMAP camera", expected="a lens model out of " + ", ".join(_FIELDS), got=name, remedy=remedy)
    values: dict[str, Any] = dict(zip(_FIELDS[name], map(float, camera.params)))
    focal = values.pop("f", None)
    if focal is not None:
        values |= {"fl_x": focal, "fl_y": focal}
    found = Camera(int(camera.width), int(camera.height), **values)
    size = size or (found.width, found.height)
    factor = np.array([size[0] / found.width, size[1] / found.height])
    ids = sorted(reconstruction.points3D)
    points = [reconstruction.points3D[i] for i in ids]
    number = {i: n for n, i in enumerate(ids)}
    poses, frames, seen, pixels = [], [], [], []
    for index, image in enumerate(posed.values()):
        poses.append(camera_to_world(image))
        # A track may hold two features of one photograph; the first one is kept.
        own = {number[f.point3D_id]: f.xy for f in reversed(image.points2D) if f.has_point3D()}
        order = sorted(own)
        frames += [index] * len(order)
        seen += order
        pixels += [own[point] for point in order]
    return SfmModel(
        tuple(frame_of_image[image.name] for image in posed.values()),
        found.resized(*size),
        np.stack(poses),
        np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        np.array([point.error for point in points], dtype=np.float64) * float(factor.mean()),
        np.array(frames, dtype=np.int64),
        np.array(seen, dtype=np.int64),
        np.array(pixels, dtype=np.float64).reshape(-1, 2) * factor,
    )


def read_colmap(folder: Path) -> Any:
    """Read a COLMAP model's folder; a `SceneError` where it holds no readable model."""
    try:
        return read_model(folder)
    except SceneError as problem:
        expected = "a COLMAP model (cameras, images and points3D as .bin or .txt)"
        remedy = "Pass --poses the folder that holds them, such as sparse/0."
        raise SceneError(str(folder), expected=expected, got=problem, remedy=remedy) from problem
