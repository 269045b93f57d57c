"""The table of building materials in ``configs/materials.yaml``; every row says where its figures come from."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from thermoxels_ns.core.configs_folder import configs_folder
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.yaml_records import as_record, read_yaml
from thermoxels_ns.fem.materials import Material


@dataclass(frozen=True)
class MaterialRow:
    """A row of the table: design values for conditions as in a building."""

    conductivity_w_mk: float
    """Thermal conductivity, [W / (m K)], above 0."""
    density_kg_m3: float
    """Mass density, [kg / m3], above 0."""
    specific_heat_j_kgk: float
    """Specific heat capacity, [J / (kg K)], above 0."""
    source: str
    """Where the figures come from."""

    def __post_init__(self) -> None:
        self.named("row")
        if not self.source.strip():
            remedy = "Write where the figures come from."
            raise HeatError("source", expected="a text", got=repr(self.source), remedy=remedy)

    def named(self, name: str) -> Material:
        """Make the material.

        Raises:
            HeatError: A figure is not above 0.
        """
        return Material(name, self.conductivity_w_mk, self.density_kg_m3, self.specific_heat_j_kgk)


def load_material_table(path: Path | str | None = None) -> dict[str, MaterialRow]:
    """Read a table of materials.

    Args:
        path: A yaml file; None: the one that the package brings.

    Returns:
        The rows by name, in the order of the file.

    Raises:
        HeatError: There is no such file, or a row has an unknown or missing key or a figure out of range.
    """
    file = configs_folder() / "materials.yaml" if path is None else Path(path)
    return {name: as_record(f"{file.name}: {name}", row, MaterialRow) for name, row in read_yaml(file).items()}


def material(name: str, table: Mapping[str, MaterialRow] | None = None) -> Material:
    """Look up a building material.

    Args:
        name: A name of the table, such as "concrete".
        table: Other rows than those that the package brings.

    Raises:
        HeatError: The table has no such row.

    >>> material("mineral-wool").conductivity_w_mk
    0.035
    """
    rows = _own_table() if table is None else table
    if name not in rows:
        close = difflib.get_close_matches(str(name), list(rows), n=1, cutoff=0.75)
        remedy = f"Did you mean {close[0]}?" if close else "Correct the name, or give the three figures themselves."
        expected = f"one of {', '.join(rows)}"
        raise HeatError("material", expected=expected, got=repr(name), remedy=remedy)
    return rows[name].named(name)


@lru_cache(maxsize=1)
def _own_table() -> dict[str, MaterialRow]:
    return load_material_table()
