"""COLMAP's own log: hundreds of lines that mean nothing to a user, which would hide ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from thermoxels_ns.errors import ThermoxelsError, explain

_FATAL_ONLY = 3


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Silence COLMAP in the block; what matters comes back as results or exceptions.

    Raises:
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
        raise ThermoxelsError(
            explain(
                "COLMAP",
                expected="to end",
                got=lines[0] if lines else type(problem).__name__,
                remedy="Check free space and memory and run the command again; if that does not help, begin anew with "
                "--from-stage poses.",
            )
        ) from problem
    finally:
        log.minloglevel = before
