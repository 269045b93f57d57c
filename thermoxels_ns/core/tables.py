"""Results as tables: a dictionary of plain values for each line, or a pandas frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any

from thermoxels_ns.core.errors import ThermoxelsError


class HasTables(ABC):
    """Results with tables by name; the first is "patches"."""

    @abstractmethod
    def tables(self) -> Mapping[str, list[dict[str, Any]]]:
        """Return all tables by name; a table is a list of lines, a line a dictionary from column to plain value."""

    def to_frame(self, table: str = "patches") -> Any:
        """Return a table as a pandas DataFrame; raise `ThermoxelsError` without such a table, or without pandas."""
        tables = self.tables()
        if table not in tables:
            expected = f"one of {', '.join(tables)}"
            raise ThermoxelsError("table", expected=expected, got=repr(table), remedy="Correct the name.")
        try:
            pandas = import_module("pandas")  # no dependency: it is large, and few need it
        except ImportError as problem:
            remedy = f"Run pip install pandas, or take tables()[{table!r}], the same as a list of dictionaries."
            raise ThermoxelsError("pandas", expected="an installed package", got="none", remedy=remedy) from problem
        return pandas.DataFrame(tables[table])


def lines_of(records: Iterable[object]) -> list[dict[str, Any]]:
    """Return each dataclass as a line of a table; what lies in a dataclass or mapping in it gets the name of its field.

    A field `value` of such a dataclass, as an interval has, becomes the column of the field itself.
    """
    return [dict(_columns(record, "")) for record in records]


def _columns(record: Any, before: str) -> Iterable[tuple[str, Any]]:
    entries = (
        record if isinstance(record, Mapping) else {each.name: getattr(record, each.name) for each in fields(record)}
    )
    for name, value in entries.items():
        column = before[:-1] if before and name == "value" else before + name
        if is_dataclass(value) or isinstance(value, Mapping):
            yield from _columns(value, f"{column}_")
        else:
            yield column, value
