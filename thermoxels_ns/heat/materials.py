"""Materials of bodies, and the table of building materials in ``configs/materials.yaml``."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, TypeAlias, cast

import numpy as np
from pydantic import Field

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.yaml_records import as_record, configs_folder, read_yaml, record
from thermoxels_ns.fem.problem import HeatProblem

Positive: TypeAlias = Annotated[float, Field(gt=0.0)]
Text: TypeAlias = Annotated[str, Field(pattern=r"\S")]


@record(HeatError)
class Material:
    """A uniform, isotropic solid with constant properties.

    >>> f"{Material('concrete', 1.7, 2200.0, 880.0).diffusivity_m2_s:.4e} m2/s"
    '8.7810e-07 m2/s'
    """

    name: Text
    conductivity_w_mk: Positive  # Thermal conductivity, [W / (m K)]
    density_kg_m3: Positive  # Mass density, [kg / m3]
    specific_heat_j_kgk: Positive  # Specific heat capacity, [J / (kg K)]

    @property
    def heat_capacity_j_m3k(self) -> float:
        """Heat that warms a cubic metre by a kelvin, rho c, [J / (m3 K)]."""
        return self.density_kg_m3 * self.specific_heat_j_kgk

    @property
    def diffusivity_m2_s(self) -> float:
        """Thermal diffusivity k / (rho c), [m2 / s]."""
        return self.conductivity_w_mk / self.heat_capacity_j_m3k


@record(HeatError)
class MaterialRow(Material):
    """A row of the table of building materials: design values for conditions in buildings, and their source."""

    source: Text  # Publication from which the values are taken


def with_names(content: Any) -> Any:
    """Return a mapping of materials, read from a file, with each key put into its entry as `name`; else `content`."""
    if not isinstance(content, dict):
        return content
    return {key: {**entry, "name": key} if isinstance(entry, dict) else entry for key, entry in content.items()}


@cache
def material_table() -> dict[str, MaterialRow]:
    """Return the materials of ``configs/materials.yaml`` by name; the file is read only once."""
    file = configs_folder() / "materials.yaml"
    return as_record(file.name, with_names(read_yaml(file)), dict[str, MaterialRow])


def material(name: str) -> Material:
    """Look up a building material by its name in the table; raises `HeatError` if there is no such row.

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


def materials_by_region(problem: HeatProblem) -> dict[str, Material]:
    """Return materials by the names of the regions of a problem; regions without a tetrahedron are left out."""
    names = [problem.mesh.region_names[number] for number in np.unique(problem.mesh.region)]
    made_of = {
        name: problem.material[name] if isinstance(problem.material, Mapping) else problem.material for name in names
    }
    return cast(dict[str, Material], made_of)
