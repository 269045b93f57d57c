"""Two captures never write into one folder at once, and one that was killed stands in nobody's way."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys

import pytest

from thermoxels_ns.capture import output_lock
from thermoxels_ns.capture.output_lock import LOCK_FILE, only_capture
from thermoxels_ns.capture.run import run_capture
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.stages import CACHE_FOLDER, prepare_output
from thermoxels_ns.core.errors import OutputError

needs_locks = pytest.mark.skipif(output_lock.fcntl is None, reason="this system has no flock")

HOLD = """
import sys, time
from pathlib import Path
from thermoxels_ns.capture.output_lock import only_capture
with only_capture(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def output(tmp_path):
    return prepare_output(tmp_path / "scene")


@needs_locks
def test_a_second_capture_is_refused_and_changes_nothing(tmp_path, output):
    (tmp_path / "card").mkdir()
    half = output / ".capture.4711.part.html"
    half.write_text("being written by the first one")
    with only_capture(output):
        before = sorted(output.rglob("*"))
        with pytest.raises(OutputError, match=r"no other capture.*process \d+ is at work.*--output"):
            run_capture(tmp_path / "card", output, CaptureSettings())
        assert sorted(output.rglob("*")) == before
        with only_capture(prepare_output(tmp_path / "another")):
            assert half.exists()


@needs_locks
def test_a_folder_is_free_again_after_the_end_and_after_an_error(output):
    entered = []
    with pytest.raises(KeyboardInterrupt), only_capture(output):
        entered.append("interrupted")
        raise KeyboardInterrupt
    with only_capture(output):
        entered.append("again")
    assert entered == ["interrupted", "again"]


@needs_locks
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_a_killed_process_leaves_no_lock(output):
    with subprocess.Popen([sys.executable, "-c", HOLD, str(output)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match=f"process {process.pid} is at work"), only_capture(output):
            pass
        process.kill()
    assert (output / CACHE_FOLDER / LOCK_FILE).read_text() == str(process.pid)  # the file stays and means nothing
    with only_capture(output):
        assert (output / CACHE_FOLDER / LOCK_FILE).read_text() != str(process.pid)


@needs_locks
def test_a_drive_without_locks_says_so_and_goes_on(output, monkeypatch):
    def refused(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(output_lock.fcntl, "flock", refused)
    said, entered = [], []
    with only_capture(output, said.append):
        entered.append(True)
    assert entered and len(said) == 1
    assert "No locks available" in said[0] and "start one at a time" in said[0]


def test_a_system_without_locks_says_so_and_goes_on(output, monkeypatch):
    monkeypatch.setattr(output_lock, "fcntl", None)
    said = []
    with only_capture(output, said.append), only_capture(output, said.append):
        assert [line.startswith("output: this system does not tell") for line in said] == [True, True]
