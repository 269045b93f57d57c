import io
import subprocess
import sys
from pathlib import Path

import pytest

from thermoxels_ns.commands.installed_commands import run_command
from thermoxels_ns.core.errors import ThermoxelsError

PYTHON = sys.executable  # Before `fake_command` replaces it


def test_output_of_a_command_is_shown_while_it_runs_and_kept(fake_command, tmp_path):
    gate = tmp_path / "gate"
    # The command ends well only after its first line was shown: showing it opens the gate.
    fake_command(
        "say",
        "print('it says [bold]', *sys.argv[1:])\n"
        f"for _ in range(200):\n    if os.path.exists({str(gate)!r}): break\n    time.sleep(0.05)\n"
        "else: sys.exit('the gate stayed shut')\nprint('\\u00b0C', file=sys.stderr)",
    )

    class Opener(io.StringIO):
        def write(self, text: str) -> int:
            if "[bold]" in text:
                gate.write_text("open")
            return super().write(text)

    run_command(["say", "a b", "c"], tmp_path / "say.log", seen := Opener())
    assert seen.getvalue().splitlines() == ["$ say 'a b' c", "it says [bold] a b c", "°C"]
    assert (tmp_path / "say.log").read_text(encoding="utf-8") == "it says [bold] a b c\n°C\n"


def test_memory_is_that_of_the_command(fake_command, tmp_path):
    """400 MB more are seen, also when they are free again before the end.

    Measured from a process of its own: this one may be large, and what it starts would be told to be as large.
    """
    fake_command("work", "x = b'1' * int(sys.argv[1]); del x")
    script = f"""
import pathlib, sys
from thermoxels_ns.commands.installed_commands import run_command
sys.executable = {str(tmp_path / "bin" / "python")!r}
peak = lambda size: run_command(['work', str(size)], pathlib.Path('log')).peak_memory_gb
print(peak(200_000_000), peak(600_000_000))
"""
    done = subprocess.run([PYTHON, "-c", script], capture_output=True, text=True, check=True, cwd=tmp_path)
    small, large = map(float, done.stdout.split())
    assert 0.2 < small < 0.3 and 0.6 < large < 0.7
    assert large - small == pytest.approx(0.4, abs=0.01)


def test_a_failing_command_is_an_error_with_its_last_lines(fake_command, tmp_path):
    fake_command("fail", "for n in range(40): print('line', n)\nsys.exit('no space left')")
    with pytest.raises(ThermoxelsError) as caught:
        run_command(["fail"], tmp_path / "fail.log", io.StringIO())
    message = str(caught.value)
    assert message.startswith("fail: expected exit status 0, got 1.")
    assert message.splitlines()[-2:] == ["    line 39", "    no space left"]
    assert len(message.splitlines()) < 20 and str(tmp_path / "fail.log") in message


def test_a_command_of_another_environment_is_not_used(fake_command, tmp_path, monkeypatch):
    other = tmp_path / "other"
    other.mkdir()
    (other / "ns-train").write_text("#!/bin/sh\n")
    (other / "ns-train").chmod(0o755)
    monkeypatch.setenv("PATH", str(other))
    with pytest.raises(ThermoxelsError, match=r"^ns-train: expected"):
        run_command(["ns-train"], tmp_path / "log", io.StringIO())


def test_an_interrupt_ends_the_command(fake_command, tmp_path):
    """The command would write its mark at the end; after the interrupt nothing is left to write it."""
    mark = tmp_path / "mark"
    fake_command(
        "work",
        f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); print('started')\n"
        f"time.sleep(5); open({str(mark)!r}, 'w')",
    )

    class Interrupter(io.StringIO):
        def write(self, text: str) -> int:
            if text.startswith("started"):
                raise KeyboardInterrupt
            return len(text)

    with pytest.raises(KeyboardInterrupt):
        run_command(["work"], tmp_path / "log", Interrupter())
    assert not Path(f"/proc/{(tmp_path / 'pid').read_text()}").exists()
    assert not mark.exists()


def test_systems_that_do_not_tell_memory_still_measure_time(fake_command, tmp_path, monkeypatch):
    monkeypatch.delattr("os.wait4")
    fake_command("work", "sys.exit(0)")
    cost = run_command(["work"], tmp_path / "log", io.StringIO())
    assert cost.seconds > 0 and cost.peak_memory_gb != cost.peak_memory_gb


def test_a_process_that_a_command_leaves_behind_does_not_hold_it_up(fake_command, tmp_path):
    fake_command(
        "leave",
        "import subprocess\nsubprocess.Popen([sys.executable, '-c', 'import time; time.sleep(30)'])\nprint('done')",
    )
    took = run_command(["leave"], tmp_path / "leave.log", screen := io.StringIO())
    assert took.seconds < 20.0 and screen.getvalue().splitlines()[-1] == "done"
