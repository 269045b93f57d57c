"""A capture of drawn photographs gives the same bytes with any number of threads, and after a kill at any stage."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.integration.commands import run
from tests.support.textured_room import write_card

COUNT = 5
OPTIONS = "--max-features 300 --image-size 320 --thermal-field-of-view-deg 56"
OF_THE_RUN = {"capture.html", "lock", "key.txt", "features.db"}
"""They hold times, a process number, the options, and rows in the order in which threads ended."""


STOPS = ("matches:", "rig: Comparing", "drift:")
"""What the command says last before it is killed, one after the other."""


def command(card: Path, scene: Path) -> list[str]:
    return ["thermoxels", "capture", str(card), "--output", str(scene), *OPTIONS.split()]


def captured(card: Path, scene: Path, threads: int) -> Path:
    """The scene that the command writes where everything may use so many threads."""
    result = run(*command(card, scene), "--threads", str(threads), timeout_s=1200.0, threads=threads)
    assert result.returncode == 0, result.stdout
    return scene


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("threads")
    write_card(folder / "card", COUNT)
    return captured(folder / "card", folder / "one", 1), captured(folder / "card", folder / "three", 3)


def files_of(scene: Path) -> dict[str, bytes]:
    paths = [path for path in scene.rglob("*") if path.is_file() and path.name not in OF_THE_RUN]
    return {path.relative_to(scene).as_posix(): path.read_bytes() for path in paths}


def test_every_stage_writes_the_same_bytes(scenes):
    one, three = map(files_of, scenes)
    assert {"transforms.json", "colmap/sparse/0/points3D.bin", ".capture/rig/rig.npz"} <= set(one)
    assert sorted(one) == sorted(three)
    assert [name for name in sorted(one) if one[name] != three[name]] == []
    with np.load(scenes[0] / ".capture" / "rig" / "rig.npz") as rig:
        assert rig["determined"]  # else the search would not have been compared


def kill_after(words: str, arguments: list[str]) -> None:
    script = str(Path(sys.executable).with_name(arguments[0]))
    with subprocess.Popen(
        [script, *arguments[1:]],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", "TERM": "dumb"},
    ) as process:
        seen = []
        for line in process.stdout:
            seen.append(line)
            if line.startswith(words):
                process.send_signal(signal.SIGKILL)
                break
        assert process.wait() == -signal.SIGKILL, "".join(seen)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_kill_9_at_any_stage_changes_nothing_in_the_scene(scenes, tmp_path):
    alone, killed = scenes[0], tmp_path / "killed"
    words = command(alone.parent / "card", killed)
    for last in STOPS:
        kill_after(last, words)
    again = run(*words)
    assert again.returncode == 0, again.stdout
    assert "poses: as before" in again.stdout and "rig: as before" in again.stdout
    assert len(written(killed)) == 2 * COUNT + 6  # json, and COLMAP's model
    assert written(killed) == written(alone)
    assert (killed / "capture.html").is_file()


def written(scene: Path) -> dict[str, bytes]:
    """The scene without what the stages keep for another run."""
    return {name: content for name, content in files_of(scene).items() if not name.startswith(".capture/")}
