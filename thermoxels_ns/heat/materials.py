"""Materials of bodies, and the table of building materials in ``configs/materials.yaml``."""

from __future__ import annotations

import difflib
from functools import cache
from typing import Any

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.yaml_records import as_record, configs_folder, read_yaml, record
from thermoxels_ns.fem.problem import Material, Text


@record(HeatError)
class MaterialRow(Material):
    """A row of the table of building materials: design values for use in buildings, and their source."""

    source: Text  # Publication from which the values are taken


def with_names(content: Any) -> Any:
    """Return a mapping of materials with each key copied into its entry as `name`; return other content unchanged."""
    if not isinstance(content, dict):
        return content
    return {key: {**entry, "name": key} if isinstance(entry, dict) else entry for key, entry in content.items()}


@cache
def material_table() -> dict[str, MaterialRow]:
    """Return the materials of ``configs/materials.yaml`` by name; the file is read only once."""
    file = configs_folder() / "materials.yaml"
    return as_record(file.name, with_names(read_yaml(file)), dict[str, MaterialRow])


def material(name: str) -> Material:
    """Return the building material of this name from the table; raise `HeatError` if the table lacks it.

    >>> material("mineral-wool").conductivity_w_mk
    0.035
    """
    rows = material_table()
    if name not in rows:
        close = difflib.get_close_matches(str(name), list(rows), n=1, cutoff=0.75)
        remedy = f"Did you mean {close[0]}?" if close else "Correct the name, or give the three figures themselves."
        expected = f"one of {', '.join(rows)}"
        raise HeatError("material", expected=expected, got=repr(name), remedy=remedy)
    row = rows[name]
    return Material(name, row.conductivity_w_mk, row.density_kg_m3, row.specific_heat_j_kgk)
