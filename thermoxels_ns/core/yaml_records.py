"""Yaml files read into checked dataclasses, and presets that replace fields of a dataclass."""

from __future__ import annotations

import dataclasses
import difflib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin, get_type_hints

import yaml
from typing_extensions import dataclass_transform

from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import RecordError, ThermoxelsError, explain, printable

if TYPE_CHECKING:  # pydantic is slow to import, and presets do not need it
    from pydantic import ConfigDict, ValidationError

Record = TypeVar("Record")

_PACKAGE = Path(__file__).resolve().parents[1]
_NUMBER = "Write it without quotes and without a unit; a power of ten needs a point and a sign, as in 1.0e+3."
_EXPECTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text",
    "string_pattern_mismatch": "a text",
    "tuple_type": "a list of entries",
    "dict_type": "key: value lines",
    "dataclass_type": "key: value lines",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than_equal": "a number of at most {le:g}",
}
"""Text for "expected" in our message by the type of pydantic's error; braces take values of the error's context."""
_MOST_TOLD = 20  # Most mistakes that one message lists
_MOST_PARTS = 1_000_000  # Most pieces of json text that a file may become


def configs_folder() -> Path:
    """Return the folder of our yaml files: inside the package if installed, beside the package in a source tree."""
    inside = _PACKAGE / "configs"
    return inside if inside.is_dir() else _PACKAGE.parent / "configs"


def write_example(path: Path, example: str, error: type[ThermoxelsError]) -> None:
    """Copy the file `example` of `configs_folder` to `path`; raises `error` if `path` exists."""
    if path.exists():
        remedy = "Choose another name."
        raise error(str(path), expected="a name that is free", got="a file", remedy=remedy)
    writable_folder(path.parent)
    with replace_when_done(path) as temporary:
        temporary.write_text((configs_folder() / example).read_text(encoding="utf-8"), encoding="utf-8")


@contextmanager
def raising(error: type[ThermoxelsError], before: str = "") -> Iterator[None]:
    """Replace a `ThermoxelsError` of a with block or decorated function by `error`, with `before` before the text."""
    try:
        yield
    except ThermoxelsError as problem:
        raise error(f"{before}{problem}") from problem.__cause__  # the new text holds that of the problem


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a yaml file; raises `RecordError` if it is missing, damaged or empty, or repeats a key."""
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)
    except OSError as problem:
        remedy = "Correct the path, or the permissions."
        raise wrong(str(path), "a yaml file", problem.strerror or problem, remedy) from problem
    except (yaml.YAMLError, ValueError, RecursionError) as problem:  # ValueError: a date such as 2025-13-01
        nested = isinstance(problem, RecursionError)
        got = "entries nested too deeply to read" if nested else " ".join(str(problem).split())
        raise wrong(path.name, "a yaml file", got) from problem
    if not isinstance(content, dict) or not content:
        raise wrong(path.name, "key: value lines", shown(content))
    return content


def wrong(name: str, expected: str, got: object, remedy: str = "Correct the file.") -> RecordError:
    """Return a `RecordError` which says that the file or entry `name` should be `expected` but is `got`."""
    return RecordError(name, expected=expected, got=got, remedy=remedy)


def shown(content: object) -> str:
    """Return a value from a file as text for messages, at most 200 characters; "nothing" for None."""
    return "nothing" if content is None else repr(content)[:200]


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def record(error: type[ThermoxelsError]) -> Callable[[type[Record]], type[Record]]:
    """Return a decorator that makes a class a frozen dataclass whose constructor checks its arguments by their types.

    The constructor raises one `error` that lists all mistakes. A class may check several fields together in
    ``__post_init__``, which must then raise a `ThermoxelsError` that is also a ValueError, such as `RecordError`.
    """
    from pydantic import ValidationError
    from pydantic.dataclasses import dataclass

    def decorate(plain: type[Record]) -> type[Record]:
        made: Any = dataclass(frozen=True, config=_config())(plain)
        build = made.__init__

        def checked(self: Any, *values: Any, **named: Any) -> None:
            try:
                build(self, *values, **named)
            except ValidationError as problem:
                names = [field.name for field in dataclasses.fields(made) if field.init and not field.kw_only]
                raise error(_report("", problem, made, dict(zip(names, values)) | named, names)) from problem

        made.__init__ = checked
        return made

    return decorate


def as_record(name: str, content: Mapping[str, Any], target: type[Record]) -> Record:
    """Return the content of a file as an instance of the dataclass `target`.

    `name` is the source of the content in messages, such as "winter.yaml". Raises `ThermoxelsError`, which lists the
    keys that are unknown, or missing and without a default, and the values of a wrong kind or out of range.
    """
    from pydantic import TypeAdapter, ValidationError

    try:
        parts = list(islice(json.JSONEncoder(default=str).iterencode(content), _MOST_PARTS + 1))
    except ValueError as problem:  # an entry contains itself
        raise wrong(name, "a yaml file", problem) from problem
    if len(parts) > _MOST_PARTS:  # a few entries that repeat each other by reference may exceed the memory
        raise wrong(name, f"at most {_MOST_PARTS:,} entries", "more", "Do not refer to entries by & and *.")
    alone: Any = tuple.__class_getitem__(target)  # passes the configuration on to dataclasses without one
    try:
        # From json, strict pydantic accepts lists as tuples and mappings as dataclasses, and converts nothing else.
        return TypeAdapter(alone, config=_config(infinite=True)).validate_json(f"[{''.join(parts)}]")[0]
    except ValidationError as problem:
        raise ThermoxelsError(_report(name, problem, target, content)) from problem


def _config(infinite: bool = False) -> ConfigDict:
    return {"extra": "forbid", "strict": True, "allow_inf_nan": infinite, "arbitrary_types_allowed": True}


def _report(name: str, problem: ValidationError, target: Any, content: Any, positional: list[str] | None = None) -> str:
    """Return one line of text for each mistake in `problem`, at most `_MOST_TOLD`. `name` is the source of `content`,
    which should have the type `target`. `positional` names the fields of a class in their order if `content` is the
    arguments of its constructor; None: `content` is from a file."""
    found: dict[tuple[str | int, ...], tuple[bool, str]] = {}
    for one in problem.errors(include_url=False):
        place, at, path, chosen = one["loc"], content, list[str | int](), False
        if positional is None:
            place = place[1:]
        elif place and isinstance(place[0], int):
            place = (positional[place[0]], *place[1:])
        for part in place:
            try:
                at = at[part]  # the value, or the mapping that lacks the key
            except (TypeError, KeyError, IndexError):
                if part is not place[-1] or one["type"] != "missing":
                    chosen = True  # this part is no key: it names one of several types that the value may have
                    continue
            path.append(part)
        chosen = chosen or one["type"] == "too_short"
        found.setdefault(tuple(path), (chosen, _mistake(name, path, at, dict(one), target)))
    deeper = {path[:length] for path in found for length in range(len(path))}
    told = [said for path, (chosen, said) in found.items() if not (chosen and path in deeper)]
    return "\n".join(told[:_MOST_TOLD])


def _mistake(name: str, path: list[str | int], value: object, one: dict[str, Any], target: Any) -> str:
    """Return our message for pydantic's error `one`, about `value` at the keys `path` of the source `name`."""
    kind, where, above = one["type"], _where(name, path), _where(name, path[:-1]) or target.__name__
    if kind == "value_error":
        return ": ".join(filter(None, (printable(where), str(one["ctx"]["error"]).removeprefix(": "))))
    if kind == "missing":
        number = isinstance(path[-1], int)
        expected, remedy = ("more entries", "Add them.") if number else (f"the key {path[-1]}", f"Add {path[-1]}.")
        got = ", ".join(map(str, value)) if isinstance(value, (dict, list)) else "nothing"  # type: ignore[arg-type]
        return explain(above, expected=expected, got=got, remedy=remedy)
    if kind == "unexpected_keyword_argument":
        known = tuple(key for key in _keys_at(target, path[:-1]) if key != path[-1])
        meant = difflib.get_close_matches(str(path[-1]), known, n=1)
        remedy = f"Did you mean {meant[0]}?" if meant else "Correct or remove that key."
        if str(path[-1])[:1].isdigit():
            remedy = "Within braces a comma ends an entry: write decimals with a point."
        return explain(above, expected=f"keys out of {', '.join(known)}", got=path[-1], remedy=remedy)
    if kind == "literal_error":
        expected = f"one of {one['ctx']['expected'].replace(chr(39), '').replace(' or ', ', ')}"
    elif kind in _EXPECTED:
        expected = _EXPECTED[kind].format(**one.get("ctx", {}))
    else:
        expected = re.sub(r"^\w+ should (be |have |match )?| after validation.*", "", one["msg"])
    remedy = {"float_type": _NUMBER, "string_type": "Put it in quotes."}.get(kind, "Correct it.")
    return explain(where or above, expected=expected, got=shown(value), remedy=remedy)


