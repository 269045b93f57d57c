"""Temperatures as plain tables of numbers: ``.npy`` arrays and ``.csv`` text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.image_size import check_thermal_size
from thermoxels_ns.radiometry.thermal_files import ThermalImage, ThermalUnit, read_thermal_file

NPY_START = b"\x93NUMPY"
_LONGEST_LINE = 2**20
"""More characters in a line are no row of a thermal image: 8192 numbers of 30 characters are a quarter of it."""
_NUMBERS = re.compile(rb"(?:\xef\xbb\xbf)?[-+0-9.,;eE\s\"]|nan|na|n/a|null|none", re.IGNORECASE)
_TEXT = re.compile(rb"[\t\n\r -~\xef\xbb\xbf]*")


def looks_like_csv(head: bytes) -> bool:
    """Whether the first bytes of a file are text that starts as a table of numbers does.

    >>> looks_like_csv(b"21.5;21.6;21.4"), looks_like_csv(b"GIF89a"), looks_like_csv(b"")
    (True, False, False)
    """
    return bool(_TEXT.fullmatch(head) and _NUMBERS.match(head) and re.search(rb"[0-9]", head))


def read_csv(path: Path, valid_range_c: tuple[float, float]) -> ThermalImage:
    """Read rows of degrees C, split by commas or semicolons.

    Raises:
        ThermalFileError: The table is larger than a thermal image, its rows differ in length, or a cell is no number.
    """
    width = height = 0
    with path.open(encoding="latin-1") as stream:  # counts alone: the reader below knows the file's own encoding
        while line := stream.readline(_LONGEST_LINE):
            width, height = max(width, 1 + max(line.count(","), line.count(";"))), height + 1
            if len(line) == _LONGEST_LINE:
                raise ThermalFileError(
                    str(path),
                    expected=f"a table with lines below {_LONGEST_LINE} characters",
                    got=f"a longer one, line {height}",
                    remedy="The file is damaged or no table; write one row of the image per line.",
                )
            check_thermal_size(path, width, height)
    return read_thermal_file(path, ThermalUnit.celsius(), valid_range_c, suffix=".csv")


def read_npy(path: Path, unit: ThermalUnit | None, valid_range_c: tuple[float, float]) -> ThermalImage:
    """Read an array: degrees C where it holds fractions, else counts.

    Args:
        path: The file.
        unit: Meaning of whole numbers; None: the user did not say.
        valid_range_c: Temperatures outside are masked, [degrees C].

    Raises:
        ThermalFileError: Whole numbers without a unit, or an array that is no image.
    """
    try:
        kind = np.load(path, mmap_mode="r", allow_pickle=False).dtype.kind
    except Exception:  # the reader below says what is wrong with it
        kind = "f"
    if kind in "ui" and unit is None:
        raise ThermalFileError(
            str(path),
            expected="an array of degrees C (float32 or float64), or whole numbers with a known unit",
            got="whole numbers and no unit",
            remedy="Pass --camera, or --celsius-per-count and --celsius-offset.",
        )
    return read_thermal_file(path, unit or ThermalUnit.celsius(), valid_range_c, suffix=".npy")
