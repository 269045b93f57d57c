"""A capture that is stopped at any moment goes on as if it had not been, and no half-made result is taken for whole."""

from __future__ import annotations

import gc
import shutil
import sqlite3
import sys

import pytest

from tests.support.camera_card import counts, photograph
from tests.support.posed_model import ring_model
from tests.support.textured_room import VISIBLE
from thermoxels_ns.capture.results import load_model, save_model
from thermoxels_ns.capture.run import run_capture
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.feature_matching import FeatureOptions, fill_database
from thermoxels_ns.capture.stages import STAGES, StageCache
from thermoxels_ns.core.errors import OutputError, SceneError


def run_stage(folder, from_stage=None, writes=()):
    """One stage that writes two files; returns what it found in its folder, None where it did not run."""
    ran = []

    def work(where):
        ran.append(sorted(path.name for path in where.iterdir() if path.name != "key.txt"))
        for name in ("a", "b"):
            (where / name).write_text(name)
        for path in writes:
            path.mkdir(exist_ok=True)
            (path / "picture").write_text("whole")

    where = StageCache(folder, from_stage).run("poses", {}, work, writes)
    assert sorted(path.read_text() for path in where.glob("?")) == ["a", "b"]
    return ran[0] if ran else None


@pytest.mark.parametrize("first", ["a", "b", "done.json", "key.txt"])
def test_killed_while_an_old_result_is_removed(tmp_path, monkeypatch, first):
    """Without the rest of the folder, its key and its end must not stand for a result."""
    run_stage(tmp_path)

    def killed(folder, **_):
        (folder / first).unlink(missing_ok=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        run_stage(tmp_path, "poses")
    monkeypatch.undo()
    assert run_stage(tmp_path) == []  # a part of an old result is no start either
    assert run_stage(tmp_path) is None


def test_an_old_result_that_cannot_be_removed_is_not_built_upon(tmp_path, monkeypatch):
    run_stage(tmp_path)

    def refused(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(shutil, "rmtree", refused)
    with pytest.raises(OutputError, match=r"poses.*Permission denied.*--output"):
        run_stage(tmp_path, "poses")


@pytest.mark.parametrize("damage", ["gone", "short", "more"])
def test_a_scene_that_someone_changed_is_written_again(tmp_path, damage):
    images = tmp_path / "images"
    assert run_stage(tmp_path, writes=[images]) == []
    assert run_stage(tmp_path, writes=[images]) is None
    if damage == "gone":
        (images / "picture").unlink()
    else:
        (images / ("picture" if damage == "short" else "another")).write_text("w")
    assert run_stage(tmp_path, writes=[images]) == ["a", "b"]


def test_killed_while_a_scene_is_written_again(tmp_path):
    """Files of the right sizes are no proof while the stage has not ended."""
    images = tmp_path / "images"
    run_stage(tmp_path, writes=[images])
    (images / "picture").write_text("w")

    def killed(_):
        (images / "picture").write_text("other"[:5])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        StageCache(tmp_path).run("poses", {}, killed, [images])
    assert run_stage(tmp_path, writes=[images]) is not None


def test_a_database_without_its_last_frame_is_begun_again(tmp_path):
    """COLMAP's images and frames are written one after the other: a kill between them leaves one too few."""
    from PIL import Image

    (tmp_path / "images").mkdir()
    names = ["0000.jpg", "0001.jpg"]
    for name in names:
        Image.new("L", (VISIBLE.width, VISIBLE.height), 90).save(tmp_path / "images" / name)
    options = FeatureOptions(50, "auto", "SIMPLE_RADIAL", 0, 1)

    def fill():
        database = tmp_path / "features.db"
        fill_database(database, tmp_path / "images", names, VISIBLE, True, None, options, lambda _: None)
        with sqlite3.connect(database) as opened:
            return [opened.execute(f"select count(*) from {table}").fetchone()[0] for table in ("images", "frames")]

    assert fill() == [2, 2]
    with sqlite3.connect(tmp_path / "features.db") as opened:
        opened.execute("delete from frames where frame_id = 2")
    assert fill() == [2, 2]


def test_a_result_that_does_not_fit_on_the_disk_is_one_error(tmp_path, monkeypatch):
    """Nothing else is printed, not even when what held the half-made file is cleared away."""
    resource = pytest.importorskip("resource")
    later = []
    monkeypatch.setattr(sys, "unraisablehook", later.append)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        with pytest.raises(OutputError, match=r"model\.npz"):
            save_model(tmp_path, ring_model(4))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    gc.collect()
    assert later == [] and list(tmp_path.iterdir()) == []
    save_model(tmp_path, ring_model(4))
    assert load_model(tmp_path).frames == ring_model(4).frames


def stages_that_ran(card, scene, **more):
    """Titles of the stages that did not come from the cache, in a capture that ends at the poses."""
    said: list[str] = []
    with pytest.raises(SceneError, match="photographs that fit together"):
        run_capture(card, scene, CaptureSettings(**more), said.append)
    return [line.split()[1] for line in said if line[:2].strip("0123456789") == "/" and "as before" not in line]


@pytest.fixture
def card(tmp_path):
    for name in "abcd":
        photograph(tmp_path / "card" / f"{name}-visible.jpg")
        counts(tmp_path / "card" / f"{name}-radiometric.tiff")
    return tmp_path / "card"


def test_every_change_of_the_input_is_noticed(card, tmp_path):
    scene = tmp_path / "scene"
    everything = ["pairs", "temperatures", "poses"]
    assert stages_that_ran(card, scene) == everything
    assert stages_that_ran(card, scene) == ["poses"]
    (card / "a-visible.jpg").touch()
    assert stages_that_ran(card, scene) == everything
    photograph(card / "new.jpg")
    assert stages_that_ran(card, scene) == everything
    (card / "new.jpg").unlink()
    assert stages_that_ran(card, scene) == everything
    (card / "notes.txt").write_text("none of ours")
    assert stages_that_ran(card, scene) == ["poses"]
    assert stages_that_ran(card, scene, emissivity=0.9, reflected_c=20.0) == ["temperatures", "poses"]
    assert stages_that_ran(card, scene, emissivity=0.9, reflected_c=20.0, seed=1) == ["poses"]


def test_the_page_that_a_killed_run_was_writing_is_cleared_away(card, tmp_path):
    scene = tmp_path / "scene"
    (scene / ".capture").mkdir(parents=True)
    (scene / ".capture.4711.part.html").write_text("half")
    assert stages_that_ran(card, scene) == ["pairs", "temperatures", "poses"]
    assert [path.name for path in scene.iterdir()] == [".capture"]


def test_a_listed_file_of_any_name_is_noticed(card, tmp_path):
    scene, listed = tmp_path / "scene", tmp_path / "pairs.csv"
    for name in "abc":
        (card / f"{name}-radiometric.tiff").rename(card / f"{name}.raw")
    listed.write_text("".join(f"{name}-visible.jpg,{name}.raw\n" for name in "abc"))
    assert stages_that_ran(card, scene, pairs=listed) == ["pairs", "temperatures", "poses"]
    assert stages_that_ran(card, scene, pairs=listed) == ["poses"]
    (card / "b.raw").touch()
    assert stages_that_ran(card, scene, pairs=listed) == ["pairs", "temperatures", "poses"]


def test_another_library_at_the_same_place_is_noticed(card, tmp_path):
    library = tmp_path / "libdirp.so"
    library.write_bytes(b"1")
    assert stages_that_ran(card, tmp_path / "scene", dji_library=library) == ["pairs", "temperatures", "poses"]
    library.write_bytes(b"22")
    assert stages_that_ran(card, tmp_path / "scene", dji_library=library) == ["temperatures", "poses"]


@pytest.mark.parametrize("stage", STAGES)
def test_from_stage_runs_that_stage_and_all_after_it(tmp_path, stage):
    def run(from_stage=None):
        ran = []
        cache = StageCache(tmp_path, from_stage)
        for name in STAGES:
            cache.run(name, {}, lambda _, name=name: ran.append(name))
        return ran

    assert run() == list(STAGES)
    assert run(stage) == list(STAGES[STAGES.index(stage) :])
    assert run() == []
