"""Yaml files turned into checked dataclasses, and presets that change some fields of one."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import date, datetime
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.measured import read_measured

Record = TypeVar("Record")

_PACKAGE = Path(__file__).resolve().parents[1]
_NUMBER = "Write it without quotes and without a unit; a power of ten needs a point and a sign, as in 1.0e+3."


def configs_folder() -> Path:
    """Find the folder of our yaml files: inside an installed package, or beside it in a source tree."""
    for folder in (_PACKAGE / "configs", _PACKAGE.parent / "configs"):
        if folder.is_dir():
            return folder
    got = f"none in or beside {_PACKAGE}"
    raise wrong("configuration files", "a folder configs", got, "Install the package again.")


@contextmanager
def raising(error: type[ThermoxelsError]) -> Iterator[None]:
    """Raise what is wrong with a file as an error of the caller's kind; a context, or a decorator of a reader."""
    try:
        yield
    except ThermoxelsError as problem:
        raise error(str(problem)) from problem


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a yaml file whose content is a mapping without a key twice, or raise `ThermoxelsError`."""
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)
    except OSError as problem:
        remedy = "Correct the path, or the permissions."
        raise wrong(str(path), "a yaml file", problem.strerror or problem, remedy) from problem
    except RecursionError as problem:
        raise wrong(path.name, "a yaml file", "entries nested too deeply to read") from problem
    except (yaml.YAMLError, UnicodeDecodeError) as problem:
        raise wrong(path.name, "a yaml file", " ".join(str(problem).split())) from problem
    except ValueError as problem:  # a date such as 2025-13-01
        raise wrong(path.name, "a yaml file with dates that exist", problem) from problem
    return as_mapping(path.name, content)


def as_mapping(name: str, content: object) -> dict[str, Any]:
    """Return what was read if it is a mapping whose keys are text."""
    if not isinstance(content, dict) or not content:
        raise wrong(name, "key: value lines", shown(content))
    for key in content:
        if not isinstance(key, str):
            raise wrong(name, "keys that are text", repr(key), "Put it in quotes.")
    return content


def as_record(name: str, content: object, target: type[Record]) -> Record:
    """Turn a mapping into a dataclass, whose fields without a default are required.

    `name` says where the mapping stands, for messages, such as "winter.yaml: sky". Raises `ThermoxelsError` if a key is
    unknown or missing, or a value is of the wrong kind or out of range.
    """
    content = as_mapping(name, content)
    hints = get_type_hints(target, include_extras=True)
    own = {field.name: field for field in dataclasses.fields(target) if field.init}  # type: ignore[arg-type]
    check_keys(name, content, tuple(own))
    missing = [key for key, field in own.items() if key not in content and _is_required(field)]
    if missing:
        raise wrong(name, f"the key {missing[0]}", ", ".join(content), f"Add {missing[0]}.")
    values = {key: as_value(f"{name}: {key}", value, hints[key]) for key, value in content.items()}
    try:
        return target(**values)
    except ThermoxelsError as problem:
        raise ThermoxelsError(f"{name}: {problem}") from problem


def check_keys(name: str, content: dict[str, Any], known: tuple[str, ...]) -> None:
    """Refuse keys that are not known, with the key that was probably meant."""
    for key in content:
        if key not in known:
            meant = _meant(key, known)
            remedy = f"Did you mean {meant}?" if meant else "Correct or remove that key."
            raise wrong(name, f"keys out of {', '.join(known)}", key, remedy)


def as_value(name: str, content: object, hint: Any) -> Any:
    """Turn what was read into a value of the type that a dataclass field has, or raise `ThermoxelsError`.

    Numbers (`Real`: as written, whole or not), truth values, texts, moments, choices (Literal), tuples of fixed or any
    length, mappings from text, dataclasses and ``Annotated[Measured, unit]`` are known; of a union, a field takes the
    first of these kinds.
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return as_value(name, content, next(kind for kind in arguments if kind is not type(None)))
    if origin is Annotated:
        return read_measured(name, content, arguments[1])
    if origin is dict:
        entries = as_mapping(name, content).items()
        return {key: as_value(f"{name}: {key}", value, arguments[1]) for key, value in entries}
    if origin is Literal:
        if content not in arguments or isinstance(content, bool):
            raise wrong(name, f"one of {', '.join(map(str, arguments))}", shown(content))
        return content
    if origin is tuple and arguments[-1] is not Ellipsis:
        if not isinstance(content, list) or len(content) != len(arguments):
            raise wrong(name, f"{len(arguments)} numbers in square brackets", shown(content))
        return tuple(as_value(name, item, kind) for item, kind in zip(content, arguments))
    if origin is tuple:
        if not isinstance(content, list):
            expected = "a list of entries, each with a dash before it"
            if arguments[0] is str:
                expected = "a list of names in square brackets"
            raise wrong(name, expected, shown(content))
        numbered = (f"{name} entry {number}" for number in range(1, len(content) + 1))
        return tuple(as_value(entry, item, arguments[0]) for entry, item in zip(numbered, content))
    if dataclasses.is_dataclass(hint):
        assert isinstance(hint, type)
        return as_record(name, content, hint)
    return _plain(name, content, hint)


