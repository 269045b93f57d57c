"""Options of the command line: their texts as paragraphs for ``--help``, and which of them were typed."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import textwrap
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

_PACKAGE = __name__.partition(".")[0]


def join_help_lines(*configs: Any) -> None:
    """Hand tyro the strings below fields with the lines of each paragraph joined; calling it again changes nothing.

    Of dataclasses, what they inherit from this package counts too; of instances also what their fields hold, as far as
    it is of this package. The texts of others stay as they are.
    """
    for kind in {kind: None for config in configs for kind in _dataclasses_in(config)}:
        texts = _texts_below_fields(kind)
        for field in dataclasses.fields(kind):
            if field.name in texts:
                # Where tyro looks first. Fields are shared with the classes that inherit them.
                field.metadata = MappingProxyType({**field.metadata, "help": joined_lines(texts[field.name])})


def typed(option: str) -> bool:
    """Whether this process was started with an option, or with one whose name goes on after it."""
    start = option.replace("_", "-")
    return any(word.replace("_", "-").startswith(start) for word in sys.argv[1:])


def typed_value(option: str) -> str | None:
    """Return the value that this process was started with for an option, the last one; None where it was not typed."""
    found = None
    for word, following in zip(sys.argv[1:], [*sys.argv[2:], None]):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == option:
            found = value if equals else following
    return found


def joined_lines(text: str) -> str:
    r"""Join the lines of each paragraph; empty lines stay between paragraphs.

    >>> joined_lines("One of\n    (two,\n    3).\n\n    Else none.")
    'One of (two, 3).\n\nElse none.'
    """
    paragraphs = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def _dataclasses_in(config: Any) -> Iterator[type]:
    """Dataclasses that tyro takes options from and whose texts are joined."""
    if isinstance(config, type):
        yield config
        yield from filter(_is_ours, config.__mro__)
    elif isinstance(config, Mapping):
        for value in config.values():
            yield from _dataclasses_in(value)
    elif dataclasses.is_dataclass(config):
        yield from filter(_is_ours, type(config).__mro__)
        values = (getattr(config, field.name, None) for field in dataclasses.fields(config))
        for value in values:
            if not isinstance(value, type):
                yield from _dataclasses_in(value)


def _is_ours(kind: type) -> bool:
    return dataclasses.is_dataclass(kind) and kind.__module__.partition(".")[0] == _PACKAGE


def _texts_below_fields(kind: type) -> dict[str, str]:
    """The strings below fields in the body of a class, by the field's name."""
    try:
        source = inspect.getsource(kind)
    except OSError:  # a program that was delivered without its source has no texts to show
        return {}
    (declared,) = ast.parse(textwrap.dedent(source)).body
    assert isinstance(declared, ast.ClassDef)
    texts = {}
    for field, below in zip(declared.body, declared.body[1:]):
        if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
            continue
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str):
            texts[field.target.id] = below.value.value
    return texts
