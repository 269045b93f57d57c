"""Stages run once for the same input, again when something changed, and go on where they were interrupted."""

from __future__ import annotations

import pytest

from thermoxels_ns.capture.stages import CACHE_FOLDER, StageCache, fingerprint, prepare_output, read_json
from thermoxels_ns.core.errors import OutputError, ThermoxelsError


def run_two(folder, first=1, second=1, from_stage=None):
    """Two stages that note that they ran; returns which did."""
    ran = []
    cache = StageCache(folder, from_stage)
    for name, option in (("pairs", first), ("temperatures", second)):
        cache.run(name, {"option": option}, lambda where, name=name: ran.append(name) or (where / "x").write_text(name))
    return ran


def test_a_stage_runs_once(tmp_path):
    assert run_two(tmp_path) == ["pairs", "temperatures"]
    assert run_two(tmp_path) == []


def test_a_change_runs_this_stage_and_all_later_ones(tmp_path):
    run_two(tmp_path)
    assert run_two(tmp_path, second=2) == ["temperatures"]
    assert run_two(tmp_path, first=2, second=2) == ["pairs", "temperatures"]


def test_from_stage_runs_again_what_has_not_changed(tmp_path):
    run_two(tmp_path)
    assert run_two(tmp_path, from_stage="temperatures") == ["temperatures"]
    assert run_two(tmp_path, from_stage="pairs") == ["pairs", "temperatures"]


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


def test_a_result_that_is_gone_is_made_again(tmp_path):
    page = tmp_path / "capture.html"
    runs = []
    for _ in range(2):
        StageCache(tmp_path).run("page", {}, lambda _: runs.append(page.write_text("x")), [page])
    assert len(runs) == 1
    page.unlink()
    StageCache(tmp_path).run("page", {}, lambda _: runs.append(page.write_text("x")), [page])
    assert len(runs) == 2


def test_a_damaged_result_says_what_to_do(tmp_path):
    own, given = tmp_path / CACHE_FOLDER / "pairs.json", tmp_path / "transforms.json"
    own.parent.mkdir()
    for path, said in ((own, "--from-stage pairs"), (given, "pass another file")):
        for content in ("{", "[" * 100_000, None):
            path.unlink() if content is None else path.write_text(content)
            with pytest.raises(ThermoxelsError, match=rf"{path.name}.*{said}"):
                read_json(path)


def test_a_file_that_was_replaced_is_noticed(tmp_path):
    file = tmp_path / "a.jpg"
    file.write_bytes(b"1")
    before = fingerprint([file], tmp_path)
    file.write_bytes(b"22")
    assert before[0][0] == "a.jpg"
    assert fingerprint([file], tmp_path) != before


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="which holds other files"):
        prepare_output(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    assert prepare_output(prepare_output(tmp_path / "new")) == tmp_path / "new"
