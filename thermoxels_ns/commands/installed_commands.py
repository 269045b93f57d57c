"""Run the console commands of this installation; show their output, and measure their time and memory."""

from __future__ import annotations

import codecs
import math
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from thermoxels_ns.core.errors import BAD_DATA, CRASH, LACK_OF_MEMORY, ThermoxelsError, explain

# Linux reports for a process at least the peak memory of the process that started it: import little here.
PLAIN_TRAINING = ("--timestamp", "run", "--vis", "tensorboard", "--logging.steps-per-log", "100")
"""Options of ns-train for a run that nobody watches in the viewer, in a folder whose name is known."""

_LAST_LINES = 12  # Lines of output that an error shows
_LOOK_AFTER_S = 0.05  # Time after which new output is shown, [s]


class ProcessCost(NamedTuple):
    """Time and memory that a finished process took."""

    seconds: float  # Wall time, [s]
    peak_memory_gb: float
    """Largest resident memory of the process, [1e9 bytes]; NaN if the system has no `wait4`. Linux reports no less than
    the memory of the process that started it."""


class CommandFailed(ThermoxelsError):
    """A command of this installation ended with an error."""

    def __init__(self, message: str, returncode: int, lines: Sequence[str]) -> None:
        super().__init__("\n".join([message, *(f"    {line}" for line in lines[-_LAST_LINES:])]))
        killed = returncode in (-9, 137)  # as Linux does where memory runs out
        self.exit_status = (
            LACK_OF_MEMORY if killed else returncode if returncode in (BAD_DATA, LACK_OF_MEMORY) else CRASH
        )
        ended = f"ended by signal {-returncode}" if returncode < 0 else f"exit status {returncode}"
        self.last_line = lines[-1].strip() if lines and returncode > 0 else ended
        """Last line of its output, which says why."""


def command_of(name: str, options: Any) -> str:
    """Return ``thermoxels NAME`` with options as typed in a shell; `options` is a dataclass such as `Heat`.

    The first field is taken as the positional argument. Options that have their default are left out.
    """
    words = ["thermoxels", name, str(getattr(options, fields(options)[0].name))]
    for field in fields(options)[1:]:
        value = getattr(options, field.name)
        if value != field.default:
            parts = np.ravel(value).tolist() if isinstance(value, tuple) else [value]
            words += [f"--{field.name.replace('_', '-')}", *map(str, parts)]
    return shlex.join(words)


def run_command(words: Sequence[str], log: Path, screen: TextIO | None = None) -> ProcessCost:
    """Run a command of this installation, write its output to the file `log`, and return its time and memory.

    The folder of `log` must exist. `screen` gets the output while the command runs. Raises `CommandFailed` if the
    command fails, `ThermoxelsError` if it does not exist.
    """
    folder = Path(sys.executable).parent
    program = shutil.which(words[0], path=str(folder))
    if program is None:
        remedy = "Install this package and nerfstudio into the environment of this Python."
        raise ThermoxelsError(words[0], expected=f"a command in {folder}", got="none", remedy=remedy)
    environment = dict(os.environ, PYTHONUNBUFFERED="1", PYTHONIOENCODING="utf-8")
    if screen is not None:
        screen.write(f"$ {shlex.join(words)}\n")
    start, peak_memory_gb = time.monotonic(), math.nan
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")  # output so far may end within a character
    with log.open("wb") as written, log.open("rb") as shown:
        process = subprocess.Popen(
            [program, *words[1:]], stdin=subprocess.DEVNULL, stdout=written, stderr=subprocess.STDOUT, env=environment
        )
        try:
            while process.returncode is None:
                time.sleep(_LOOK_AFTER_S)
                if hasattr(os, "wait4"):  # POSIX; elsewhere memory is not measured
                    ended, status, usage = os.wait4(process.pid, os.WNOHANG)
                    if ended:
                        process.returncode = os.waitstatus_to_exitcode(status)
                        peak_memory_gb = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9
                else:
                    process.poll()
                if screen is not None:
                    screen.write(decoder.decode(shown.read()))
                    screen.flush()
        finally:
            if process.returncode is None:
                process.terminate()
                process.wait()
    if process.returncode:
        remedy = f"Its whole output is in {log}; its last lines:"
        message = explain(words[0], expected="exit status 0", got=process.returncode, remedy=remedy)
        lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        raise CommandFailed(message, process.returncode, lines)
    return ProcessCost(time.monotonic() - start, peak_memory_gb)
