"""One capture at a time in one output folder: two would write each other's stages."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from thermoxels_ns.capture.stages import CACHE_FOLDER
from thermoxels_ns.core.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK_FILE = "lock"
_TAKEN = {errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES}
_MOST_DIGITS = 20


@contextmanager
def only_capture(output: Path, say: Callable[[str], None] = lambda _: None) -> Iterator[None]:
    """Hold the output folder of a capture for the block.

    The lock is the system's, on a file (BSD flock): it ends with the process that holds it, however that ends. The file
    stays and means nothing. Where the system or the drive has no such locks the block runs all the same, and `say` is
    told so.

    Args:
        output: The output folder, made by `prepare_output`.
        say: Told where another capture would not be noticed.

    Raises:
        OutputError: Another capture holds the folder.
        OSError: The file cannot be opened.
    """
    file = os.open(output / CACHE_FOLDER / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if not _lock(file, say):
            number = os.read(file, _MOST_DIGITS).decode("ascii", "replace")
            raise OutputError(
                "output",
                expected="a folder that no other capture is working in",
                got=f"{output}, where process {number} is at work" if number.isdigit() else f"{output}, where one is",
                remedy="Wait until it ends, or pass another folder with --output.",
            )
        with suppress(OSError):  # the number is for that message alone; what needs a full disk will name it
            os.ftruncate(file, 0)
            os.write(file, str(os.getpid()).encode("ascii"))
        yield
    finally:
        os.close(file)


def _lock(file: int, say: Callable[[str], None]) -> bool:
    """Lock an open file if the system can; False: another process has."""
    unknown = None
    if fcntl is None:
        unknown = "this system"
    else:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as problem:
            if problem.errno in _TAKEN:
                return False
            unknown = f"the drive of the output folder ({problem.strerror})"
    if unknown is not None:
        say(f"output: {unknown} does not tell whether another capture works in the folder; start one at a time")
    return True
