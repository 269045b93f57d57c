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
from pathlib import Path
from typing import Any

from thermoxels_ns.capture.colmap_log import colmap_stopped
from thermoxels_ns.errors import ThermoxelsError

Say = Callable[[str], None]

_MARK = b"\x1e"
"""Begins a line that is a message of ours; all other lines are COLMAP's."""
_LINES_KEPT = 400
"""Of COLMAP's last words: it adds a stack of calls to the sentence that matters."""
_KILLED = -int(getattr(signal, "SIGKILL", 9))


def run_apart(work: Callable[..., None], arguments: tuple[Any, ...], folder: Path, say: Say = lambda _: None) -> None:
    """Call ``work(*arguments, say)`` in a new process and wait for its end.

    The process ends with this one, also where this one is killed.

    Args:
        work: A function at the top of a module.
        arguments: What pickle can hold.
        folder: Where it writes; looked at when it fails.
        say: Gets what the function tells its own `say`.

    Raises:
        OutputError: It ended because the disk of `folder` is full.
        ThermoxelsError: It raised one, or ended without a word.
        OSError: It raised one.
    """
    start = f"import sys; sys.path[:] = {sys.path!r}; import {__name__} as there; there.serve()"
    child = subprocess.Popen(
        [sys.executable, "-c", start], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert child.stdin is not None and child.stdout is not None
    words: deque[str] = deque(maxlen=_LINES_KEPT)
    problem: Exception | None = None
    try:
        with suppress(BrokenPipeError):  # it ended before it could listen; its words and status follow
            child.stdin.write(pickle.dumps((work, arguments)))
            child.stdin.flush()
        for line in child.stdout:
            if not line.startswith(_MARK):
                words.append(line.decode("utf-8", "replace").rstrip())
                continue
            message = pickle.loads(base64.b64decode(line[len(_MARK) :]))
            if isinstance(message, Exception):
                problem = message
            else:
                say(message)
        status = child.wait()
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
        with suppress(OSError):
            child.stdin.close()
        child.stdout.close()
    if problem is not None:
        raise problem
    if status:
        raise colmap_stopped(_reason(status, words), folder)


def serve() -> None:
    """Do what `run_apart` of the process that started this one asks for."""
    work, arguments = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_the_other, daemon=True).start()
    try:
        work(*arguments, _send)
    except (ThermoxelsError, OSError) as problem:
        _send(problem)


def _end_with_the_other() -> None:
    os.read(sys.stdin.fileno(), 1)  # ends when the other process does
    os._exit(1)


def _send(message: str | Exception) -> None:
    sys.stdout.buffer.write(b"\n" + _MARK + base64.b64encode(pickle.dumps(message)) + b"\n")
    sys.stdout.buffer.flush()


def _reason(status: int, words: deque[str]) -> str:
    """Say why the process ended: the line that names an error, else its last one, else its status."""
    if status == _KILLED:
        return "it was killed, as systems do where memory runs out (lower --threads, --image-size or --max-features)"
    said = [line for line in words if line.strip()]
    telling = [line for line in said if "error" in line.lower()] or said[-1:]
    return f"exit status {status}" + (f" ({telling[0]})" if telling else "")
