"""Run the console commands of this installation as a user would type them, and show what they say."""

from __future__ import annotations

import codecs
import os
import queue
import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console

from thermoxels_ns.core.errors import ThermoxelsError, explain

_LAST_LINES = 12
_QUIET_S = 20.0
_CHUNK = 1 << 16
# What nerfstudio 1.1 and torch tell their programmers, not their users.
_SILENCED = ",".join(
    (
        "ignore::FutureWarning",
        "ignore::DeprecationWarning",
        "ignore:Using a non-tuple sequence:UserWarning",
        "ignore:Converting a tensor with requires_grad:UserWarning",
    )
)


def command_line(arguments: Sequence[str | Path]) -> str:
    """Write a command as it is typed in a shell.

    >>> command_line(["ns-train", "thermoxels", "--data", "my scene"])
    "ns-train thermoxels --data 'my scene'"
    """
    return shlex.join(str(argument) for argument in arguments)


def installed_command(name: str) -> str:
    """Path of a command of this installation, found beside the running Python.

    Raises:
        ThermoxelsError: There is no such command.
    """
    folder = Path(sys.executable).parent
    program = shutil.which(name, path=str(folder))
    if program is None:
        raise ThermoxelsError(
            name,
            expected=f"a command in {folder}",
            got="none",
            remedy="Install this package and nerfstudio into the environment of this Python.",
        )
    return program


def run_command(arguments: Sequence[str | Path], log: Path, console: Console) -> None:
    """Run one command of this installation; its output is shown as it comes and kept in a file.

    On a terminal the output passes through as it is, progress bars included. Elsewhere a line says now and then that
    a quiet command still runs.

    Args:
        arguments: The command's name, found beside the running Python, and its arguments.
        log: File for the output; its folder exists.
        console: Where to show it.

    Raises:
        ThermoxelsError: There is no such command, or it failed; the message holds its last lines.
    """
    words = [str(argument) for argument in arguments]
    program = installed_command(words[0])
    console.print(f"$ {command_line(words)}", style="bold", markup=False, highlight=False, soft_wrap=True)
    start = time.monotonic()
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")  # a chunk may end within a character
    with log.open("wb") as file:
        process = subprocess.Popen(
            [program, *words[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=_environment(console),
        )
        try:
            for chunk in _chunks(process, console, words[0], start):
                file.write(chunk)
                console.file.write(decoder.decode(chunk))
                console.file.flush()
            status = process.wait()
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    if status != 0:
        remedy = f"Its whole output is in {log}; its last lines:"
        message = explain(words[0], expected="exit status 0", got=status, remedy=remedy)
        raise ThermoxelsError(f"{message}\n{_last_lines(log)}")


def _environment(console: Console) -> dict[str, str]:
    """The environment of a command: output at once, without warnings that concern programmers, colours if wanted."""
    environment = dict(os.environ, PYTHONUNBUFFERED="1", PYTHONIOENCODING="utf-8")
    environment.setdefault("PYTHONWARNINGS", _SILENCED)
    if console.is_terminal:
        environment |= {"FORCE_COLOR": "1", "COLUMNS": str(console.width)}
    return environment


def _chunks(process: subprocess.Popen[bytes], console: Console, name: str, start: float) -> Iterator[bytes]:
    """Yield output as it comes; a thread reads, so that silence can be noticed on every system."""
    arrived: queue.Queue[bytes] = queue.Queue()
    assert process.stdout is not None
    descriptor = process.stdout.fileno()

    def read() -> None:
        while chunk := os.read(descriptor, _CHUNK):
            arrived.put(chunk)
        arrived.put(b"")

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    while True:
        try:
            chunk = arrived.get(timeout=_QUIET_S)
        except queue.Empty:
            if not console.is_terminal:
                console.print(f"... {name} is at work, {time.monotonic() - start:.0f} s", highlight=False)
            continue
        if not chunk:
            break
        yield chunk
    reader.join()


def _last_lines(log: Path) -> str:
    """The end of a log, without the empty lines."""
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return "\n".join(f"    {line}" for line in lines[-_LAST_LINES:])
