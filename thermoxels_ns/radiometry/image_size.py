"""The largest thermal image that is believed: a header that claims more is refused before anything is allocated."""

from __future__ import annotations

from pathlib import Path

from thermoxels_ns.core.errors import ThermalFileError

LARGEST_SIDE = 8192
"""Pixels along a side: four times the largest thermal sensors and super-resolution modes (about 2048)."""
LARGEST_FILE_BYTES = 2**29
"""A table of 4096 x 4096 numbers of 30 characters; camera files are far smaller."""


def check_thermal_size(path: Path | str, width: int, height: int) -> None:
    """Raise if a thermal file says that it is larger than thermal cameras make them, or has no pixels.

    Raises:
        ThermalFileError: A side is zero or longer than `LARGEST_SIDE`.
    """
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        raise ThermalFileError(
            str(path),
            expected=f"a thermal image of 1 to {LARGEST_SIDE} pixels a side",
            got=f"a header that says {width} x {height}",
            remedy="The header is damaged or this is no camera file; copy it again, or cut a mosaic into parts.",
        )


def check_file_size(path: Path) -> None:
    """Raise if a thermal file is empty or larger than any camera writes.

    Raises:
        ThermalFileError: It has no bytes or more than `LARGEST_FILE_BYTES`.
    """
    size = path.stat().st_size
    if size == 0:
        raise ThermalFileError(
            str(path),
            expected="a camera file",
            got="a file of zero bytes",
            remedy="Copy it from the camera again, or remove it.",
        )
    if size > LARGEST_FILE_BYTES:
        raise ThermalFileError(
            str(path),
            expected=f"a thermal image of at most {LARGEST_FILE_BYTES} bytes",
            got=f"{size} bytes",
            remedy="Write one file per image; read videos frame by frame.",
        )
