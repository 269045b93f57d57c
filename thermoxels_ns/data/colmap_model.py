"""The COLMAP model in a scene's folder: where it lies, and reading it."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import SceneError

_PARTS = ("cameras", "images", "points3D")
COLMAP_FOLDERS = ("colmap/sparse/0", "colmap/sparse", "colmap", "colmap_sparse/0", "sparse/0", "sparse")
"""Places of a COLMAP model in a scene's folder; the first that holds a model counts."""

_LEAST_CAMERA_BYTES = 48  # size of a camera with three parameters in cameras.bin; cameras with more are larger
_LAYOUT = {"frames": (64, "<I", 16), "images": (64, "<Q", 24), "points3D": (43, "<Q", 8)}
"""Layout of an entry in a .bin file: bytes before the number of its parts (of an image: before its name), the format of
that number, bytes of each part."""


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


def _incomplete(folder: Path) -> str:
    """Return which file of a COLMAP model cannot be opened, or ends before the last entry that it announces; or "".

    pycolmap says of an unreadable file that it is no model, and may read a truncated file for ever.
    """
    for name in ("cameras", "frames", "images", "points3D"):
        for path in (folder / f"{name}.txt", folder / f"{name}.bin"):
            if not path.is_file():
                continue
            try:
                with path.open("rb") as file:
                    whole = path.suffix == ".txt" or _complete(name, file.read())
            except OSError as problem:
                return f"{path.name}: {problem.strerror}; check its permissions and the disk"
            if not whole:
                return f"{path.name} ends before its last entry, as after an interrupted copy"
    return ""


def _complete(name: str, data: bytes) -> bool:
    try:
        (count,) = struct.unpack_from("<Q", data)
        end = 8
        if name == "cameras":
            return len(data) >= end + count * _LEAST_CAMERA_BYTES
        before, kind, size = _LAYOUT[name]
        for _ in range(count):
            end += before
            if name == "images":
                end = data.index(b"\0", end) + 1
            (parts,) = struct.unpack_from(kind, data, end)
            end += struct.calcsize(kind) + parts * size
    except (struct.error, ValueError):  # a number, or the end of a name, lies behind the end of the data
        return False
    return end <= len(data)
