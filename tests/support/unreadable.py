"""What a folder holds, files that may not be read, also for root, and a disk that is full."""

import builtins
import errno
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


def contents(folder: Path) -> dict[str, bytes]:
    """Content of all files of a folder by their paths in it."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def forbid(monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    """Let no file whose path ends so be opened from Python."""
    true_open = io.open

    def refusing(file, *arguments, **options):
        if isinstance(file, (str, os.PathLike)) and os.fspath(file).endswith(ending):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(file))
        return true_open(file, *arguments, **options)

    monkeypatch.setattr(builtins, "open", refusing)
    monkeypatch.setattr(io, "open", refusing)
    monkeypatch.setattr(Path, "open", lambda path, *arguments, **options: refusing(path, *arguments, **options))


@contextmanager
def files_end_after(size_bytes: int) -> Iterator[None]:
    """A disk that takes so much of each file, whoever writes it."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
