"""Limits for sizes of files and pictures, errors that name the file, and the facts in EXIF headers."""

from __future__ import annotations

import errno
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import Image

from thermoxels_ns.core.errors import SceneError, ThermalFileError, ThermoxelsError

LARGEST_SIDE = 8192  # largest side of a thermal image, [pixels]: four times that of the largest images (2048)
JPEG_START, PNG_START = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_MAKE, _MODEL, _CHANGED_AT, _TAKEN_AT, _EXIF = 271, 272, 306, 36867, 34665


@contextmanager
def errors_name(
    path: Path | str,
    expected: str,
    remedy: str = "The file is damaged; copy it from the camera again.",
    error: type[ThermoxelsError] = SceneError,
) -> Iterator[None]:
    """Turn any exception in the `with` block, except a `ThermoxelsError`, into an `error` that names `path`.

    The error's message says what the file should be (`expected`) and what to do if the file is damaged (`remedy`).
    """
    try:
        with warnings.catch_warnings():  # Pillow's warnings do not name the file; serious faults raise errors anyway
            warnings.filterwarnings("ignore", module=r"PIL\.")
            yield
    except ThermoxelsError:
        raise
    except Image.DecompressionBombError as problem:
        limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        expected, got = f"a picture of at most {limit} pixels", f"a header that says more ({problem})"
        remedy = "Reduce the picture; or copy the file again, if it is not so large: its header is damaged."
        raise error(str(path), expected=expected, got=got, remedy=remedy) from problem
    except Exception as problem:  # decoders raise OSError, SyntaxError, KeyError, TypeError, struct.error and others
        got = str(problem) or type(problem).__name__
        # An OSError of the operating system has a number (errno); an OSError of a decoder has none.
        if isinstance(problem, OSError) and problem.errno is not None:
            path, got = problem.filename or path, problem.strerror or got
            if problem.errno != errno.ENOENT:
                expected, remedy = "a file that can be read", "Check its permissions and the disk, or copy it again."
        raise error(str(path), expected=expected, got=got, remedy=remedy) from problem


def check_thermal_size(path: Path | str, width: int, height: int) -> None:
    """Raise `ThermalFileError` if the size in a thermal file's header is 0 or above `LARGEST_SIDE` along a side."""
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        expected = f"a thermal image of 1 to {LARGEST_SIDE} pixels a side"
        got = f"a header that says {width} x {height}"
        remedy = "The header is damaged or this is no camera file; copy it again, or cut a mosaic into parts."
        raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)


def check_not_empty(path: Path) -> None:
    """Raise `ThermalFileError` if a file has no bytes."""
    if path.stat().st_size == 0:
        remedy = "Copy it from the camera again, or remove it."
        raise ThermalFileError(str(path), expected="a camera file", got="a file of zero bytes", remedy=remedy)


def app_segments(path: Path, whole: bool = False) -> list[tuple[str, bytes]]:
    """Return the name (APP1, APP3, ...) and content of each application segment of a JPEG. Cameras store data in these.

    With `whole`, the picture is decoded too, so that a file that is cut off raises an error.
    """
    with Image.open(path, formats=("JPEG", "MPO")) as image:
        if whole:
            image.load()
        return list(getattr(image, "applist", []))


def read_exif_facts(image: Image.Image) -> tuple[str | None, datetime | None]:
    """Return, from an opened image's EXIF, maker and model in one text, and the time that the camera's clock showed.

    Each of the two is None if its tags are missing. Pixels are not decoded.
    """
    exif = image.getexif()
    tags: Mapping[int, Any] = {**exif, **exif.get_ifd(_EXIF)}
    camera = " ".join(word for tag in (_MAKE, _MODEL) if (word := _text(tags.get(tag))))
    return camera or None, _time(tags.get(_TAKEN_AT)) or _time(tags.get(_CHANGED_AT))


def _text(value: object) -> str | None:
    return value.split("\0", 1)[0].strip() or None if isinstance(value, str) else None


def _time(value: object) -> datetime | None:
    try:
        return datetime.strptime(str(value), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
