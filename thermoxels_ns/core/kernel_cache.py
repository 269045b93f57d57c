"""The decorator that compiles kernels with numba, and the upkeep of numba's cache of compiled kernels."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from thermoxels_ns.core.checks import replace_when_done

_PACKAGE = Path(__file__).resolve().parents[1]
_DIGEST = "thermoxels-kernels.sha256"


def kernel(function: Callable | None = None, **options: Any) -> Any:
    """Decorate a function so that numba compiles it at its first call and caches the machine code on disk.

    A kernel runs without Python's global lock. It may use kernels and constants of its own room (subpackage) and of
    ``core``. Because numba watches only the kernel's own file, all compiled kernels of a room are removed when any file
    of the room or of ``core`` has changed. Plain use is ``@kernel``; `options` are those of `numba.njit`, such as
    ``fastmath={"contract"}``. Division by zero gives inf or NaN, as in numpy.
    """
    import numba

    def compiled(function: Callable) -> Any:
        njit: Any = numba.njit
        dispatcher = njit(**{"nogil": True, "cache": True, "error_model": "numpy", **options})(function)
        source, cached = Path(function.__code__.co_filename), dispatcher.stats.cache_path
        if cached and _PACKAGE in source.parents:
            # This comes before the first call, which loads kernels compiled earlier.
            _forget_once(source.relative_to(_PACKAGE).parts[0], Path(cached))
        return dispatcher

    return compiled if function is None else compiled(function)


@cache
def _forget_once(room: str, cached: Path) -> None:
    folders = (_PACKAGE / room, _PACKAGE / "core")
    forget_stale_kernels(cached, {path for folder in folders for path in folder.rglob("*.py")})


def forget_stale_kernels(cached: Path, sources: Iterable[Path]) -> bool:
    """Remove the compiled kernels in the folder `cached` if any of `sources` has changed since the last call. Return
    True if they were removed; False if no source has changed, or if the folder cannot be written."""
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sorted(sources))).hexdigest()
    mark = cached / _DIGEST
    with suppress(OSError):
        if mark.is_file() and mark.read_text() == digest:
            return False
        for kept in (*cached.glob("*.nbi"), *cached.glob("*.nbc")):
            kept.unlink(missing_ok=True)
        cached.mkdir(parents=True, exist_ok=True)
        with replace_when_done(mark) as unfinished:
            unfinished.write_text(digest)
        return True
    return False
