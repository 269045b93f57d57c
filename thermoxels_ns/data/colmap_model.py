"""Find, check and read a COLMAP model beside a scene."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import SceneError

COLMAP_FOLDERS = ("colmap/sparse/0", "colmap/sparse", "colmap", "sparse/0", "sparse")
"""Where a model may lie in a scene's folder, the first that does counts."""

_LEAST_CAMERA_BYTES = 48  # of a camera with three parameters; others have more
_FRAME_BYTES, _DATUM_BYTES = 64, 16  # of a frame before the number of its images, and of each of them
_POINT_BYTES, _SIGHTING_BYTES = 43, 8  # of a point before the length of its track, and of each element of the track
_IMAGE_BYTES, _FEATURE_BYTES = 64, 24  # of an image before its name, and of each of its features
_LENGTH = struct.Struct("<Q")


def read_model(folder: Path) -> Any:
    """Read the COLMAP model in a folder as a `pycolmap.Reconstruction`; a `SceneError` where a file is not whole."""
    import pycolmap  # slow to import and only needed here

    check_complete(folder)
    try:
        return pycolmap.Reconstruction(str(folder))
    except Exception as problem:  # pycolmap raises RuntimeError, ValueError, IndexError by version
        raise SceneError(f"it cannot be read, {(str(problem).strip() or repr(problem)).splitlines()[-1]}") from problem


def camera_to_world(image: Any) -> FloatArray:
    """Pose of a pycolmap image, camera axes x right, y up, z back as transforms.json has them, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    return pose @ np.diag([1.0, -1.0, -1.0, 1.0])


def check_complete(folder: Path) -> None:
    """Refuse a model with a file (named) that may not be read, or ends before what it announces.

    Of the one pycolmap would say that it is none, of the other it would read on behind the end.
    """
    for name in ("cameras", "frames", "images", "points3D"):
        for path in (folder / f"{name}.txt", folder / f"{name}.bin"):
            if not path.is_file():
                continue
            try:
                with path.open("rb") as file:
                    whole = path.suffix == ".txt" or _complete(name, file.read())
            except OSError as problem:
                got = f"{path.name}: {problem.strerror}; check its permissions and the disk"
                raise SceneError(f"it cannot be read, {got}") from problem
            if not whole:
                said = f"{path.name} ends before its last entry, as after an interrupted copy"
                raise SceneError(f"it cannot be read, {said}")


def _complete(name: str, data: bytes) -> bool:
    try:
        (count,) = struct.unpack_from("<Q", data)
        end = 8
        if name == "cameras":
            return len(data) >= end + count * _LEAST_CAMERA_BYTES
        behind = {"frames": _behind_frame, "images": _behind_image, "points3D": _behind_point}[name]
        for _ in range(count):
            end = behind(data, end)
    except (struct.error, ValueError):  # a number, or the end of a name, behind the end
        return False
    return end <= len(data)


def _behind_frame(data: bytes, begin: int) -> int:
    """Place of the byte behind the frame that begins at a byte."""
    (images,) = struct.unpack_from("<I", data, begin + _FRAME_BYTES)
    return begin + _FRAME_BYTES + 4 + images * _DATUM_BYTES


def _behind_point(data: bytes, begin: int) -> int:
    """Place of the byte behind the point that begins at a byte."""
    (sightings,) = _LENGTH.unpack_from(data, begin + _POINT_BYTES)
    return begin + _POINT_BYTES + 8 + sightings * _SIGHTING_BYTES


def _behind_image(data: bytes, begin: int) -> int:
    """Place of the byte behind the image that begins at a byte."""
    features_at = data.index(b"\0", begin + _IMAGE_BYTES) + 1
    (features,) = _LENGTH.unpack_from(data, features_at)
    return features_at + 8 + features * _FEATURE_BYTES
