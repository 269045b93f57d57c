"""Entries of transforms.json read and checked: poses, intrinsics, file names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import is_number
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.radiometry.decoders import errors_name

_NUMBERS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")  # k1 ... in nerfstudio's order
_ORIENTATION = 0x0112
_LONGEST_LENS = 1e4  # largest focal length relative to the photograph's side: an angle of view of 0.006 degrees
_MOST_DISTORTION = 10.0
"""Largest shift of an image corner by one term of the distortion, in distances of the corner from the middle."""
MOST_UNITS = 1e8  # largest coordinate of a camera; the earth's radius is 6.4e6 m
DAMAGED_PHOTOGRAPH = "The file is damaged; copy it again or remove the frame."
_CAMERA_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def read_pose(values: Any, where: str, turned: bool = True) -> FloatArray:
    """Return a camera-to-world matrix (4, 4) from 3 x 4 or 4 x 4 numbers of a json; `where` names them in messages.

    Raises `SceneError` unless all numbers are finite, the camera's coordinates are within `MOST_UNITS`, a fourth row is
    0, 0, 0, 1, and the upper left 3 x 3 is a rotation. If `turned` is False, the upper left may be any matrix.
    """
    try:
        entries = np.array(values, dtype=object)
    except ValueError:  # rows differ in length
        entries = np.zeros(0, dtype=object)
    odd = [repr(entry)[:80] for entry in entries.ravel() if not is_number(entry)]
    if odd or entries.shape not in ((3, 4), (4, 4)):
        got = f"{odd[0]} among them" if odd else f"shape {entries.shape}"
        raise SceneError(where, expected="4 x 4 numbers", got=got, remedy="Correct the json.")
    matrix = entries.astype(np.float64)
    pose = np.eye(4)
    pose[:3] = matrix[:3]
    remedy = "Remove the frame or run structure from motion again."
    if not np.isfinite(pose).all():
        raise SceneError(where, expected="finite numbers", got="NaN or infinity", remedy=remedy)
    if np.abs(pose[:3, 3]).max() > MOST_UNITS:
        expected = f"coordinates within {MOST_UNITS:.0e} units of the origin"
        raise SceneError(where, expected=expected, got=pose[:3, 3].tolist(), remedy=remedy)
    if len(matrix) == 4 and not np.allclose(matrix[3], pose[3], rtol=0.0, atol=1e-6):
        got, remedy = matrix[3].tolist(), "Write camera to world, with the camera's place in the last column."
        raise SceneError(where, expected="0, 0, 0, 1 in the last row", got=got, remedy=remedy)
    rotation = pose[:3, :3]
    if turned and (np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0):
        raise SceneError(where, expected="a rotation in the upper left 3 x 3", got=rotation.tolist(), remedy=remedy)
    return pose


def read_intrinsics(meta: dict[str, Any], entry: dict[str, Any], image: Path | None, where: str) -> Camera:
    """Return a frame's camera from the json: each value is that of its `entry`, else that of the scene's `meta`.
    Missing w and h are the width and height of the file `image`; None: no file to compare with. Raises `SceneError`,
    which names `where`, for values that are missing, that no lens has, or that do not fit `image`."""
    values = {**meta, **entry}
    remedy = "Correct the json."
    model = values.get("camera_model", "OPENCV")
    if model not in _CAMERA_MODELS:
        expected = f"one of {', '.join(_CAMERA_MODELS)}"
        undistort = "Undistort the photographs to a pinhole camera."
        if model == "EQUIRECTANGULAR":
            undistort = "Cut each panorama into perspective photographs, each with its pose."
        raise SceneError(f"{where}: camera_model", expected=expected, got=model, remedy=undistort)
    size, orientation = None, 1
    if image is not None:
        named = f"{where}: {image.name}"
        with errors_name(named, "a readable photograph", DAMAGED_PHOTOGRAPH), Image.open(image) as opened:
            size = opened.size
            if (values.get("h"), values.get("w")) == size:  # only then: reading EXIF of a PNG reads all pixels
                orientation = int(opened.getexif().get(_ORIENTATION, 1))
    try:
        if any(isinstance(value, bool) for key, value in values.items() if key in _NUMBERS):
            raise ValueError("true or false")
        own = values if size is None else dict(zip("wh", size)) | values
        width, height = int(own["w"]), int(own["h"])
        if any(isinstance(side, float) and not side.is_integer() for side in (own["w"], own["h"])):
            raise ValueError(f"{own['w']} x {own['h']}, where w and h are whole numbers of pixels")
        numbers: dict[str, Any] = {key: float(values[key]) for key in ("fl_x", "fl_y", "cx", "cy")}
        names = _NUMBERS[6:]
        listed = values.get("distortion_params", [values.get(key, 0.0) for key in names])
        numbers |= {key: float(value) for key, value in zip(names, listed, strict=True)}
        camera = Camera(width, height, **numbers)
    except KeyError as problem:
        expected, got = "intrinsics fl_x, fl_y, cx, cy, w, h", f"no {problem.args[0]}"
        raise SceneError(where, expected=expected, got=got, remedy=remedy) from problem
    except SceneError as problem:
        expected = "finite intrinsics, positive focal lengths and size"
        raise SceneError(where, expected=expected, got=problem, remedy=remedy) from problem
    except (TypeError, ValueError, OverflowError) as problem:
        expected = "numbers as intrinsics, six of them for distortion_params"
        raise SceneError(where, expected=expected, got=problem, remedy=remedy) from problem
    _refuse_odd(camera, where)
    if size is not None and (height, width) == size and orientation > 4:
        expected = f"a photograph stored as {width} x {height} pixels, as the intrinsics say"
        got = f"{size[0]} x {size[1]} and EXIF orientation {orientation}: it is stored on its side"
        remedy = "Turn the photographs themselves: mogrify -auto-orient images/* (ImageMagick) does."
        raise SceneError(where, expected=expected, got=got, remedy=remedy)
    if size is not None and (width, height) != size:
        expected, got = f"a photograph of {width} x {height} pixels as the intrinsics say", f"{size[0]} x {size[1]}"
        remedy = "Use the photographs that the poses were computed from, or scale the intrinsics."
        raise SceneError(where, expected=expected, got=got, remedy=remedy)
    return camera


def _refuse_odd(camera: Camera, where: str) -> None:
    """Raise `SceneError` for a principal point, a focal length or a distortion that no lens has."""
    corner = min(0.5 * float(np.hypot(camera.width / camera.fl_x, camera.height / camera.fl_y)), 1e30)
    shifts = {"cx": camera.cx / camera.width, "cy": camera.cy / camera.height}
    odd = [name for name, shift in shifts.items() if not -1.0 <= shift <= 2.0]
    sides = {"fl_x": camera.width, "fl_y": camera.height}
    odd += [name for name, side in sides.items() if getattr(camera, name) > _LONGEST_LENS * side]
    odd += [f"k{n}" for n in (1, 2, 3, 4) if abs(camera.distortion[n - 1]) * corner ** (2 * n) > _MOST_DISTORTION]
    odd += [name for name in ("p1", "p2") if abs(getattr(camera, name)) * corner > _MOST_DISTORTION]
    if odd:
        expected = (
            "a principal point in or near the image, focal lengths of a lens, and distortion that leaves the corners "
            "where they can be"
        )
        got = ", ".join(f"{name} {getattr(camera, name):g}" for name in odd)
        remedy = "Correct the json; lengths are in pixels, k1 to k4, p1 and p2 as in OpenCV."
        raise SceneError(where, expected=expected, got=got, remedy=remedy)
