"""Finds the COLMAP model in a scene's folder, reads it, and matches its images with files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from os.path import splitext
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray

_PARTS = ("cameras", "images", "points3D")
COLMAP_FOLDERS = ("colmap/sparse/0", "colmap/sparse", "colmap", "colmap_sparse/0", "sparse/0", "sparse")
"""Folders, relative to a scene's folder, in which a COLMAP model may lie; the first that holds a model is used."""
PARAMETERS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""Parameters of each of COLMAP's lens models, in COLMAP's order, by the keys in transforms.json; f is fl_x and fl_y."""


def is_model(folder: Path) -> bool:
    """Return whether a folder holds the three files of a COLMAP model, binary or text."""
    return all(any((folder / f"{part}.{suffix}").is_file() for suffix in ("bin", "txt")) for part in _PARTS)


def read_model(folder: Path) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any]]:
    """Return the cameras, the posed images and the points of the COLMAP model in a folder, each by its number there.

    The values are records of nerfstudio's reader. It notices a file that is cut off, while pycolmap never finishes
    reading a points3D.bin that is cut off. Raises `SceneError` if a file cannot be read.
    """
    from nerfstudio.data.utils import colmap_parsing_utils  # both slow to import, and only needed here

    from thermoxels_ns.radiometry.decoders import errors_name

    kind = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    remedy = "Copy it again, or run COLMAP again; it lies in a folder such as sparse/0."
    with errors_name(folder, "a COLMAP model (cameras, images, points3D as .bin or .txt) that can be read", remedy):
        model: Any = colmap_parsing_utils.read_model(str(folder), kind)
        return model


def camera_to_world(image: Any) -> FloatArray:
    """Return the camera-to-world pose (4, 4) of an image of `read_model`, in OpenGL axes (x right, y up, z back)."""
    pose = np.eye(4)
    pose[:3, :3] = image.qvec2rotmat().T
    pose[:3, 3] = -pose[:3, :3] @ image.tvec
    return pose @ np.diag([1.0, -1.0, -1.0, 1.0])


def lens_entries(model: str, parameters: Iterable[float]) -> dict[str, float]:
    """Return the parameters of a lens model by their keys in transforms.json; empty for a model not in `PARAMETERS`.

    >>> lens_entries("SIMPLE_PINHOLE", [500.0, 320.0, 240.0])
    {'cx': 320.0, 'cy': 240.0, 'fl_x': 500.0, 'fl_y': 500.0}
    """
    values = dict(zip(PARAMETERS.get(model, ()), map(float, parameters)))
    if "f" in values:
        values["fl_x"] = values["fl_y"] = values.pop("f")
    return values


def matched_names(images: Sequence[str], files: Sequence[str]) -> list[tuple[int, int]]:
    """Return the pairs (index of an image, index of a file) that are the same photograph, sorted by the file's index.

    A file belongs to the image whose name, folders included, is the end of the file's name; of several, to the longest.
    Names that several images have, and images to which several files belong, are left out. What is then left is matched
    again by names without suffixes.

    >>> matched_names(["1.jpg", "left/1.jpg"], ["images/left/1.png", "images/1.png", "images/1.jpg"])
    [(1, 0), (0, 2)]
    """
    found: dict[int, int] = {}
    for stem in (lambda name: name, lambda name: splitext(name)[0]):
        names = {place: PurePosixPath(stem(image)).as_posix() for place, image in enumerate(images)}
        names = {place: name for place, name in names.items() if place not in found}
        often, taken = Counter(names.values()), set(found.values())
        number = {name: place for place, name in names.items() if often[name] == 1}
        pairs = []
        for place, file in enumerate(files):
            parts = PurePosixPath(stem(file)).parts if place not in taken else ()
            endings = ("/".join(parts[first:]) for first in range(len(parts)))
            pairs += [(number[ending], place) for ending in endings if ending in number][:1]
        once = Counter(image for image, _ in pairs)
        found |= {image: place for image, place in pairs if once[image] == 1}
    return sorted(found.items(), key=lambda pair: pair[1])
