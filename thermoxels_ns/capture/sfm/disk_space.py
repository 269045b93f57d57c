"""Free space on the disk that a capture writes to, and the error that names this disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from thermoxels_ns.core.errors import OutputError

_FULL_BYTES = 1_000_000
"""Free space up to which a disk is taken for the reason why a program ended: programs write whole pages."""


def check_free_space(folder: Path, needed_bytes: float, purpose: str, remedy: str) -> None:
    """Refuse to start what may not fit.

    Args:
        folder: Where it will be written; it exists.
        needed_bytes: How much that may be.
        purpose: What is written, for the message.
        remedy: What else helps besides space, for the message.

    Raises:
        OutputError: Less is free; the message names the disk.
    """
    free = shutil.disk_usage(folder).free
    if free < needed_bytes:
        raise _too_little(folder, f"up to {needed_bytes / 1e6:.0f} MB free for {purpose}", free, remedy)


def is_full(folder: Path) -> bool:
    """Whether the disk of a folder has no room for anything that counts."""
    return shutil.disk_usage(folder).free < _FULL_BYTES


def filled(folder: Path, purpose: str) -> OutputError:
    """Build the error for a disk that became full while something was written.

    Args:
        folder: Where it was written; it exists.
        purpose: What was written, for the message.
    """
    free = shutil.disk_usage(folder).free
    return _too_little(folder, f"free space for {purpose}, to the end", free, "Make space")


def disk_of(path: Path) -> Path:
    """Folder at which the disk (the file system) of a path is mounted."""
    disk = path.resolve()
    while not os.path.ismount(disk) and disk != disk.parent:
        disk = disk.parent
    return disk


def _too_little(folder: Path, expected: str, free: int, remedy: str) -> OutputError:
    return OutputError(
        f"disk at {disk_of(folder)}",
        expected=expected,
        got=f"{free / 1e6:.0f} MB",
        remedy=f"{remedy}; finished stages are kept. It was to be written to {folder}.",
    )
