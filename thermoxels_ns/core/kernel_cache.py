"""Throw away compiled kernels of earlier versions: numba watches one source file each, but kernels inline others."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from thermoxels_ns.core.checks import replace_when_done

_DIGEST = "thermoxels-kernels.sha256"


def forget_stale_kernels(cache: Path, sources: Iterable[Path]) -> bool:
    """Remove what numba keeps of `sources` if any of them differs from when it was kept.

    Args:
        cache: Folder in which numba keeps compiled functions.
        sources: Python files with compiled functions; they may call each other's.

    Returns:
        Whether anything was out of date. A folder that cannot be written is left alone.
    """
    sources = sorted(sources)
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    mark = cache / _DIGEST
    try:
        if mark.is_file() and mark.read_text() == digest:
            return False
        for source in sources:
            for kept in (*cache.glob(f"{source.stem}.*.nbi"), *cache.glob(f"{source.stem}.*.nbc")):
                kept.unlink(missing_ok=True)
        cache.mkdir(parents=True, exist_ok=True)
        with replace_when_done(mark) as unfinished:
            unfinished.write_text(digest)
    except OSError:
        return False
    return True