def shown(content: object) -> str:
    """Show what was read in a message."""
    return "nothing" if content is None else repr(content)


def wrong(name: str, expected: str, got: object, remedy: str = "Correct the file.") -> ThermoxelsError:
    """Make the error for something in a file."""
    return ThermoxelsError(name, expected=expected, got=got, remedy=remedy)


def _plain(name: str, content: object, kind: type) -> Any:
    if kind in (float, Real):
        if isinstance(content, (int, float)) and not isinstance(content, bool):
            if isinstance(content, int) and content.bit_length() > 1023:
                raise wrong(name, "a number below 1e308", f"one of {content.bit_length()} binary digits")
            return float(content) if kind is float else content
        raise wrong(name, "a number", shown(content), _as_number(content))
    if kind is int:
        if isinstance(content, int) and not isinstance(content, bool):
            return content
        raise wrong(name, "a whole number", shown(content))
    if kind is datetime:
        if isinstance(content, datetime):
            return content
        got = str(content) if isinstance(content, date) else shown(content)
        raise wrong(name, "a date and a time", got, "Write 2025-06-21T12:00:00+02:00, without quotes.")
    if isinstance(content, kind):
        return content
    kinds = {bool: "true or false", str: "a text"}
    raise wrong(name, kinds[kind], shown(content), "Put it in quotes." if kind is str else "Correct the file.")


def _as_number(content: object) -> str:
    """Say how to write a text that looks like a number: yaml takes 1e0 and 1.0e0 for text."""
    try:
        number = float(content) if isinstance(content, str) else math.nan
    except ValueError:
        return _NUMBER
    if not math.isfinite(number):
        return _NUMBER
    mantissa, _, exponent = f"{number:.15g}".partition("e")
    if exponent:
        mantissa = f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"
    return f"Write {mantissa}, without quotes; a power of ten needs a point and a sign in yaml, as in 1.0e+0."


def _meant(key: str, known: tuple[str, ...]) -> str:
    """Find the key that was meant: one that starts with the same word (air_k: air_c), or is spelled much the same."""
    word = re.split(r"[_-]", key)[0]
    same = [name for name in known if name.split("_")[0] == word]
    close = difflib.get_close_matches(key, same or known, n=1, cutoff=0.0 if len(same) == 1 else 0.6)
    return close[0] if close else ""


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key that stands twice in one mapping, where yaml forgets the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set[str]()
        for key, _ in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else yaml.serialize(key)
            if name in seen:
                raise yaml.constructor.ConstructorError(None, None, f"the key {name} twice", key.start_mark)
            seen.add(name)
        return super().construct_mapping(node, deep)


Config = TypeVar("Config")

_PATTERNS = ("plenoxels*.yaml", "thermoxels*.yaml")
"""The presets among the files of the folder, which also holds materials and heat scenes."""


def read_preset(name: str) -> dict[str, Any]:
    """Read ``configs/<name>.yaml``, or raise `ThermoxelsError` if there is no such preset or it is not a mapping."""
    path = configs_folder() / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for pattern in _PATTERNS for p in configs_folder().glob(pattern))) or "none"
        raise ThermoxelsError("preset", expected=f"one of {known}", got=name, remedy="Correct the name.")
    return read_yaml(path)


def with_overrides(config: Config, overrides: Mapping[str, Any], name: str = "preset") -> Config:
    """A copy of a (nested) dataclass, or of a dict of such, with some fields replaced; lists replace tuples as tuples.

    Raises `ThermoxelsError` for a name that the configuration does not have, or a value of another kind.
    """
    if isinstance(config, Mapping):
        fields = dict(config)
    elif dataclasses.is_dataclass(config) and not isinstance(config, type):
        fields = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    else:
        raise ThermoxelsError(name, expected="a single value", got="a mapping", remedy="Remove the nested keys.")
    changed = {}
    for key, value in overrides.items():
        if key not in fields:
            expected = f"one of {', '.join(sorted(fields))}"
            raise ThermoxelsError(f"{name}.{key}", expected=expected, got=key, remedy="Correct it.")
        old = fields[key]
        if isinstance(value, Mapping) and (dataclasses.is_dataclass(old) or (isinstance(old, Mapping) and old)):
            changed[key] = with_overrides(old, value, f"{name}.{key}")
        else:
            changed[key] = tuple(value) if isinstance(old, tuple) and isinstance(value, list) else value
    if isinstance(config, Mapping):
        return {**fields, **changed}  # type: ignore[return-value]
    return dataclasses.replace(config, **changed)  # type: ignore[type-var]
