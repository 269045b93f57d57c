"""Checks of arguments at public boundaries, and files and folders of results that are written whole or not at all."""

from __future__ import annotations

import errno
import io
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt
from filelock import FileLock, Timeout

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import OutputError, ThermoxelsError


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

    `values` maps names to (value, least, largest, range in words); messages put `prefix`, such as "--", before them.
    """
    for name, (value, low, high, expected) in values.items():
        if not (is_number(value) and low <= value <= high):  # NaN fails too
            remedy = f"Correct {prefix}{name.replace('_', '-')}."
            raise ThermoxelsError(name.rpartition(".")[2], expected=expected, got=value, remedy=remedy)


def check_finite(
    name: str, array: npt.NDArray, remedy: str, error: type[ThermoxelsError] = ThermoxelsError
) -> npt.NDArray:
    """Return `array` if every entry is finite, else raise `error` with the count of bad entries."""
    bad = int(np.size(array) - np.count_nonzero(np.isfinite(array)))
    if bad:
        raise error(name, expected="finite numbers only", got=f"{bad} of {array.size} NaN or infinite", remedy=remedy)
    return array


def check_shape(
    name: str,
    array: npt.NDArray,
    shape: Sequence[int | None],
    remedy: str,
    error: type[ThermoxelsError] = ThermoxelsError,
) -> npt.NDArray:
    """Return `array` if its shape matches `shape` (None matches any length), else raise `error`."""
    if len(array.shape) != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape)):
        wanted = "(" + ", ".join("n" if s is None else str(s) for s in shape) + ")"
        raise error(name, expected=f"shape {wanted}", got=tuple(array.shape), remedy=remedy)
    return array


def check_direction(
    name: str, vector: npt.ArrayLike, remedy: str, error: type[ThermoxelsError] = ThermoxelsError
) -> FloatArray:
    """Return `vector`, shape (3,), made 1 long; raise `error` if a number is not finite or all are 0."""
    array = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(array)) if array.shape == (3,) else 0.0
    if not (math.isfinite(length) and length > 0.0):
        raise error(name, expected="three finite numbers that are not all 0", got=array.tolist(), remedy=remedy)
    return array / length


def writable_folder(path: Path | str, room_bytes: float = 0.0) -> Path:
    """Make the folder `path` if needed and return it.

    Raises `OutputError` if no temporary file can be made in the folder, or if fewer than `room_bytes` are free there.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            free = shutil.disk_usage(folder).free
    except OSError as problem:
        expected = f"a folder that can be written to at {folder}"
        got = problem.strerror or str(problem)
        remedy = "Choose another folder or change its permissions."
        raise OutputError("output folder", expected=expected, got=got, remedy=remedy) from problem
    if free < room_bytes:
        expected, got = (
            f"{room_bytes / 1e6:.3g} MB of space for results in {folder}",
            f"{free / 1e6:.3g} MB of free space",
        )
        remedy = "Free space on that disk, or choose another folder."
        raise OutputError("output folder", expected=expected, got=got, remedy=remedy)
    return folder


@contextmanager
def plain_os_errors(
    what: Path | str,
    expected: str = "files that can be read and written",
    remedy: str = "Check free space, permissions and the length of names.",
    error: type[ThermoxelsError] = OutputError,
) -> Iterator[None]:
    """Turn an OSError of a with block into `error`, about the file that the system names, or else about `what`."""
    try:
        yield
    except ThermoxelsError:
        raise
    except OSError as problem:
        name, got = str(problem.filename or what)[:300], problem.strerror or str(problem)
        raise error(name, expected=expected, got=got, remedy=remedy) from problem


def remedy_of(problem: Exception, remedy: str) -> str:
    """Return `remedy` for an error of reading a file, or advice on permissions if the system refused."""
    refused = isinstance(problem, OSError) and problem.errno not in (None, errno.ENOENT)
    return "Check its permissions and the disk, or copy it again." if refused else remedy


def hold_folder(file: Path, remedy: str, say: Callable[[str], None]) -> FileLock:
    """Lock `file` in an output folder and return the lock; raise `OutputError` if another process has locked `file`.

    The system releases the lock when the process ends in any way. On a drive without locks, `say` receives a warning.
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

    The temporary name keeps the suffix, by which writers choose their format; what a killed process left under it is
    overwritten. Raises `OutputError` if the block or the renaming ends in an error of the operating system.
    """
    final = Path(path)
    temporary = final.with_name(f".{final.stem}.part{final.suffix}")
    try:
        yield temporary
        os.replace(temporary, final)
    except ThermoxelsError:
        raise
    except OSError as problem:
        raise _output_error(final, "a file that can be written", problem) from problem
    finally:
        # An error of the block says more than an error of removing the temporary file.
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by name to a compressed .npz file, whole or not at all; raises `OutputError` if that fails.

    They are packed in memory: an archive that numpy could not write to a full disk raises again when it is deleted.
    """
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    with replace_when_done(path) as temporary:
        temporary.write_bytes(packed.getvalue())  # no view: one in an error's traceback crashed Python 3.12


def remove_file(path: Path | str) -> None:
    """Remove a file if it exists, or raise `OutputError` if that fails."""
    try:
        Path(path).unlink(missing_ok=True)
    except OSError as problem:
        raise _output_error(Path(path), "a file that can be removed", problem) from problem


def refuse_what_is_in_the_way(folder: Path, files: Iterable[str], folders: Iterable[str] = ()) -> None:
    """Raise `OutputError` if a folder has the name of one of `files`, or a file the name of one of `folders`."""
    blocked = [name for name in files if (folder / name).is_dir()]
    blocked += [name for name in folders if (folder / name).exists() and not (folder / name).is_dir()]
    if blocked:
        expected = f"no folder in the place of a file, and no file in the place of a folder, in {folder}"
        remedy = "Move it away, or choose another folder."
        raise OutputError("output folder", expected=expected, got=", ".join(blocked), remedy=remedy)


def result_folder(path: Path | str, files: Sequence[str], first: str, series: str | None = None) -> Path:
    """Make and return the folder of a command's results.

    Raises `OutputError` if something is in the way of the results, or if the command would replace or remove files that
    it did not write.

    Args:
        files: Names of all files in the folder `path` that the command may write.
        first: Name of the file that a run writes first. Without it, the command wrote none of `files`.
        series: Pattern of files in a subfolder, as ``heat/step-*.vtu``; None if the command writes no such files.
    """
    folder, steps = writable_folder(path), [] if series is None else [series]
    refuse_what_is_in_the_way(folder, files, [Path(name).parent.name for name in steps])
    there = [next(folder.glob(name), None) for name in (*files, *steps)]
    found = [one.relative_to(folder).as_posix() for one in there if one is not None]
    if found and first not in found:
        expected = f"no files but those of an earlier run of this command in {folder}"
        remedy = "Choose another folder with --output-dir, or move them away."
        raise OutputError("output folder", expected=expected, got=", ".join(found), remedy=remedy)
    return folder


def _output_error(path: Path, expected: str, problem: OSError) -> OutputError:
    return OutputError(
        path.name,
        expected=f"{expected} at {path}",
        got=problem.strerror or str(problem),
        remedy="Move away what is there, check free space and permissions, or choose another folder.",
    )
