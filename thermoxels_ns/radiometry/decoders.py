"""Guards picture decoders: sizes are limited, and every error names the file."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from thermoxels_ns.core.errors import SceneError, ThermalFileError, ThermoxelsError

LARGEST_SIDE = 8192
"""Pixels along a side: four times the largest thermal sensors and super-resolution modes (about 2048)."""
LARGEST_FILE_BYTES = 2**29  # a table of 4096 x 4096 numbers of 30 characters; camera files are far smaller


@contextmanager
def errors_name(
    path: Path | str,
    expected: str,
    remedy: str = "The file is damaged; copy it from the camera again.",
    error: type[ThermoxelsError] = SceneError,
) -> Iterator[None]:
    """Turn every error of the block into one of type `error` that names the file; our own errors pass as they are.

    `expected` is what the file should be, `remedy` what to do if it is damaged.
    """
    try:
        with warnings.catch_warnings():  # Pillow's name no file; what is wrong with one is an error that does
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
        # The operating system's errors have a number, those of decoders have none.
        strerror = problem.strerror if isinstance(problem, OSError) else None
        if isinstance(problem, OSError) and problem.errno is not None:
            expected, remedy = "a file that can be read", "Check its permissions and the disk, or copy it again."
        got = strerror or str(problem) or type(problem).__name__
        raise error(str(path), expected=expected, got=got, remedy=remedy) from problem


def check_thermal_size(path: Path | str, width: int, height: int) -> None:
    """Raise a `ThermalFileError` if a thermal file says that it is larger than cameras make them, or has no pixels."""
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        expected = f"a thermal image of 1 to {LARGEST_SIDE} pixels a side"
        got = f"a header that says {width} x {height}"
        remedy = "The header is damaged or this is no camera file; copy it again, or cut a mosaic into parts."
        raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)


def check_file_size(path: Path) -> None:
    """Raise a `ThermalFileError` if a thermal file is empty or larger than any camera writes."""
    size = path.stat().st_size
    if size == 0:
        remedy = "Copy it from the camera again, or remove it."
        raise ThermalFileError(str(path), expected="a camera file", got="a file of zero bytes", remedy=remedy)
    if size > LARGEST_FILE_BYTES:
        expected = f"a thermal image of at most {LARGEST_FILE_BYTES} bytes"
        remedy = "Write one file per image; read videos frame by frame."
        raise ThermalFileError(str(path), expected=expected, got=f"{size} bytes", remedy=remedy)
