"""Features and matches are begun only where the database they go to has room."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from thermoxels_ns.capture.sfm import feature_matching
from thermoxels_ns.capture.sfm.feature_matching import PoseOptions, ReducedPhotographs, fill_database, image_pairs
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import OutputError

CAMERA = Camera(width=640, height=480, fl_x=500.0, fl_y=500.0, cx=320.0, cy=240.0)
FEATURES = 1000


@pytest.fixture
def started(monkeypatch) -> list[tuple]:
    """What would have run in a process of its own."""
    calls: list[tuple] = []
    monkeypatch.setattr(feature_matching, "run_in_process", lambda function, arguments, *_: calls.append(arguments))
    return calls


def fill(folder: Path, photographs: int) -> None:
    names = {f"{n:03d}.jpg": f"{n}" for n in range(photographs)}
    reduced = ReducedPhotographs(folder / "database.db", folder, names, (640, 480))
    options = PoseOptions(max_features=FEATURES, matching="exhaustive")
    fill_database(reduced, CAMERA, True, options, lambda _: None)


def least_room(folder: Path, photographs: int, monkeypatch, started: list[tuple]) -> int:
    """Free bytes from which on the work begins, found by halving."""
    low, high = 0, 10**11
    while high - low > 1:
        free = (low + high) // 2
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        before = len(started)
        try:
            fill(folder, photographs)
        except OutputError:
            low = free
        else:
            assert len(started) == before + 1
            high = free
    return high


def test_room_grows_with_photographs_and_with_their_pairs(tmp_path, monkeypatch, started) -> None:
    """A feature is 128 bytes and where it is; every pair of photographs may share all of them."""
    needed = {count: least_room(tmp_path, count, monkeypatch, started) for count in (1, 2, 3, 60)}
    per_photograph = needed[2] - needed[1] - (needed[3] - 2 * needed[2] + needed[1])
    per_pair = needed[3] - 2 * needed[2] + needed[1]  # photographs grow by one each, pairs by one and by two
    assert 128 * FEATURES <= per_photograph <= 400 * FEATURES
    assert 4 * FEATURES <= per_pair <= 16 * FEATURES
    pairs = len(image_pairs(60, "exhaustive"))
    assert needed[60] == needed[1] + 59 * per_photograph + pairs * per_pair


def test_what_is_there_already_needs_no_room_again(tmp_path, monkeypatch, started) -> None:
    whole = least_room(tmp_path, 20, monkeypatch, started)
    (tmp_path / "database.db").write_bytes(b"0" * 1_000_000)
    assert least_room(tmp_path, 20, monkeypatch, started) == whole - 1_000_000


def test_too_little_room_is_said_with_what_helps(tmp_path, monkeypatch, started) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=3_000_000))
    with pytest.raises(OutputError, match=r"free for features and matches, got 3 MB\..*--max-features"):
        fill(tmp_path, 60)
    assert started == []
