"""What a folder from a memory card holds: photographs, thermal images, files with both, and what cannot be read."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal

from PIL import Image

from thermoxels_ns.capture.photograph import read_photograph_facts
from thermoxels_ns.data.dji_rjpeg import is_dji_rjpeg
from thermoxels_ns.data.exif_facts import read_exif_facts
from thermoxels_ns.data.flir_rjpeg import is_flir_jpeg, read_flir_jpeg
from thermoxels_ns.data.thermal_size import check_file_size, check_thermal_size
from thermoxels_ns.errors import SceneError, ThermoxelsError, explain

Role = Literal["photograph", "thermal", "both", "thermal picture"]
"""thermal picture: its name says thermal, but it holds colours and no temperatures."""

_PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
SUFFIXES = (*_PICTURES, ".npy", ".csv")
"""Files that are looked at; what else lies on a card (videos, logs, thumbnails of other kinds) is none of ours."""

_THERMAL_WORDS = frozenset({"thermal", "radiometric", "temperature", "temperatures", "celsius", "ir", "tir", "lwir"})
_PHOTOGRAPH_WORDS = frozenset({"visible", "vis", "rgb", "colour", "color", "photo", "photos", "optical"})
_OTHER_WORDS = frozenset({"image", "images", "raw"})
ROLE_WORDS = _THERMAL_WORDS | _PHOTOGRAPH_WORDS | _OTHER_WORDS
_LAST_LETTERS = {"t": "thermal", "v": "photograph", "w": "photograph", "r": "thermal"}
"""Single letters that stand for a camera at the end of a name, after a separator."""


@dataclass(frozen=True)
class CameraFile:
    """One file by its content."""

    path: Path
    role: Role
    taken_at: datetime | None
    """As the camera's clock showed it, without a zone."""


@dataclass(frozen=True)
class CameraFolder:
    """Everything that was found in a folder, sorted by name."""

    folder: Path
    files: tuple[CameraFile, ...]
    unreadable: dict[Path, str] = field(default_factory=dict)
    """Why, by file."""
    others: int = 0
    """Files of other kinds, which were not looked at."""


def words_of(name: str) -> tuple[str, ...]:
    """Cut a name into words of letters and digits, in small letters.

    >>> words_of("10-58-15-636-Visible")
    ('10', '58', '15', '636', 'visible')
    """
    return tuple(word for word in re.split(r"[^a-z0-9]+", name.lower()) if word)


def natural_key(path: Path) -> list[tuple[int, str, int]]:
    """Sorts names as people do: 2 before 10.

    >>> sorted([Path("b10"), Path("b2")], key=natural_key)[0].name
    'b2'
    """
    parts = re.findall(r"\d+|\D+", path.as_posix().lower())
    return [(0, "", int(part)) if part.isdigit() else (1, part, 0) for part in parts]


def scan_folder(
    folder: Path, without: Sequence[Path] = (), say: Callable[[str], None] = lambda _: None
) -> CameraFolder:
    """Look at every picture and table in a folder and the folders in it.

    Hidden files and folders are passed over, and so are links that lead out of the folder.

    Args:
        folder: What the user hands over.
        without: Folders in it that are none of the camera's, such as the output.
        say: Told how far it is.

    Raises:
        SceneError: There is no such folder.
    """
    if not folder.is_dir():
        raise SceneError(
            explain(
                "input",
                expected="a folder with camera files",
                got=f"{'a file' if folder.exists() else 'nothing'} at {folder}",
                remedy="Pass the folder that the memory card was copied to.",
            )
        )
    root = folder.resolve()
    skipped = [path.resolve() for path in without]
    files, unreadable, others = [], dict[Path, str](), 0
    found = [path for path in folder.rglob("*") if path.is_file()]
    found = sorted(found, key=lambda path: natural_key(path.relative_to(folder)))
    for number, path in enumerate(found):
        real = path.resolve()
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if hidden or not real.is_relative_to(root) or any(real.is_relative_to(each) for each in skipped):
            continue
        if path.suffix.lower() not in SUFFIXES:
            others += 1
            continue
        try:
            files.append(look_at(path, folder))
        except (ThermoxelsError, OSError) as problem:
            unreadable[path] = str(problem)
        if (number + 1) % 100 == 0:
            say(f"files: {number + 1} of {len(found)}")
    return CameraFolder(folder, tuple(files), unreadable, others)


def look_at(path: Path, folder: Path) -> CameraFile:
    """Tell by content what a file is; its name only tells a thermal picture from a photograph.

    Raises:
        SceneError, ThermalFileError: It is empty, damaged or no picture.
    """
    check_file_size(path)
    suffix = path.suffix.lower()
    if suffix in (".npy", ".csv"):
        return CameraFile(path, "thermal", None)
    if suffix in (".jpg", ".jpeg"):
        if is_flir_jpeg(path):
            flir = read_flir_jpeg(path)
            taken_at = flir.camera.taken_at
            role: Role = "thermal" if flir.visible is None else "both"
            return CameraFile(path, role, None if taken_at is None else taken_at.replace(tzinfo=None))
        with path.open("rb") as stream:
            head = stream.read(2**18)
        if is_dji_rjpeg(head) or is_dji_rjpeg(path.read_bytes()):
            return CameraFile(path, "thermal", read_photograph_facts(path).taken_at)
    else:
        found = _count_image(path)
        if found is not None:
            return found
    facts = read_photograph_facts(path)
    return CameraFile(path, "thermal picture" if _named_thermal(path, folder) else "photograph", facts.taken_at)


def _count_image(path: Path) -> CameraFile | None:
    """A TIFF or PNG of one channel of more than 8 bits, which no photograph is; None for others."""
    try:
        with Image.open(path) as image:
            if image.mode != "F" and not image.mode.startswith("I"):
                return None
            check_thermal_size(path, *image.size)
            return CameraFile(path, "thermal", read_exif_facts(image).taken_at)
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as problem:
        if isinstance(problem, ThermoxelsError):
            raise
        raise SceneError(
            explain(
                str(path),
                expected="a TIFF or PNG that can be decoded",
                got=str(problem) or type(problem).__name__,
                remedy="The file is damaged; copy it from the camera again.",
            )
        ) from problem


def _named_thermal(path: Path, folder: Path) -> bool:
    """Whether a name says thermal: by a word in it, by its last letter, or by the nearest folder that says anything."""
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
