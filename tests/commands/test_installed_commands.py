"""Running a command and measuring it."""

from __future__ import annotations

import math
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from thermoxels_ns.commands.installed_commands import run_command
from thermoxels_ns.core.errors import ThermoxelsError

PYTHON = sys.executable


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Gives a function that writes a command beside a Python of its own and returns the words to run it."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setattr("thermoxels_ns.commands.installed_commands.sys.executable", str(folder / "python"))

    def write(body: str) -> list[str]:
        path = folder / "work"
        path.write_text(f"#!{PYTHON} -S\nimport os, sys, time\n{body}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return ["work"]

    return write


def test_time_is_that_of_the_whole_command(command, tmp_path):
    assert run_command(command("time.sleep(0.5)"), tmp_path / "log").seconds >= 0.5


def test_memory_is_that_of_the_command(command, tmp_path):
    """400 MB more are seen, also when they are free again before the end.

    Measured from a process of its own: this one may be large, and what it starts would be told to be as large.
    """
    command("x = b'1' * int(sys.argv[1]); del x")
    script = (
        "import math, pathlib, sys\n"
        "from thermoxels_ns.commands.installed_commands import run_command\n"
        f"sys.executable = {str(tmp_path / 'bin' / 'python')!r}\n"
        f"log = pathlib.Path({str(tmp_path / 'log')!r})\n"
        "peak = lambda size: run_command(['work', str(size)], log).peak_memory_gb\n"
        "print(peak(200_000_000), peak(600_000_000))\n"
        "large = b'1' * 500_000_000\n"
        "del large\n"
        "print(peak(1))\n"
    )
    done = subprocess.run([PYTHON, "-c", script], capture_output=True, text=True, check=True)
    small, large, unknown = map(float, done.stdout.split())
    assert 0.2 < small < 0.3 and 0.6 < large < 0.7
    assert large - small == pytest.approx(0.4, abs=0.01)
    assert math.isnan(unknown)


def test_output_is_kept_and_the_watcher_hears_how_far_it_is(command, tmp_path):
    heard: list[float | None] = []
    words = command("print('Step'); print('5 (12.50%)  1 ms'); time.sleep(0.8); print('9 (50.00%)'); time.sleep(0.8)")
    run_command([*words, "a b"], tmp_path / "log", watch=heard.append)
    assert heard[0] == 0.125 and heard[-1] == 0.5
    assert (tmp_path / "log").read_text().splitlines()[1:] == ["5 (12.50%)  1 ms", "9 (50.00%)"]


def test_a_failed_command_is_told_with_its_last_lines(command, tmp_path):
    words = command("print('first'); print('CUDA?', file=sys.stderr); sys.exit(3)")
    with pytest.raises(ThermoxelsError, match=r"(?s)work: expected exit status 0, got 3.*log.*CUDA\?"):
        run_command(words, tmp_path / "log")


def test_a_killed_command_is_told(command, tmp_path):
    with pytest.raises(ThermoxelsError, match="got -9"):
        run_command(command("os.kill(os.getpid(), 9)"), tmp_path / "log")


def test_a_missing_command_is_told(tmp_path, command):
    with pytest.raises(ThermoxelsError, match=r"ns-paint: expected a command in"):
        run_command(["ns-paint"], tmp_path / "log")


def test_an_interrupt_ends_the_command(command, tmp_path):
    """The command would write its mark at the end; after the interrupt nothing is left to write it."""
    mark = tmp_path / "mark"
    words = command(
        f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(5); open({str(mark)!r}, 'w')"
    )

    def interrupt(_: float | None) -> None:
        if (tmp_path / "pid").is_file() and (tmp_path / "pid").read_text():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_command(words, tmp_path / "log", watch=interrupt)
    assert not Path(f"/proc/{(tmp_path / 'pid').read_text()}").exists()
    assert not mark.exists()


def test_systems_that_do_not_tell_memory_still_measure_time(command, tmp_path, monkeypatch):
    monkeypatch.delattr("os.wait4")
    cost = run_command(command("sys.exit(0)"), tmp_path / "log")
    assert cost.seconds > 0 and cost.peak_memory_gb != cost.peak_memory_gb
