"""How the stages' results are kept: arrays in .npz files, the rest in json."""

from __future__ import annotations

import io
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from thermoxels_ns.capture.folder_scan import shown_name
from thermoxels_ns.capture.pairs import Pair, PairSearch
from thermoxels_ns.capture.sfm.gravity import Up
from thermoxels_ns.capture.sfm.metric_scale import MetricScale
from thermoxels_ns.core import json_values
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.json_values import write_json

_Record = TypeVar("_Record")
_EXPECTED = "what an earlier stage of the capture wrote"
_REMEDY = "Run it again with --from-stage pairs."


def save(path: Path, record: Any) -> None:
    """Write a dataclass of arrays, numbers, texts, tuples and perspective cameras as .npz, whole or not at all."""
    values = {each.name: getattr(record, each.name) for each in fields(record)}
    for name, value in values.items():
        if isinstance(value, Camera):  # all but the lens, which comes last
            values[name] = tuple(getattr(value, each.name) for each in fields(value)[:-1])
    packed = io.BytesIO()  # in memory, because numpy's half-made files complain later
    np.savez(packed, **{name: np.asarray(value) for name, value in values.items()})  # type: ignore[arg-type]
    with replace_when_done(path) as temporary:
        temporary.write_bytes(packed.getbuffer())


def load(path: Path, kind: type[_Record]) -> _Record:
    """Read a dataclass that `save` wrote; a `ThermoxelsError` where the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as opened:
            arrays = {name: opened[name] for name in opened.files}
    except (OSError, ValueError, KeyError) as problem:
        got = str(problem) or type(problem).__name__
        raise ThermoxelsError(str(path), expected=_EXPECTED, got=got, remedy=_REMEDY) from problem
    return kind(**{name: _value(arrays[name], hint) for name, hint in get_type_hints(kind).items()})


def load_json(path: Path) -> Any:
    """Read json that a stage wrote; a `ThermoxelsError` where it is missing or damaged."""
    return json_values.read_json(path, _EXPECTED, _REMEDY)


def _value(array: np.ndarray, hint: Any) -> Any:
    """What was kept as an array, in the type of its field."""
    if hint is Camera:
        width, height, *numbers = array.tolist()
        return Camera(int(width), int(height), *numbers)
    if hint in (str, bool, float, int):
        return hint(array.item())
    return tuple(array.tolist()) if getattr(hint, "__origin__", None) is tuple else array


def save_pairs(folder: Path, search: PairSearch, root: Path) -> None:
    """Write pairs with names relative to the capture's folder."""
    real = root.resolve()
    rows = []
    for pair in search.pairs:
        files = (file.resolve().relative_to(real).as_posix() for file in (pair.photograph, pair.thermal))
        rows.append([pair.name, *files, pair.how])
    unpaired = {}
    for path, why in search.unpaired.items():
        parts = path.relative_to(root).parts if path.is_relative_to(root) else (path.name,)
        unpaired["/".join(shown_name(Path(part)) for part in parts)] = why
    write_json(folder / "pairs.json", {"pairs": rows, "unpaired": unpaired})


def load_pairs(folder: Path, root: Path) -> tuple[tuple[Pair, ...], dict[str, str]]:
    """Read pairs, and why other files are in none, by their names."""
    content = load_json(folder / "pairs.json")
    rows = content["pairs"]
    return tuple(Pair(name, root / first, root / second, how) for name, first, second, how in rows), content["unpaired"]


def load_scale(file: Path) -> tuple[MetricScale | None, str, Up]:
    """Read the scale, why there is none, and up."""
    content = load_json(file)
    scale, up = content["scale"], content["up"]
    up["direction"] = np.array(up["direction"], dtype=np.float64)
    return None if scale is None else MetricScale(**scale), content["missing"], Up(**up)
