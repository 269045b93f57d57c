"""Which frames train and which evaluate; no frame ever does both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from thermoxels_ns.core.errors import SceneError

SplitMode = Literal["auto", "filename", "lists", "interval"]
_KEYS = {"train": "train_filenames", "val": "val_filenames", "test": "test_filenames"}


@dataclass(frozen=True)
class Split:
    """Positions of frames in the sorted list of names."""

    train: list[int]
    val: list[int]
    test: list[int]
    how: str  # how the split was made, for the report


def split_frames(
    names: Sequence[str],
    meta: Mapping[str, Any],
    mode: SplitMode,
    interval: int,
    offset: int | None,
    left_out: Sequence[str] = (),
) -> Split:
    """Split frames, given by their sorted names, into training and evaluation.

    "auto" takes the first that the scene has: names with frame_train_ and frame_eval_, lists in the json
    (train_filenames, val_filenames, test_filenames), every n-th frame from an offset on (None: half the interval, so
    that the ends of the sequence, which the others see least, stay in training). Lists may hold names left out.

    Raises:
        SceneError: A side is empty, a frame is on both sides or a listed name is unknown.
    """
    tagged = [("frame_train_" in Path(n).name, "frame_eval_" in Path(n).name) for n in names]
    lists = any(key in meta for key in _KEYS.values())
    if mode == "filename" or (mode == "auto" and any(train or test for train, test in tagged)):
        split = _by_name(names, tagged)
    elif mode == "lists" or (mode == "auto" and lists):
        split = _by_lists(names, meta, left_out)
    else:
        split = _by_interval(names, interval, offset)
    for side, chosen in (("training", split.train), ("evaluation", split.val), ("evaluation", split.test)):
        if not chosen:
            expected = f"at least one of the {len(names)} frames ({split.how})"
            remedy = "Add frames or choose another split, e.g. --eval-mode interval --eval-interval 2."
            raise SceneError(f"{side} frames", expected=expected, got="none", remedy=remedy)
    both = set(split.train) & (set(split.val) | set(split.test))
    if both:
        remedy = "Remove them from one list: evaluation frames must never train."
        got = ", ".join(names[i] for i in sorted(both)) + " in training and in evaluation"
        raise SceneError("split lists", expected="no frame on both sides", got=got, remedy=remedy)
    return split


def _by_name(names: Sequence[str], tagged: list[tuple[bool, bool]]) -> Split:
    unclear = [name for name, (train, evaluate) in zip(names, tagged) if train == evaluate]
    if unclear:
        expected, got = "frame_train_ or frame_eval_ in every name", f"{unclear[0]} ({len(unclear)} such)"
        remedy = "Rename them or pass --eval-mode interval."
        raise SceneError("split by file name", expected=expected, got=got, remedy=remedy)
    evaluate = [i for i, (_, test) in enumerate(tagged) if test]
    return Split([i for i, (train, _) in enumerate(tagged) if train], evaluate, evaluate, "by file name")


def _by_lists(names: Sequence[str], meta: Mapping[str, Any], left_out: Sequence[str]) -> Split:
    position = {Path(name).as_posix(): i for i, name in enumerate(names)}
    found: dict[str, list[int] | None] = {}
    for side, key in _KEYS.items():
        given = meta.get(key, [])
        if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
            remedy = 'Write ["images/a.jpg", "images/b.jpg"], for example.'
            raise SceneError(key, expected="a list of file names", got=repr(given)[:80], remedy=remedy)
        listed = [Path(name).as_posix() for name in given] if key in meta else None
        listed = None if listed is None else [name for name in listed if name not in left_out]
        unknown = [name for name in listed or [] if name not in position]
        if unknown:
            remedy = "Correct the list; it must write names as 'file_path' does."
            got = f"{unknown[0]} ({len(unknown)} unknown)"
            raise SceneError(key, expected="names that are in 'frames'", got=got, remedy=remedy)
        found[side] = None if listed is None else sorted({position[name] for name in listed})
    val = found["val"] or found["test"]
    test = found["test"] or found["val"]
    held = set(val or []) | set(test or [])
    train = found["train"]
    if train is None:
        train = [i for i in range(len(names)) if i not in held]
    if val is None or test is None:
        val = test = [i for i in range(len(names)) if i not in set(train)]
    return Split(train, val, test, f"by {', '.join(key for key in _KEYS.values() if key in meta)} in the json")


def _by_interval(names: Sequence[str], interval: int, offset: int | None) -> Split:
    start = interval // 2 if offset is None else offset
    if interval < 2 or not 0 <= start < interval:
        expected, got = "an interval of at least 2 and an offset from 0 to interval - 1", f"{interval}, {start}"
        raise SceneError("eval_interval, eval_offset", expected=expected, got=got, remedy="Pass --eval-interval 8.")
    evaluate = list(range(start, len(names), interval))
    train = [i for i in range(len(names)) if i % interval != start]
    return Split(train, evaluate, evaluate, f"every {interval}th frame from number {start}")
