import gc
import shutil
import sys

import pytest

from tests.support.camera_card import photograph, write_pairs
from tests.support.posed_model import ring_model
from tests.support.unreadable import files_end_after
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.capture.stage_cache import StageCache, load, prepare_output, save
from thermoxels_ns.commands.capture import capture_folder
from thermoxels_ns.core.checks import hold_folder
from thermoxels_ns.core.errors import OutputError, SceneError


def test_an_interrupted_stage_finds_what_it_left_and_a_changed_one_does_not(tmp_path):
    def interrupted(where):
        (where / "half").write_text("done")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        StageCache(tmp_path).run("poses", {"size": 1}, interrupted)
    found = []
    StageCache(tmp_path).run("poses", {"size": 1}, lambda where: found.append((where / "half").exists()))
    StageCache(tmp_path).run("poses", {"size": 2}, lambda where: found.append((where / "half").exists()))
    assert found == [True, False]


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="which holds other files"):
        prepare_output(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    assert prepare_output(prepare_output(tmp_path / "new")) == tmp_path / "new"


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


@pytest.mark.parametrize("first", ["a", "b", "done", "key.txt"])
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


def test_a_scene_that_someone_removed_is_written_again(tmp_path):
    images = tmp_path / "images"
    assert run_stage(tmp_path, writes=[images]) == []
    assert run_stage(tmp_path, writes=[images]) is None
    shutil.rmtree(images)
    assert run_stage(tmp_path, writes=[images]) == ["a", "b"]


def test_a_result_that_does_not_fit_on_the_disk_is_one_error(tmp_path, monkeypatch):
    """Nothing else is printed, not even when what held the half-made file is cleared away."""
    later = []
    monkeypatch.setattr(sys, "unraisablehook", later.append)
    with files_end_after(2000), pytest.raises(OutputError, match=r"model\.npz"):
        save(tmp_path / "model.npz", ring_model(4))
    gc.collect()
    assert later == [] and list(tmp_path.iterdir()) == []
    save(tmp_path / "model.npz", ring_model(4))
    assert load(tmp_path / "model.npz", SfmModel).frames == ring_model(4).frames


def stages_that_ran(card, scene, **more):
    """Titles of the stages that did not come from the cache, in a capture that ends at the poses."""
    said: list[str] = []
    with pytest.raises(SceneError, match="no poses"):
        capture_folder(card, scene, CaptureSettings(**more), said.append)
    return [line.split()[1] for line in said if line[:2].strip("0123456789") == "/" and "as before" not in line]


def test_every_change_of_the_input_is_noticed(tmp_path, monkeypatch):
    def refuse(*_):
        raise SceneError("no poses")

    monkeypatch.setattr("thermoxels_ns.capture.stages.find_poses", refuse)  # two processes of COLMAP each time
    card, scene = write_pairs(tmp_path / "card", "abcd"), tmp_path / "scene"
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


def test_a_second_capture_is_refused_and_changes_nothing(tmp_path):
    output = prepare_output(tmp_path / "scene")
    (tmp_path / "card").mkdir()
    half = output / ".capture.4711.part.html"
    half.write_text("being written by the first one")
    lock = hold_folder(output / ".capture" / "lock", "", lambda _: None)
    before = sorted(output.rglob("*"))
    with pytest.raises(OutputError, match=r"process \d+"):
        capture_folder(tmp_path / "card", output, CaptureSettings())
    assert sorted(output.rglob("*")) == before
    lock.release()
