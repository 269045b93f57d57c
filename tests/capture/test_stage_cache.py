import gc
import shutil
import sys

import numpy as np
import pytest

from tests.support.camera_card import write_pairs
from tests.support.unreadable import files_end_after
from thermoxels_ns.capture.rig_types import guessed_rig
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.stage_cache import load_rig, prepare_output, run_stage, save_rig
from thermoxels_ns.commands.capture import capture_folder
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import hold_folder
from thermoxels_ns.core.errors import OutputError, SceneError


def test_an_interrupted_stage_finds_what_it_left_and_a_changed_one_does_not(tmp_path):
    def interrupted(where):
        (where / "half").write_text("done")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_stage(tmp_path / "poses", {"size": 1}, interrupted)
    found = []
    for size in (1, 2):
        run_stage(tmp_path / "poses", {"size": size}, lambda where: found.append((where / "half").exists()))
    assert found == [True, False]


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="which holds other files"):
        prepare_output(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    assert prepare_output(prepare_output(tmp_path / "new")) == tmp_path / "new"


def ran(folder, again=False):
    """One stage that writes two files; returns what it found in its folder, None where it did not run."""
    found = []

    def work(where):
        found.append(sorted(path.name for path in where.iterdir() if path.name != "key.txt"))
        for name in ("a", "b"):
            (where / name).write_text(name)

    run_stage(folder, {}, work, again)
    assert sorted(path.read_text() for path in folder.glob("?")) == ["a", "b"]
    return found[0] if found else None


@pytest.mark.parametrize("first", ["a", "b", "done", "key.txt"])
def test_killed_while_an_old_result_is_removed(tmp_path, monkeypatch, first):
    """Without the rest of the folder, its key and its end must not stand for a result."""
    stage = tmp_path / "poses"
    ran(stage)

    def killed(folder, **_):
        (folder / first).unlink(missing_ok=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        ran(stage, again=True)
    monkeypatch.undo()
    assert ran(stage) == []  # a part of an old result is no start either
    assert ran(stage) is None


def test_a_result_that_does_not_fit_on_the_disk_is_one_error(tmp_path, monkeypatch):
    """Nothing else is printed, not even when what held the half-made file is cleared away."""
    later = []
    monkeypatch.setattr(sys, "unraisablehook", later.append)
    found = guessed_rig(Camera(64, 48, 70.0, 71.0, 32.0, 24.0, k1=0.1), "the test")
    with files_end_after(1000), pytest.raises(OutputError, match=r"rig\.npz"):
        save_rig(tmp_path / "rig.npz", found)
    gc.collect()
    assert later == [] and list(tmp_path.iterdir()) == []
    save_rig(tmp_path / "rig.npz", found)
    again = load_rig(tmp_path / "rig.npz")
    for name, value in vars(found).items():
        np.testing.assert_array_equal(getattr(again, name), value)


def test_every_change_of_photographs_and_their_options_is_noticed(tmp_path, monkeypatch):
    def refuse(*_):
        raise SceneError("no poses")

    def key(**more) -> str:
        with pytest.raises(SceneError, match="no poses"):
            capture_folder(card, scene, CaptureSettings(**more))
        return (scene / ".capture" / "poses" / "key.txt").read_text()

    monkeypatch.setattr("thermoxels_ns.capture.stages.find_poses", refuse)
    card, scene = write_pairs(tmp_path / "card", "abcd"), tmp_path / "scene"
    keys = [key()]
    assert key() == keys[0]
    (card / "a-visible.jpg").touch()
    keys.append(key())
    write_pairs(card, "e")
    keys.append(key())
    (card / "e-radiometric.tiff").unlink()
    keys += [key(), key(seed=1)]
    assert keys[1] == keys[3] and len(set(keys)) == 4
    (card / "notes.txt").write_text("none of ours")
    (card / "a-radiometric.tiff").touch()
    assert key() == key(emissivity=0.9, reflected_c=20.0) == keys[3]


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
