"""COLMAP in a process of its own: what ends it from inside, such as a thread that cannot write, does not end ours."""

from __future__ import annotations

import base64
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from thermoxels_ns.capture.sfm.colmap_log import colmap_stopped
from thermoxels_ns.core.errors import ThermoxelsError

Say = Callable[[str], None]
_Result = TypeVar("_Result")

_MARK = b"\x1e"
"""Begins a line that is a message of ours; all other lines are COLMAP's."""
_LINES_KEPT = 400
"""Of COLMAP's last words: it adds a stack of calls to the sentence that matters."""
_KILLED = -int(getattr(signal, "SIGKILL", 9))
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1"}
"""COLMAP brings a BLAS of its own, whose sums depend on the number of its threads: one thread, same result."""


def run_apart(
    work: Callable[..., _Result], arguments: tuple[Any, ...], folder: Path, say: Say = lambda _: None
) -> _Result:
    """Call ``work(*arguments, say)`` in a new process and wait for its end.

    The process ends with this one, also where this one is killed.

    Args:
        work: A function at the top of a module.
        arguments: What pickle can hold.
        folder: Where it writes; looked at when it fails.
        say: Gets what the function tells its own `say`.

    Returns:
        What the function returned; pickle must be able to hold it.

    Raises:
        OutputError: It ended because the disk of `folder` is full.
        ThermoxelsError: It raised one, or ended without a word.
        OSError: It raised one.
    """
    start = f"import sys; sys.path[:] = {sys.path!r}; import {__name__} as there; there.serve()"
    child = subprocess.Popen(
        [sys.executable, "-c", start],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=os.environ | _ENVIRONMENT,
    )
    assert child.stdin is not None and child.stdout is not None
    words: deque[str] = deque(maxlen=_LINES_KEPT)
    ended: _Raised | _Returned | None = None
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
    if isinstance(ended, _Raised):
        raise ended.problem
    if status or ended is None:
        raise colmap_stopped(_reason(status, words), folder)
    return ended.result


@dataclass(frozen=True)
class _Raised:
    problem: Exception


@dataclass(frozen=True)
class _Returned:
    result: Any


def serve() -> None:
    """Do what `run_apart` of the process that started this one asks for."""
    work, arguments = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_the_other, daemon=True).start()
    try:
        _send(_Returned(work(*arguments, _send)))
    except (ThermoxelsError, OSError) as problem:
        _send(_Raised(problem))


def _end_with_the_other() -> None:
    os.read(sys.stdin.fileno(), 1)  # ends when the other process does
    os._exit(1)


def _send(message: str | _Raised | _Returned) -> None:
    sys.stdout.buffer.write(b"\n" + _MARK + base64.b64encode(pickle.dumps(message)) + b"\n")
    sys.stdout.buffer.flush()


def _reason(status: int, words: deque[str]) -> str:
    """Say why the process ended: the line that names an error, else its last one, else its status."""
    if status == _KILLED:
        return "it was killed, as systems do where memory runs out (lower --threads, --image-size or --max-features)"
    said = [line for line in words if line.strip()]
    telling = [line for line in said if "error" in line.lower()] or said[-1:]
    return f"exit status {status}" + (f" ({telling[0]})" if telling else "")
