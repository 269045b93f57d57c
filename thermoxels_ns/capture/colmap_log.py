"""COLMAP's own log: hundreds of lines that mean nothing to a user, of which only errors are shown."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_ERRORS_ONLY = 2


@contextmanager
def only_errors() -> Iterator[None]:
    """Show only COLMAP's errors in the block."""
    import pycolmap

    log: Any = pycolmap.logging
    before = log.minloglevel
    log.minloglevel = _ERRORS_ONLY
    try:
        yield
    finally:
        log.minloglevel = before
