import math

import pytest

from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.data.dataparser import SplitMode, split_frames
from thermoxels_ns.data.scene_scale import (
    choose_scale,
    scale_from_known_distance,
    scale_from_scene_file,
    up_from_scene_file,
)

NAMES = [f"images/{letter}.jpg" for letter in "abcdefghij"]


def listed(mode: SplitMode = "auto", left_out: tuple[str, ...] = (), **lists: str) -> tuple[str, str, str]:
    """The letters that train, validate and test, from lists of letters."""
    meta = {f"{side}_filenames": [f"images/{letter}.jpg" for letter in letters] for side, letters in lists.items()}
    split = split_frames(NAMES, meta, mode, 8, left_out)
    train, val, test = ("".join(NAMES[i][7] for i in part) for part in (split.train, split.val, split.test))
    return train, val, test


@pytest.mark.parametrize(
    ("lists", "expected"),
    [
        ({"train": "abcdefg", "val": "h", "test": "ij"}, ("abcdefg", "h", "ij")),
        ({"train": "abcdefg", "val": "h"}, ("abcdefg", "h", "h")),
        ({"train": "abcdefg", "test": "ij"}, ("abcdefg", "ij", "ij")),
        ({"train": "abcdefg", "val": "", "test": "ij"}, ("abcdefg", "ij", "ij")),
        ({"train": "abcdefgh"}, ("abcdefgh", "ij", "ij")),
        ({"val": "h"}, ("abcdefgij", "h", "h")),
        ({"val": "h", "test": "ij"}, ("abcdefg", "h", "ij")),
        ({"train": "cba", "val": "i", "test": "i"}, ("abc", "i", "i")),
    ],
)
def test_lists_may_be_missing(lists, expected) -> None:
    assert listed(**lists) == expected


@pytest.mark.parametrize("side", ["val", "test"])
def test_a_frame_on_both_sides_is_refused_whichever_list_it_is_in(side) -> None:
    lists = {"train": "abcdef", "val": "h", "test": "ij"}
    with pytest.raises(SceneError, match=r"no frame on both sides, got images/c.jpg in training and in evaluation"):
        listed(**{**lists, side: lists[side] + "c"})


def test_a_listed_frame_that_was_left_out_is_not_missed_and_an_unknown_one_is() -> None:
    assert listed(train="abcx", val="hy", left_out=("images/x.jpg", "images/y.jpg")) == ("abc", "h", "h")
    with pytest.raises(SceneError, match=r"train_filenames: expected names that are in 'frames', got images/x.jpg"):
        listed(train="abcx", val="h", left_out=("images/y.jpg",))


@pytest.mark.parametrize(("interval", "held"), [(8, "e"), (4, "cg")])
def test_every_nth_frame_is_held_out_from_the_middle_of_the_interval_on(interval, held) -> None:
    split = split_frames(NAMES, {}, "auto", interval)
    assert "".join(NAMES[i][7] for i in split.val) == held and split.val == split.test
    assert sorted(split.train + split.val) == list(range(10))


def test_names_go_before_lists_and_lists_before_numbers() -> None:
    names = ["frame_eval_1.jpg", "frame_train_1.jpg", "frame_train_2.jpg"]
    lists = {"train_filenames": names[:2], "val_filenames": names[2:]}
    assert split_frames(names, lists, "auto", 8).val == [0]
    assert split_frames(names, lists, "lists", 8).val == [2]
    assert split_frames(names, lists, "interval", 3).val == [1]
    with pytest.raises(SceneError, match=r"split by file name: .* got other.jpg \(1 such\)"):
        split_frames([*names, "other.jpg"], {}, "auto", 8)
    with pytest.raises(SceneError, match="evaluation frames: expected at least one of the 2 frames"):
        split_frames(names[1:], {}, "filename", 8)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, True, "2"])
def test_scale_and_distance_must_be_above_zero(value):
    with pytest.raises(ThermoxelsError, match=r"^metres_per_unit: "):
        choose_scale(option=value)
    with pytest.raises(ThermoxelsError, match=r"^distance_m: "):
        scale_from_known_distance((0, 0, 0), (1, 0, 0), value)


@pytest.mark.parametrize("point", [(1.0, 2.0), (1.0, math.nan, 3.0), "door", (1.0, "x", 2.0), None])
@pytest.mark.parametrize("error", [-0.1, math.nan, "small"])
def test_points_and_standard_errors_that_are_none(point, error):
    with pytest.raises(ThermoxelsError, match=r"^point_b"):
        scale_from_known_distance((0, 0, 0), point, 1.0)
    with pytest.raises(ThermoxelsError, match=r"^standard_error_m: "):
        scale_from_known_distance((0, 0, 0), (1, 0, 0), 1.0, error)


@pytest.mark.parametrize(
    ("meta", "named"),
    [
        ({"metres_per_unit": 1, "metres_per_unit_standard_error": -1}, "metres_per_unit_standard_error"),
        ({"metres_per_unit_standard_error": 0.1}, "metres_per_unit_standard_error"),
        ({"metres_per_unit": 1, "up": [0, 0, math.nan]}, "up entry 3"),
    ],
)
def test_bad_scene_file(meta, named):
    with pytest.raises(SceneError, match=f"^transforms.json: {named}: "):
        scale_from_scene_file(meta)
        up_from_scene_file(meta)


def test_the_user_goes_before_the_scene_file_and_it_says_so():
    assert scale_from_scene_file({}) is None and up_from_scene_file({}) is None
    meta = {"metres_per_unit": 0.25, "metres_per_unit_standard_error": 0.01, "up": [0, -3, 4]}
    chosen = choose_scale(scene_file=meta)
    assert (chosen.metres_per_unit, chosen.standard_error) == (0.25, 0.01)
    assert "transforms.json" in chosen.source and up_from_scene_file(meta) == (0.0, -0.6, 0.8)
    chosen = choose_scale(option=3.0, scene_file=meta)
    assert chosen.metres_per_unit == 3.0
    assert "user" in chosen.source and "goes before the 0.25 m per unit of transforms.json" in chosen.source
    measured = scale_from_known_distance((0, 0, 0), (2, 0, 0), 1.0, 0.1)
    chosen = choose_scale(known_distance=measured, scene_file=meta)
    assert (chosen.metres_per_unit, chosen.standard_error) == (0.5, 0.05)
    assert "goes before" in chosen.source
