"""The COLMAP model in a scene's folder: where it lies, and reading it."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import SceneError

_PARTS = ("cameras", "images", "points3D")
COLMAP_FOLDERS = ("colmap/sparse/0", "colmap/sparse", "colmap", "colmap_sparse/0", "sparse/0", "sparse")
"""Places of a COLMAP model in a scene's folder; the first that holds a model counts."""

_LEAST_CAMERA_BYTES = 48  # Size of a camera with three parameters in cameras.bin; cameras with more are larger
_LEGACY_TRANSFORM = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Swap of axes by old versions of ns-process-data, before the json had applied_transform."""


def is_model(folder: Path) -> bool:
    """Return whether a folder holds the three files of a COLMAP model, binary or text."""
    return all(any((folder / f"{part}.{suffix}").is_file() for suffix in ("bin", "txt")) for part in _PARTS)


def read_model(folder: Path) -> Any:
    """Read the COLMAP model in a folder as a `pycolmap.Reconstruction`, or raise `SceneError` if it cannot be read."""
    import pycolmap  # slow to import and only needed here

    said = _incomplete(folder)
    if not said:
        try:
            return pycolmap.Reconstruction(str(folder))
        except Exception as problem:  # pycolmap raises RuntimeError, ValueError, IndexError by version
            said = (str(problem).strip() or repr(problem)).splitlines()[-1]
    expected, got = "a COLMAP model (cameras, images, points3D as .bin or .txt)", f"one that cannot be read: {said}"
    remedy = "Copy it again, or run COLMAP again; it lies in a folder such as sparse/0."
    raise SceneError(str(folder), expected=expected, got=got, remedy=remedy)


def camera_to_world(image: Any) -> FloatArray:
    """Return the camera-to-world pose (4, 4) of a pycolmap image, with camera axes x right, y up, z back (OpenGL)."""
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    return pose @ np.diag([1.0, -1.0, -1.0, 1.0])


def worlds_of_json(meta: Mapping[str, Any]) -> list[FloatArray]:
    """Return the matrices (4, 4) that may bring COLMAP's world to that of the poses in a json, `meta`.

    That is the json's ``applied_transform``; without one, no change or the swap of axes of old ns-process-data.
    """
    if "applied_transform" in meta:
        from thermoxels_ns.data.transforms_json import read_pose  # loads PIL, which the help of commands does not need

        return [read_pose(meta["applied_transform"], "applied_transform", turned=False)]
    return [np.eye(4), _LEGACY_TRANSFORM]


def _incomplete(folder: Path) -> str:
    """Return which file of a COLMAP model cannot be opened, or ends before its last camera or point; or "".

    pycolmap says of an unreadable file that it is no model, reads a truncated cameras.bin without a word, and a
    truncated points3D.bin for ever.
    """
    for name in ("cameras", "frames", "images", "points3D"):
        for path in (folder / f"{name}.txt", folder / f"{name}.bin"):
            try:
                data = path.read_bytes() if path.is_file() else None
            except OSError as problem:
                return f"{path.name}: {problem.strerror}; check its permissions and the disk"
            whole = {"points3D.bin": _complete_points, "cameras.bin": _complete_cameras}.get(path.name)
            if data is not None and whole is not None and not whole(data):
                return f"{path.name} ends before its last entry, as after an interrupted copy"
    return ""


def _complete_cameras(data: bytes) -> bool:
    """Return whether cameras.bin is long enough for the cameras that it announces, of three parameters at least."""
    return len(data) >= 8 and len(data) >= 8 + _LEAST_CAMERA_BYTES * struct.unpack_from("<Q", data)[0]


def _complete_points(data: bytes) -> bool:
    """Return whether the points that points3D.bin announces are there: 43 bytes, a count, and 8 bytes per sighting."""
    try:
        (count,), end = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            (sightings,) = struct.unpack_from("<Q", data, end + 43)
            end += 51 + 8 * sightings
    except struct.error:  # a number lies behind the end of the data
        return False
    return end <= len(data)
