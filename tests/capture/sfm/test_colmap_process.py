import importlib
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.camera_card import write_pairs
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.colmap import run_in_process
from thermoxels_ns.commands.capture import capture_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError

WORK = """
import os, time

def count_to(last, say):
    for number in range(last):
        say(f"{number} ä")
    return os.getpid(), ["ä"] * 100_000


def raise_one(problem, say):
    say("before")
    raise problem


def wait_for_ever(folder, say):
    (folder / "pid").write_text(str(os.getpid()))
    say("waiting")
    time.sleep(600)
"""
"""A module that both processes can import."""


@pytest.fixture
def work(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.mktemp("module")
    (folder / "capture_apart.py").write_text(WORK, encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "capture_apart", raising=False)
    yield importlib.import_module("capture_apart")
    sys.modules.pop("capture_apart", None)


def test_it_is_another_process_that_says_how_far_it_is_and_what_it_returns_arrives(tmp_path, work):
    said = []
    number, words = run_in_process(work.count_to, (3,), said.append)
    assert said == ["0 ä", "1 ä", "2 ä"]
    assert number != os.getpid() and words == ["ä"] * 100_000
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("problem", [SceneError("frame 3: no."), OSError(28, "No space left on device", "pairs.txt")])
def test_errors_arrive_as_they_were_raised(tmp_path, work, problem):
    said = []
    with pytest.raises(type(problem)) as raised:
        run_in_process(work.raise_one, (problem,), said.append)
    assert type(raised.value) is type(problem) and str(raised.value) == str(problem)
    assert said == ["before"]


def test_a_mapping_that_aborts_is_an_error_and_the_capture_goes_on_behind_its_features(tmp_path, monkeypatch):
    write_pairs(tmp_path / "card")
    said: list[str] = []
    monkeypatch.setattr("thermoxels_ns.capture.sfm.poses._map", _abort_in_the_middle)
    with pytest.raises(ThermoxelsError, match=r"COLMAP: .* terminated abruptly.*--from-stage poses"):
        capture_folder(tmp_path / "card", tmp_path / "scene", CaptureSettings(), said.append)
    assert said[-1].startswith("matches: 3 of 3")
    monkeypatch.undo()
    with pytest.raises(SceneError, match="photographs that fit together"):  # grey ones: it got past the mapping
        capture_folder(tmp_path / "card", tmp_path / "scene", CaptureSettings())


def _abort_in_the_middle(*_):
    os.abort()


PARENT = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from capture_apart import wait_for_ever
from thermoxels_ns.capture.sfm.colmap import run_in_process
run_in_process(wait_for_ever, (Path(sys.argv[1]),), lambda line: print(line, flush=True))
"""


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="processes are looked up in /proc")
def test_it_ends_with_the_process_that_started_it(tmp_path, work):
    arguments = [sys.executable, "-c", PARENT, str(tmp_path), str(Path(work.__file__).parent)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout.readline() == "waiting\n"
        parent.kill()
    pid = int((tmp_path / "pid").read_text())
    for _ in range(200):
        if not _runs(pid):
            break
        time.sleep(0.05)
    assert not _runs(pid)


def _runs(pid: int) -> bool:
    """Whether a process is there that has not ended; one that nobody asked after is a zombie."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
