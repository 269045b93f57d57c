"""COLMAP's own log: hundreds of lines that mean nothing to a user, which would hide ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_FATAL_ONLY = 3


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Silence COLMAP in the block; what matters comes back as results or exceptions."""
    import pycolmap

    log: Any = pycolmap.logging
    before = log.minloglevel
    log.minloglevel = _FATAL_ONLY
    try:
        yield
    finally:
        log.minloglevel = before
