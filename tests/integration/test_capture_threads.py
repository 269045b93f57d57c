import sqlite3
from pathlib import Path

import numpy as np
import pytest

from tests.integration.commands import run
from tests.support.textured_room import write_card

COUNT = 5
OPTIONS = "--max-features 300 --image-size 320 --thermal-field-of-view-deg 56"
OF_THE_RUN = {"capture.html", "lock", "done.json", "key.txt", "features.db"}
"""They hold times, a process number, the options, and rows in the order in which threads ended."""


def captured(card: Path, scene: Path, threads: int) -> Path:
    """The scene that the command writes where everything may use so many threads."""
    command = ("thermoxels", "capture", str(card), "--output", str(scene), *OPTIONS.split())
    result = run(*command, "--threads", str(threads), timeout_s=1200.0, threads=threads)
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
    assert {"transforms.json", ".capture/poses/model.npz", ".capture/rig/rig.npz", ".capture/drift/drift.npz"} <= set(
        one
    )
    assert sorted(one) == sorted(three)
    assert [name for name in sorted(one) if one[name] != three[name]] == []
    with np.load(scenes[0] / ".capture" / "rig" / "rig.npz") as rig:
        assert rig["determined"]  # else the search would not have been compared


def test_features_and_matches_are_the_same(scenes):
    one, three = map(rows_of, scenes)
    assert len(one["keypoints"]) == COUNT and len(one["two_view_geometries"]) == COUNT * (COUNT - 1) // 2
    assert one == three


def rows_of(scene: Path) -> dict[str, list[tuple]]:
    """What COLMAP's database holds, by table."""
    with sqlite3.connect(scene / ".capture" / "poses" / "features.db") as opened:
        tables = [row[0] for row in opened.execute("select name from sqlite_master where type = 'table'")]
        return {name: sorted(opened.execute(f"select * from {name}"), key=repr) for name in tables}
