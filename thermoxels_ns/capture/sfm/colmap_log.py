"""COLMAP's own log, hundreds of lines that mean nothing to a user and hide ours; and what to say when it stops."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from thermoxels_ns.capture.sfm.disk_space import filled, is_full
from thermoxels_ns.core.errors import ThermoxelsError

_FATAL_ONLY = 3


@contextmanager
def quiet_colmap(folder: Path) -> Iterator[None]:
    """Silence COLMAP in the block; what matters comes back as results or exceptions.

    Args:
        folder: Where it writes; looked at when it fails.

    Raises:
        OutputError: COLMAP stopped because the disk is full.
        ThermoxelsError: COLMAP stopped.
    """
    import pycolmap

    log: Any = pycolmap.logging
    before = log.minloglevel
    log.minloglevel = _FATAL_ONLY
    try:
        yield
    except (RuntimeError, ValueError) as problem:  # what COLMAP raises, such as for a database on a full disk
        lines = str(problem).strip().splitlines()
        raise colmap_stopped(lines[0] if lines else type(problem).__name__, folder) from problem
    finally:
        log.minloglevel = before


def colmap_stopped(reason: str, folder: Path) -> ThermoxelsError:
    """Build the error for a COLMAP that stopped; a full disk is named as the reason, whatever COLMAP says.

    Args:
        reason: What COLMAP said.
        folder: Where it was writing.
    """
    if is_full(folder) or "disk is full" in reason:
        return filled(folder, "features, matches and poses")
    return ThermoxelsError(
        "COLMAP",
        expected="to end",
        got=reason,
        remedy="Check free space and memory and run the command again; if that does not help, begin anew with "
        "--from-stage poses.",
    )
