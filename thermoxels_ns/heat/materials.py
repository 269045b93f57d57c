"""What a body is made of, and the table of building materials in ``configs/materials.yaml``."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

import numpy as np

from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.yaml_records import as_record, configs_folder, raising, read_yaml
from thermoxels_ns.fem.problem import HeatProblem


@dataclass(frozen=True)
class Material:
    """A uniform, isotropic solid with constant properties.

    >>> f"{Material('concrete', 1.7, 2200.0, 880.0).diffusivity_m2_s:.4e} m2/s"
    '8.7810e-07 m2/s'
    """

    name: str
    conductivity_w_mk: float  # Thermal conductivity, [W / (m K)], above 0
    density_kg_m3: float  # Mass density, [kg / m3], above 0
    specific_heat_j_kgk: float  # Specific heat capacity, [J / (kg K)], above 0

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name.strip()):
            raise HeatError("material name", expected="a name", got=repr(self.name), remedy="Give the material a name.")
        for field, unit in (
            ("conductivity_w_mk", "W/(m K)"),
            ("density_kg_m3", "kg/m3"),
            ("specific_heat_j_kgk", "J/(kg K)"),
        ):
            remedy = f"Give {self.name} a value in {unit}."
            object.__setattr__(self, field, check_positive(field, getattr(self, field), remedy, HeatError))

    @property
    def heat_capacity_j_m3k(self) -> float:
        """Heat that warms a cubic metre by a kelvin, rho c, [J / (m3 K)]."""
        return self.density_kg_m3 * self.specific_heat_j_kgk

    @property
    def diffusivity_m2_s(self) -> float:
        """Thermal diffusivity k / (rho c), [m2 / s]."""
        return self.conductivity_w_mk / self.heat_capacity_j_m3k


@dataclass(frozen=True)
class MaterialFigures:
    """A material in a file, whose name is the key before it; fields as in `Material`."""

    conductivity_w_mk: float
    density_kg_m3: float
    specific_heat_j_kgk: float

    def __post_init__(self) -> None:
        self.named("it")

    def named(self, name: str) -> Material:
        """Make the material."""
        return Material(name, self.conductivity_w_mk, self.density_kg_m3, self.specific_heat_j_kgk)


@dataclass(frozen=True)
class MaterialRow(MaterialFigures):
    """A row of the table: design values for conditions as in a building, and where they come from."""

    source: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.source.strip():
            remedy = "Write where the figures come from."
            raise HeatError("source", expected="a text", got=repr(self.source), remedy=remedy)


@raising(HeatError)
def load_material_table(path: Path | str | None = None) -> dict[str, MaterialRow]:
    """Read the rows of a yaml file of materials by name, None: of our own; raises `HeatError` for a wrong one."""
    file = configs_folder() / "materials.yaml" if path is None else Path(path)
    return {name: as_record(f"{file.name}: {name}", row, MaterialRow) for name, row in read_yaml(file).items()}


def material(name: str, table: Mapping[str, MaterialRow] | None = None) -> Material:
    """Look up a building material by its name in a table, None: our own; raises `HeatError` if there is no such row.

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


def materials_by_region(problem: HeatProblem) -> dict[str, Material]:
    """Give the materials of a problem by the names of its regions that have a tetrahedron."""
    names = [problem.mesh.region_names[number] for number in np.unique(problem.mesh.region)]
    made_of = {
        name: problem.material[name] if isinstance(problem.material, Mapping) else problem.material for name in names
    }
    return cast(dict[str, Material], made_of)


@lru_cache(maxsize=1)
def _own_table() -> dict[str, MaterialRow]:
    return load_material_table()