def _where(name: str, path: list[str | int]) -> str:
    """Return the name of a place in a file, such as ``winter.yaml: surfaces entry 2: patches``."""
    for part in path:
        name = f"{name} entry {part + 1}" if isinstance(part, int) else f"{name}: {part}" if name else part
    return name


def _keys_at(hint: Any, path: list[str | int]) -> tuple[str, ...]:
    """Return the field names of the dataclasses that the keys `path` lead to from the type `hint`."""
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        if not path:
            return tuple(field.name for field in dataclasses.fields(hint) if field.init)
        return _keys_at(get_type_hints(hint, include_extras=True).get(str(path[0])), path[1:])
    rest = path[1:] if get_origin(hint) in (tuple, dict, Mapping) else path
    return tuple(key for part in get_args(hint) for key in _keys_at(part, rest))


class _UniqueKeyLoader(yaml.SafeLoader):
    """Loader that raises `ConstructorError` for a key that is not text, or that a mapping has twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set[str]()
        for key, _ in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else yaml.serialize(key)
            if name in seen:
                raise yaml.constructor.ConstructorError(None, None, f"the key {name} twice", key.start_mark)
            seen.add(name)
        found = super().construct_mapping(node, deep)
        odd = next((key for key in found if not isinstance(key, str)), "")
        if odd != "":
            said = f"the key {odd!r}, no text without quotes"
            raise yaml.constructor.ConstructorError(None, None, said, node.start_mark)
        return found


Config = TypeVar("Config")


def with_overrides(config: Config, overrides: Mapping[str, Any]) -> Config:
    """Return a copy of a (nested) dataclass, or a mapping of dataclasses, with the fields in `overrides` replaced. A
    list in place of a tuple becomes a tuple. Raises `KeyError` for a name that `config` does not have."""
    fields, changed = dict(config) if isinstance(config, Mapping) else vars(config), {}
    for key, value in overrides.items():
        old = fields[key]
        if isinstance(value, Mapping) and (dataclasses.is_dataclass(old) or (isinstance(old, Mapping) and old)):
            changed[key] = with_overrides(old, value)
        else:
            changed[key] = tuple(value) if isinstance(old, tuple) and isinstance(value, list) else value
    if isinstance(config, Mapping):
        return {**fields, **changed}  # type: ignore[return-value]
    return dataclasses.replace(config, **changed)  # type: ignore[type-var]
