"""Results as tables: lists of rows, each row a dictionary from column name to plain value; also as pandas frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any

from thermoxels_ns.core.errors import ThermoxelsError


class HasTables(ABC):
    """Base of results that have named tables; the first table is "patches"."""

    @abstractmethod
    def tables(self) -> Mapping[str, list[dict[str, Any]]]:
        """Return all tables by name; a table is a list of rows, a row a dictionary from column name to plain value."""

    def to_frame(self, table: str = "patches") -> Any:
        """Return a table as a pandas DataFrame; raise `ThermoxelsError` if the name is unknown or pandas is missing."""
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
    """Return one row of a table, a dictionary from column name to value, for each dataclass instance in `records`.

    If a field holds a dataclass or a mapping, each of its entries becomes a column ``field_entry``. An entry ``value``,
    as an interval has, becomes the column ``field``.
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
