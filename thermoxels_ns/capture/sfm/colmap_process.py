"""Runs COLMAP in a process of its own and says why it stopped."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from thermoxels_ns.core.errors import OutputError, ThermoxelsError

Say = Callable[[str], None]
_Result = TypeVar("_Result")

_WORDS_FILE = "colmap.log"  # COLMAP's own words, in the folder that it works in
_KILLED = -int(getattr(signal, "SIGKILL", 9))
_FATAL_ONLY = 3
_FULL_BYTES = 1_000_000
"""Free space up to which a disk is taken for the reason why a program ended: programs write whole pages."""


def run_in_process(
    work: Callable[..., _Result], arguments: tuple[Any, ...], folder: Path, say: Say = lambda _: None
) -> _Result:
    """Call ``work(*arguments, say)`` in a new process, wait for its end and return what it returned.

    What ends COLMAP from inside, such as a thread that cannot write, then does not end this process. The new one ends
    with this one, also where this one is killed. `work` is a function at the top of a module; pickle must be able to
    hold what goes in and out. A pool of `concurrent.futures` would not tell the status of a process that was killed.

    Raises:
        OutputError: It ended because the disk of `folder` is full.
        ThermoxelsError: It raised one, or ended without a word.
        OSError: It raised one.
    """
    context = multiprocessing.get_context("spawn")
    hears, tells = context.Pipe(duplex=False)
    child = context.Process(target=_serve, args=(work, arguments, folder / _WORDS_FILE, tells), daemon=True)
    child.start()
    tells.close()
    ended: tuple[Any, Exception | None] | None = None  # what it returned, and what it raised
    try:
        with suppress(EOFError):  # where the process has ended
            while True:
                message = hears.recv()
                if isinstance(message, str):
                    say(message)
                else:
                    ended = message
    except BaseException:
        child.kill()
        raise
    finally:
        child.join()
        hears.close()
    if ended is None:
        raise colmap_stopped(_reason(child.exitcode, folder / _WORDS_FILE), folder)
    result, problem = ended
    if problem is not None:
        raise problem
    return result


def _serve(work: Callable[..., Any], arguments: tuple[Any, ...], words: Path, tells: Connection) -> None:
    """Do what `run_in_process` of the process that started this one asks for."""
    # COLMAP brings a BLAS of its own, whose sums depend on the number of its threads: one thread, same result.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    with words.open("wb") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    try:
        tells.send((work(*arguments, tells.send), None))
    except (ThermoxelsError, OSError) as problem:
        tells.send((None, problem))


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _reason(status: int | None, words: Path) -> str:
    """Say why the process ended: the line that names an error, else its last one, else its status."""
    if status == _KILLED:
        return "it was killed, as systems do where memory runs out (lower --threads, --image-size or --max-features)"
    said: list[str] = []
    with suppress(OSError):
        said = [line for line in words.read_text("utf-8", "replace").splitlines() if line.strip()]
    telling = [line for line in said if "error" in line.lower()] or said[-1:]
    return f"exit status {status}" + (f" ({telling[0]})" if telling else "")


@contextmanager
def quiet_colmap(folder: Path) -> Iterator[None]:
    """Silence COLMAP in the block; where it stops, the error of `colmap_stopped` is raised."""
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
    """Build the error for a COLMAP that stopped; a full disk is named as the reason, whatever COLMAP says."""
    free = shutil.disk_usage(folder).free
    if free < _FULL_BYTES or "disk is full" in reason:
        return _too_little(folder, "free space for features, matches and poses, to the end", free, "Make space")
    remedy = "Check free space and memory and run the command again; if that does not help, begin anew with "
    return ThermoxelsError("COLMAP", expected="to end", got=reason, remedy=remedy + "--from-stage poses.")


def check_free_space(folder: Path, needed_bytes: float, purpose: str, remedy: str) -> None:
    """Refuse to start what may not fit into `folder`: an `OutputError` that names the disk and the purpose."""
    free = shutil.disk_usage(folder).free
    if free < needed_bytes:
        raise _too_little(folder, f"up to {needed_bytes / 1e6:.0f} MB free for {purpose}", free, remedy)


def _too_little(folder: Path, expected: str, free: int, remedy: str) -> OutputError:
    got, remedy = f"{free / 1e6:.0f} MB", f"{remedy}; finished stages are kept."
    return OutputError(f"disk of {folder}", expected=expected, got=got, remedy=remedy)
