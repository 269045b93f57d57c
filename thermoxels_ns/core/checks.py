"""Checks of arguments at public boundaries, and files and folders of results that are written whole or not at all."""

from __future__ import annotations

import math
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt
from filelock import FileLock, Timeout

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import OutputError, ThermoxelsError

_IN_THE_WAY = "Move away what is there, check free space and permissions, or choose another folder."


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a number that a float can hold. NaN counts as a number, True does not.

    >>> [is_number(value) for value in (1, 2.5, True, "3", 10**400)]
    [True, True, False, False, False]
    """
    number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    return number and not (isinstance(value, int) and abs(value) > sys.float_info.max)


def check_positive(name: str, value: float, remedy: str, error: type[ThermoxelsError] = ThermoxelsError) -> float:
    """Return `value` as a float if it is a finite number above 0, else raise `error` with `name` and `remedy`."""
    if not (is_number(value) and math.isfinite(value) and value > 0):
        raise error(name, expected="a finite number above 0", got=repr(value), remedy=remedy)
    return float(value)


def check_ranges(prefix: str, values: Mapping[str, tuple[Any, float, float, str]]) -> None:
    """Raise `ThermoxelsError` if the value of an option is out of range or NaN.

    `values` maps the name of an option to (value, least and largest value allowed, range in words). The message tells
    the user to correct the option, whose name it writes behind `prefix`, such as "--".
    """
    for name, (value, low, high, expected) in values.items():
        if not (is_number(value) and low <= value <= high):  # NaN fails too
            remedy = f"Correct {prefix}{name.replace('_', '-')}."
            raise ThermoxelsError(name.rpartition(".")[2], expected=expected, got=value, remedy=remedy)


def check_array(
    name: str,
    array: npt.NDArray,
    shape: Sequence[int | None] | None,
    remedy: str,
    error: type[ThermoxelsError] = ThermoxelsError,
) -> npt.NDArray:
    """Return `array` if every entry is finite and its shape matches `shape`, else raise `error`. A length None in
    `shape` matches any length. If `shape` is None, the array may have any shape."""
    if shape is not None and (
        len(array.shape) != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape))
    ):
        wanted = "(" + ", ".join("n" if s is None else str(s) for s in shape) + ")"
        raise error(name, expected=f"shape {wanted}", got=tuple(array.shape), remedy=remedy)
    bad = int(np.size(array) - np.count_nonzero(np.isfinite(array)))
    if bad:
        raise error(name, expected="finite numbers only", got=f"{bad} of {array.size} NaN or infinite", remedy=remedy)
    return array


def check_direction(
    name: str, vector: npt.ArrayLike, remedy: str, error: type[ThermoxelsError] = ThermoxelsError
) -> FloatArray:
    """Return `vector` scaled to length 1; raise `error` unless it has three finite numbers that are not all 0."""
    array = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(array)) if array.shape == (3,) else 0.0
    if not (math.isfinite(length) and length > 0.0):
        raise error(name, expected="three finite numbers that are not all 0", got=array.tolist(), remedy=remedy)
    return array / length


@contextmanager
def plain_os_errors(
    what: Path | str,
    expected: str = "files that can be read and written",
    remedy: str = "Check free space, permissions and the length of names.",
    error: type[ThermoxelsError] = OutputError,
    always_what: bool = False,
) -> Iterator[None]:
    """Replace an OSError that a with block raises by `error`; a `ThermoxelsError` passes unchanged.

    The message is about the file that the system names, or about `what` if the system names none. If `always_what` is
    True, the message is always about `what`: the system may name a temporary file, of which the user knows nothing.
    """
    try:
        yield
    except ThermoxelsError:
        raise
    except OSError as problem:
        name = str(what if always_what else problem.filename or what)[:300]
        got = problem.strerror or str(problem)
        raise error(name, expected=expected, got=got, remedy=remedy) from problem


def writable_folder(path: Path | str, room_bytes: float = 0.0) -> Path:
    """Make the folder `path` if needed and return it. Raises `OutputError` if no temporary file can be made in the
    folder, or if fewer than `room_bytes` are free there."""
    folder, remedy = Path(path), "Choose another folder or change its permissions."
    expected = f"a folder that can be written to at {folder}"
    with plain_os_errors("output folder", expected, remedy, always_what=True):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            free = shutil.disk_usage(folder).free
    if free < room_bytes:
        expected, got = (
            f"{room_bytes / 1e6:.3g} MB of space for results in {folder}",
            f"{free / 1e6:.3g} MB of free space",
        )
        remedy = "Free space on that disk, or choose another folder."
        raise OutputError("output folder", expected=expected, got=got, remedy=remedy)
    return folder


def hold_folder(file: Path, remedy: str, say: Callable[[str], None]) -> FileLock:
    """Lock `file` in an output folder and return the lock; raise `OutputError` if another process has locked `file`.

    The error advises `remedy`. The system releases the lock when the process ends in any way. On a drive without locks
    nothing is locked, and `say` receives a warning.
    """
    lock = FileLock(file)
    try:
        lock.acquire(blocking=False)
        with suppress(OSError):  # the number serves only the message below, in another process
            file.write_text(str(os.getpid()))
    except Timeout as problem:
        number = ""
        with suppress(OSError):
            number = file.read_text(encoding="utf-8")
        got = f"{file.parent}, where process {number or 'of unknown number'} is at work"
        expected = "a folder that no other command is working in"
        raise OutputError("output folder", expected=expected, got=got, remedy=remedy) from problem
    except OSError as problem:
        say(f"The drive of {file.parent} ({problem.strerror}) does not tell whether another command works there.")
    return lock


@contextmanager
def replace_when_done(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename the file there to `path` only if the block ends without an error.

    The temporary path has the suffix of `path`, because writers choose their format by it. A file that a killed process
    left at the temporary path is overwritten. Raises `OutputError` if the block or the renaming raises an OSError.
    """
    final = Path(path)
    temporary = final.with_name(f".{final.stem}.part{final.suffix}")
    try:
        with plain_os_errors(final.name, f"a file that can be written at {final}", _IN_THE_WAY, always_what=True):
            yield temporary
            os.replace(temporary, final)
    finally:
        # An error of the block says more than an error of removing the temporary file.
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_file(path: Path | str) -> None:
    """Remove a file if it exists, or raise `OutputError` if that fails."""
    file = Path(path)
    with plain_os_errors(file.name, f"a file that can be removed at {file}", _IN_THE_WAY, always_what=True):
        file.unlink(missing_ok=True)


def result_folder(path: Path | str, files: Sequence[str], first: str) -> Path:
    """Make the folder of a command's results, if needed, and return it.

    Raises `OutputError` if a folder is in the place of a file or the reverse, or if results exist without `first`.

    Args:
        files: Names, or patterns such as ``heat/step-*.vtu``, of all files in `path` that the command may write.
        first: Name of the file that a run writes first. If it is missing, the other files are not the command's.
    """
    folder = writable_folder(path)
    blocked = [name for name in files if (folder / name).is_dir()]
    blocked += [name for one in files if (folder / (name := Path(one).parent.name)).is_file()]
    if blocked:
        expected = f"no folder in the place of a file, and no file in the place of a folder, in {folder}"
        remedy = "Move it away, or choose another folder."
        raise OutputError("output folder", expected=expected, got=", ".join(blocked), remedy=remedy)
    there = [next(folder.glob(name), None) for name in files]
    found = [one.relative_to(folder).as_posix() for one in there if one is not None]
    if found and first not in found:
        expected = f"no files but those of an earlier run of this command in {folder}"
        remedy = "Choose another folder with --output-dir, or move them away."
        raise OutputError("output folder", expected=expected, got=", ".join(found), remedy=remedy)
    return folder
