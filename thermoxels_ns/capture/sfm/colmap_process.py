"""Runs COLMAP in a process of its own and says why it stopped."""

from __future__ import annotations

import base64
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from thermoxels_ns.core.errors import OutputError, ThermoxelsError

Say = Callable[[str], None]
_Result = TypeVar("_Result")

_MARK = b"\x1e"  # begins a line that is a message of ours; all other lines are COLMAP's
_LINES_KEPT = 400  # of COLMAP's last words: it adds a stack of calls to the sentence that matters
_KILLED = -int(getattr(signal, "SIGKILL", 9))
_FATAL_ONLY = 3
_FULL_BYTES = 1_000_000
"""Free space up to which a disk is taken for the reason why a program ended: programs write whole pages."""
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1"}
"""COLMAP brings a BLAS of its own, whose sums depend on the number of its threads: one thread, same result."""


def run_in_process(
    work: Callable[..., _Result], arguments: tuple[Any, ...], folder: Path, say: Say = lambda _: None
) -> _Result:
    """Call ``work(*arguments, say)`` in a new process, wait for its end and return what it returned.

    What ends COLMAP from inside, such as a thread that cannot write, then does not end this process. The new one ends
    with this one, also where this one is killed. `work` is a function at the top of a module; pickle must be able to
    hold what goes in and out.

    Raises:
        OutputError: It ended because the disk of `folder` is full.
        ThermoxelsError: It raised one, or ended without a word.
        OSError: It raised one.
    """
    start = f"import sys; sys.path[:] = {sys.path!r}; import {__name__} as there; there.serve()"
    command, pipe, environment = [sys.executable, "-c", start], subprocess.PIPE, os.environ | _ENVIRONMENT
    child = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, env=environment)
    assert child.stdin is not None and child.stdout is not None
    words: deque[str] = deque(maxlen=_LINES_KEPT)
    ended: tuple[Any, Exception | None] | None = None  # what it returned, and what it raised
    try:
        with suppress(BrokenPipeError):  # it ended before it could listen; its words and status follow
            child.stdin.write(pickle.dumps((work, arguments)))
            child.stdin.flush()
        for line in child.stdout:
            if not line.startswith(_MARK):
                words.append(line.decode("utf-8", "replace").rstrip())
            elif line.endswith(b"\n"):  # it may end in the middle of one
                message = pickle.loads(base64.b64decode(line[len(_MARK) :]))
                if isinstance(message, str):
                    say(message)
                else:
                    ended = message
        status = child.wait()
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
        with suppress(OSError):
            child.stdin.close()
        child.stdout.close()
    if ended is not None and ended[1] is not None:
        raise ended[1]
    if status or ended is None:
        raise colmap_stopped(_reason(status, words), folder)
    return ended[0]


def serve() -> None:
    """Do what `run_in_process` of the process that started this one asks for."""
    work, arguments = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    try:
        _send((work(*arguments, _send), None))
    except (ThermoxelsError, OSError) as problem:
        _send((None, problem))


def _exit_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # ends when the other process does
    os._exit(1)


def _send(message: str | tuple[Any, Exception | None]) -> None:
    sys.stdout.buffer.write(b"\n" + _MARK + base64.b64encode(pickle.dumps(message)) + b"\n")
    sys.stdout.buffer.flush()


def _reason(status: int, words: deque[str]) -> str:
    """Say why the process ended: the line that names an error, else its last one, else its status."""
    if status == _KILLED:
        return "it was killed, as systems do where memory runs out (lower --threads, --image-size or --max-features)"
    said = [line for line in words if line.strip()]
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


def disk_of(path: Path) -> Path:
    """Folder at which the disk (the file system) of a path is mounted."""
    disk = path.resolve()
    while not os.path.ismount(disk) and disk != disk.parent:
        disk = disk.parent
    return disk


def _too_little(folder: Path, expected: str, free: int, remedy: str) -> OutputError:
    remedy += f"; finished stages are kept. It was to be written to {folder}."
    return OutputError(f"disk at {disk_of(folder)}", expected=expected, got=f"{free / 1e6:.0f} MB", remedy=remedy)
