"""Sorts the files of a memory card into photographs, thermal images and unreadable files."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal

from PIL import Image

from thermoxels_ns.capture.photograph import read_photograph_facts
from thermoxels_ns.core.errors import SceneError, ThermoxelsError, printable
from thermoxels_ns.radiometry.decoders import check_not_empty, check_thermal_size, errors_name, read_exif_facts
from thermoxels_ns.radiometry.dji_rjpeg import is_dji_rjpeg
from thermoxels_ns.radiometry.flir_rjpeg import is_flir_jpeg, read_flir_jpeg
from thermoxels_ns.radiometry.thermal_pixels import THERMAL_SUFFIXES

Role = Literal["photograph", "thermal", "both", "thermal picture"]
"""What a camera file holds. "both": photograph and temperatures; "thermal picture": colours alone, named thermal."""

_THERMAL_WORDS = frozenset({"thermal", "radiometric", "temperature", "temperatures", "celsius", "ir", "tir", "lwir"})
_PHOTOGRAPH_WORDS = frozenset({"visible", "vis", "rgb", "colour", "color", "photo", "photos", "optical"})
_OTHER_WORDS = frozenset({"image", "images", "raw"})
ROLE_WORDS = _THERMAL_WORDS | _PHOTOGRAPH_WORDS | _OTHER_WORDS


@dataclass(frozen=True)
class CameraFile:
    """One readable camera file and what it holds."""

    path: Path
    role: Role
    taken_at: datetime | None  # as the camera's clock showed it, without a time zone


@dataclass(frozen=True)
class CameraFolder:
    """All files of a folder and its subfolders, sorted by name (`natural_key`)."""

    folder: Path
    files: tuple[CameraFile, ...]
    unreadable: dict[Path, str] = field(default_factory=dict)  # reason by file
    others: int = 0  # number of other files (videos, logs), which were not opened


def words_of(name: str) -> tuple[str, ...]:
    """Split a name into lower-case words of letters (of any alphabet) and digits.

    >>> words_of("10-58-15-636-Visible")
    ('10', '58', '15', '636', 'visible')
    """
    whole = unicodedata.normalize("NFC", name)  # some disks keep a letter and its accent apart
    return tuple(word for word in re.split(r"[\W_]+", whole.lower()) if word)


def natural_key(path: Path) -> list[tuple[int, str, int]]:
    """Return a path's key for sorting, in which numbers within names are ordered by value: 2 before 10.

    >>> sorted([Path("b10"), Path("b2")], key=natural_key)[0].name
    'b2'
    """
    parts = re.findall(r"\d+|\D+", path.as_posix().lower())
    return [(0, "", int(part)) if part.isdecimal() else (1, part, 0) for part in parts]


def scan_folder(
    folder: Path, without: Sequence[Path] = (), say: Callable[[str], None] = lambda _: None
) -> CameraFolder:
    """Return the role of every picture and table in a folder and its subfolders, except the folders `without`.

    Hidden files and folders, linked folders and pipes are skipped. `say` receives progress, and folders that cannot be
    opened. Raises `SceneError` if `folder` is no folder.
    """
    if not folder.is_dir():
        remedy = "Pass the folder that the memory card was copied to."
        got = f"{'a file' if folder.exists() else 'nothing'} at {folder}"
        raise SceneError("input", expected="a folder with camera files", got=got, remedy=remedy)
    files, unreadable, others = [], dict[Path, str](), 0
    found = files_below(folder, without, say)
    for number, path in enumerate(found):
        if path.suffix.lower() not in THERMAL_SUFFIXES:
            others += 1
            continue
        try:
            name = str(path.relative_to(folder))
            if printable(name) != name:
                got = "one with line breaks, control characters or bytes of no encoding"
                raise SceneError(name, expected="a name that can be printed", got=got, remedy="Rename the file.")
            files.append(identify(path, folder))
        except ThermoxelsError as problem:
            unreadable[path] = str(problem)
        if (number + 1) % 100 == 0:
            say(f"files: {number + 1} of {len(found)}")
    return CameraFolder(folder, tuple(files), unreadable, others)


def files_below(folder: Path, without: Sequence[Path] = (), say: Callable[[str], None] = lambda _: None) -> list[Path]:
    """Return the files of a folder and its subfolders, except the folders `without`, sorted by `natural_key`."""
    skipped, files = [path.resolve() for path in without], []
    shut = lambda problem: say(f"passed over: {problem.filename} ({problem.strerror})")  # noqa: E731
    for place, folders, names in os.walk(folder, onerror=shut):
        here = Path(place)
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".") and not any((here / name).resolve().is_relative_to(each) for each in skipped)
        ]
        files += [here / name for name in names if not name.startswith(".") and (here / name).is_file()]
    # The second part of the key gives names that differ only in capitals the same order on every disk.
    return sorted(files, key=lambda path: (natural_key(path.relative_to(folder)), path.as_posix()))


def identify(path: Path, folder: Path) -> CameraFile:
    """Return a file and its role, by content, or for plain pictures by the names of file and folders below `folder`.

    Raises `ThermoxelsError` if the file is damaged.
    """
    with errors_name(path, "a camera file that can be decoded"):
        check_not_empty(path)
        suffix = path.suffix.lower()
        if suffix in (".npy", ".csv"):
            return CameraFile(path, "thermal", None)
        if suffix in (".jpg", ".jpeg"):
            if is_flir_jpeg(path):
                flir = read_flir_jpeg(path)
                taken_at = flir.camera.taken_at
                role: Role = "thermal" if flir.visible is None else "both"
                return CameraFile(path, role, None if taken_at is None else taken_at.replace(tzinfo=None))
            if is_dji_rjpeg(path):
                return CameraFile(path, "thermal", read_photograph_facts(path).taken_at)
        else:
            with Image.open(path) as image:
                # A picture with one channel of more than 8 bits is no photograph.
                if image.mode == "F" or image.mode.startswith("I"):
                    check_thermal_size(path, *image.size)
                    return CameraFile(path, "thermal", read_exif_facts(image)[1])
        facts = read_photograph_facts(path)
        return CameraFile(path, "thermal picture" if _named_thermal(path, folder) else "photograph", facts.taken_at)


def _named_thermal(path: Path, folder: Path) -> bool:
    """Return whether a picture's name marks it as thermal: by a last word "t", or by a word such as "thermal". Without
    such a word, or one such as "visible", in the file's name, the nearest folder with one decides."""
    words = words_of(path.stem)
    if len(words) > 1 and words[-1] == "t":
        return True
    for name in (path.stem, *reversed(path.relative_to(folder).parts[:-1])):
        said = set(words_of(name))
        if said & _THERMAL_WORDS:
            return True
        if said & _PHOTOGRAPH_WORDS:
            return False
    return False
