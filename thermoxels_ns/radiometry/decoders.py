"""Picture decoders on files that are damaged or made to do harm: whatever they raise names the file."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from thermoxels_ns.core.errors import SceneError, ThermoxelsError


@contextmanager
def quiet_decoders() -> Iterator[None]:
    """Drop Pillow's warnings in the block: of damaged tags that nothing is read from, and of large pictures.

    What is wrong with a file is an error that names it; a warning would be a line that names none.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"PIL\.")
        yield


@contextmanager
def naming(
    path: Path | str,
    expected: str,
    remedy: str = "The file is damaged; copy it from the camera again.",
    error: type[ThermoxelsError] = SceneError,
) -> Iterator[None]:
    """Turn every error of the block into one that names the file; our own errors pass as they are.

    Args:
        path: The file that the block reads.
        expected: What it should be, for the message.
        remedy: What to do if it is damaged.
        error: Type to raise.

    Raises:
        ThermoxelsError: Of the type `error`, in place of whatever the block raised.
    """
    try:
        with quiet_decoders():
            yield
    except ThermoxelsError:
        raise
    except Image.DecompressionBombError as problem:
        limit = 2 * (Image.MAX_IMAGE_PIXELS or 0)
        raise error(
            str(path),
            expected=f"a picture of at most {limit} pixels",
            got=f"a header that says more ({problem})",
            remedy="Reduce the picture; or copy the file again, if it is not so large: its header is damaged.",
        ) from problem
    except Exception as problem:  # decoders raise OSError, SyntaxError, KeyError, TypeError, struct.error and others
        # The operating system's errors have a number, those of decoders have none.
        refused = isinstance(problem, OSError) and problem.errno is not None
        raise error(
            str(path),
            expected="a file that can be read" if refused else expected,
            got=(problem.strerror if isinstance(problem, OSError) else None) or str(problem) or _kind(problem),
            remedy="Check its permissions and the disk, or copy it again." if refused else remedy,
        ) from problem


def _kind(problem: Exception) -> str:
    return type(problem).__name__
