import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.integration.commands import run
from tests.support.textured_room import write_card

COUNT = 5
STOPS = ("features:", "matches:", "4/9 scale", "rig: Comparing", "9/9 page")
"""What the command says last before it is killed, one after the other."""


def command(card: Path, scene: Path) -> list[str]:
    options = "--max-features 300 --image-size 320 --thermal-field-of-view-deg 56"
    return ["thermoxels", "capture", str(card), "--output", str(scene), *options.split()]


def files_of(scene: Path) -> dict[str, bytes]:
    """The scene as it is written; the page says how long the stages took."""
    paths = [path for path in scene.rglob("*") if path.is_file() and ".capture" not in path.parts]
    return {path.relative_to(scene).as_posix(): path.read_bytes() for path in paths if path.name != "capture.html"}


def kill_after(words: str, arguments: list[str]) -> None:
    script = str(Path(sys.executable).with_name(arguments[0]))
    with subprocess.Popen(
        [script, *arguments[1:]],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", "TERM": "dumb"},
    ) as process:
        assert process.stdout is not None
        seen = []
        for line in process.stdout:
            seen.append(line)
            if line.startswith(words):
                process.send_signal(signal.SIGKILL)
                break
        assert process.wait() == -signal.SIGKILL, "".join(seen)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_kill_9_at_any_stage_changes_nothing_in_the_scene(tmp_path):
    card = tmp_path / "card"
    write_card(card, COUNT)
    alone = run(*command(card, tmp_path / "alone"))
    assert alone.returncode == 0, alone.stdout
    for words in STOPS:
        kill_after(words, command(card, tmp_path / "killed"))
    again = run(*command(card, tmp_path / "killed"))
    assert again.returncode == 0, again.stdout
    assert "8/9 scene: as before" in again.stdout and "9/9 page: as before" not in again.stdout
    assert len(files_of(tmp_path / "killed")) == 2 * COUNT + 3  # json, points, tracks
    assert files_of(tmp_path / "killed") == files_of(tmp_path / "alone")
    assert (tmp_path / "killed" / "capture.html").is_file()
