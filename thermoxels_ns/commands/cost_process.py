"""Run a command of this installation and measure its time and memory.

The peak that Linux reports for a process is at least that of the process which started it (the copy that becomes the
command counts), so what imports this stays small: no torch, no nerfstudio.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from thermoxels_ns.commands.demo_commands import installed_command
from thermoxels_ns.core.errors import ThermoxelsError, explain

_POLL_S = 0.05
_TAIL_BYTES = 4096
_LAST_LINES = 12
_DONE = re.compile(rb"^\d+ \((\d+(?:\.\d+)?)%\)", re.MULTILINE)

Watch = Callable[[float | None], None]
"""Called while a command runs with the share that is done, None if it does not say."""


@dataclass(frozen=True)
class ProcessCost:
    """What a finished process took."""

    seconds: float
    """Wall time, [s]."""
    peak_memory_gb: float
    """Largest resident memory of the process, [1e9 bytes]; NaN where it cannot be told: the system has no `wait4`, or
    the command stayed smaller than the process that started it."""


def run_measured(words: Sequence[str], log: Path, watch: Watch = lambda _: None) -> ProcessCost:
    """Run a command of this installation and measure it.

    Args:
        words: The command's name, found beside the running Python, and its arguments.
        log: File for its output.
        watch: Called now and then while it runs.

    Raises:
        ThermoxelsError: There is no such command, or it failed; the message holds its last lines.
    """
    program = installed_command(words[0])
    environment = dict(os.environ, PYTHONUNBUFFERED="1", PYTHONIOENCODING="utf-8")
    with log.open("wb") as file:
        start = time.monotonic()
        process = subprocess.Popen(
            [program, *words[1:]], stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, env=environment
        )
        try:
            peak_memory_gb = _wait(process, log, watch)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        seconds = time.monotonic() - start
    if process.returncode != 0:
        remedy = f"Its whole output is in {log}; its last lines:"
        message = explain(words[0], expected="exit status 0", got=process.returncode, remedy=remedy)
        raise ThermoxelsError(f"{message}\n{_last_lines(log)}")
    return ProcessCost(seconds, peak_memory_gb)


def _wait(process: subprocess.Popen[bytes], log: Path, watch: Watch) -> float:
    """Wait for a process, telling the watcher how far it is; return its peak memory [1e9 bytes]."""
    peak = math.nan
    wait4 = getattr(os, "wait4", None)  # POSIX; elsewhere memory is not measured
    looked = time.monotonic()
    while True:
        if wait4 is None:
            if process.poll() is not None:
                return peak
        else:
            pid, status, usage = wait4(process.pid, os.WNOHANG)
            if pid == process.pid:
                process.returncode = os.waitstatus_to_exitcode(status)
                if usage.ru_maxrss <= _own_peak_kib():
                    return math.nan
                return usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9
        if time.monotonic() - looked > 10 * _POLL_S:
            looked = time.monotonic()
            watch(_share_done(log))
        time.sleep(_POLL_S)


def _own_peak_kib() -> int:
    """Largest resident memory of this process on Linux, [KiB], the least that it reports for others; else 0."""
    status = Path("/proc/self/status")
    found = re.search(r"^VmHWM:\s*(\d+) kB", status.read_text(), re.MULTILINE) if status.is_file() else None
    return int(found[1]) if found else 0


def _share_done(log: Path) -> float | None:
    """How much of the training is done according to the last line of steps in its log, 0 to 1."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _TAIL_BYTES))
        found = _DONE.findall(file.read())
    return min(1.0, float(found[-1]) / 100.0) if found else None


def _last_lines(log: Path) -> str:
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return "\n".join(f"    {line}" for line in lines[-_LAST_LINES:])
