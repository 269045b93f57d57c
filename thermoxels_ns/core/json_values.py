"""Conversion of results to values that json knows, and writing and reading of json files."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.core.errors import ThermoxelsError


def plain_values(value: Any, name: str = "value", error: type[ThermoxelsError] = ThermoxelsError) -> Any:
    """Return `value` with all dataclasses, mappings, arrays, tuples and paths in it converted to types that json knows.

    Raises `error` for NaN, infinity and values of other types; the message begins with `name` and the value's place.

    >>> plain_values({"sizes": (1, 2.5), "file": Path("a.npy")})
    {'sizes': [1, 2.5], 'file': 'a.npy'}
    """
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain_values(entry, f"{name}.{key}", error) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(entry, f"{name}[{number}]", error) for number, entry in enumerate(value)]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise error(name, expected="a finite number", got=value, remedy="Leave it out, or write None for 'unknown'.")
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    expected, got = "text, a number, a list, a mapping, a path or None", type(value).__name__
    raise error(name, expected=expected, got=got, remedy="Convert it before writing.")


def write_json(path: Path, content: Any) -> None:
    """Write `plain_values(content)`, which may raise, to a json file; raises `OutputError` if writing fails."""
    text = json.dumps(plain_values(content, path.stem), indent=1, ensure_ascii=False, allow_nan=False)
    with replace_when_done(path) as temporary:
        # Names of files that are not UTF-8 hold surrogates, which are then written as json escapes them.
        temporary.write_bytes(text.encode("utf-8", "backslashreplace"))


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs of a json object as a dictionary; raise ValueError for a key that occurs twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"the key {twice} twice")
    return found


def read_json_object(
    path: Path, remedy: str = "Write it again, or pass another file.", error: type[ThermoxelsError] = ThermoxelsError
) -> dict[str, Any]:
    """Return the object in a json file; raises `error`, with the advice `remedy`, if the file is missing or damaged,
    repeats a key, or holds another value."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=_unique)
    except (OSError, ValueError, RecursionError) as problem:
        expected = "a readable json file"
        if isinstance(problem, OSError) and path.exists():
            expected, remedy = "a file that can be read", "Check its permissions and the disk, or copy it again."
        raise error(str(path), expected=expected, got=str(problem), remedy=remedy) from problem
    if not isinstance(content, dict):
        raise error(str(path), expected="a json object", got=type(content).__name__, remedy=remedy)
    return content
