"""Meshes as input files of CalculiX and Abaqus, with a heat transfer step that runs."""

from __future__ import annotations

import numbers
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, IntArray
from thermoxels_ns.core.checks import check_positive, replace_when_done, writable_folder
from thermoxels_ns.core.errors import HeatError, MeshError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.mesh.files.content import FileContent, check_suffix, file_content
from thermoxels_ns.mesh.quality.checks import facet_area_vectors, facet_owners
from thermoxels_ns.mesh.tetrahedra import TetMesh

STEFAN_BOLTZMANN_W_M2K4 = 5.670374419e-8
"""Stefan-Boltzmann constant (CODATA 2018, exact to the digits given), [W / (m2 K4)]."""

_FACE_OPPOSITE: IntArray = np.array([3, 4, 2, 1], dtype=np.int64)
"""Number of the face opposite each node: S1 has the nodes 1 2 3, S2 1 4 2, S3 2 4 3 and S4 3 4 1."""

_LONGEST_NAME = 60
_NUMBERS_PER_LINE = 16
_CHUNK = 1 << 15
# Fields are at most 20 characters.
_REAL = "%.12E"


@dataclass(frozen=True)
class HeatStep:
    """Conduction in a body of one material, insulated all round, in equal steps of time."""

    conductivity_w_mk: float  # Thermal conductivity, [W / (m K)], above 0
    density_kg_m3: float  # Mass density, [kg / m3], above 0
    specific_heat_j_kgk: float  # Specific heat capacity, [J / (kg K)], above 0
    steps: int  # Number of steps, at least 1
    step_seconds: float  # Length of a step, [s], above 0

    def __post_init__(self) -> None:
        for field in ("conductivity_w_mk", "density_kg_m3", "specific_heat_j_kgk", "step_seconds"):
            remedy = "Give it in the unit that its name ends in."
            object.__setattr__(self, field, check_positive(field, getattr(self, field), remedy, HeatError))
        whole = isinstance(self.steps, numbers.Integral) and not isinstance(self.steps, bool)
        if not whole or self.steps < 1:
            expected = "a whole number of at least 1"
            raise HeatError("steps", expected=expected, got=repr(self.steps), remedy="Pass 10, for example.")


def write_inp(path: Path | str, mesh: TetMesh, heat_step: HeatStep | None) -> None:
    """Write a mesh as an input file of CalculiX and Abaqus that runs as it is: ``ccx NAME`` for ``NAME.inp``.

    Metres, kilograms, seconds, degrees Celsius. Node and tetrahedron k have the number k + 1. In the file:

    - ``NALL`` and ``EALL``: all nodes and all elements, of type DC3D4, which CalculiX takes for C3D4.
    - ``REGION-<name>``: elements of a region; ``MATERIAL-<name>``: its material, the same for all regions.
    - ``PATCH-<name>``: nodes of a boundary patch, and under the same name its element faces as a surface. Before it, a
      comment says by what ratio to multiply film coefficients, emissivities and fluxes in voxel meshes.
    - ``OBSERVED``: the nodes whose temperature was measured, if there are any.
    - Initial temperatures, and a heat transfer step without boundary conditions that prints temperatures (``NT``).

    Names are in capitals; what is neither letter, digit nor underscore becomes an underscore. Empty regions and
    patches are left out, because an empty set stops a solver.
    """
    path = check_suffix(path, ".inp")
    if heat_step is None:
        expected = "material and times, which an .inp file runs with"
        remedy = "Pass heat_step=HeatStep(...), or choose another format."
        raise MeshError("heat_step", expected=expected, got=None, remedy=remedy)
    content = file_content(mesh)
    regions = _set_names("region_names", content.region_names)
    patches = _set_names("boundary.patch_names", content.patch_names)
    # All that can fail on a bad mesh comes before the file is opened.
    owner, opposite = facet_owners(content.tets, content.facets)
    writable_folder(path.parent)
    with replace_when_done(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as file:
        file.write("*HEADING\nTetrahedral mesh with measured temperatures; metres, seconds, degrees Celsius\n")
        file.writelines(_nodes_and_elements(content, mesh.observed, regions))
        file.writelines(_surfaces(content, patches, owner, _FACE_OPPOSITE[opposite]))
        file.writelines(_materials(content, regions, heat_step))
        file.write("*INITIAL CONDITIONS, TYPE=TEMPERATURE\n")
        numbers_from_1 = np.arange(1, len(content.points_m) + 1)
        file.writelines(_rows(f"%d, {_REAL}\n", numbers_from_1, content.temperature_c))
        # Equal steps: the shortest and the longest that the solver may take are the one asked for.
        length, total = _REAL % heat_step.step_seconds, _REAL % (heat_step.steps * heat_step.step_seconds)
        file.write(f"*STEP, INC={heat_step.steps}\n*HEAT TRANSFER\n{length}, {total}, {length}, {length}\n")
        file.write("*NODE PRINT, NSET=NALL\nNT\n*NODE FILE\nNT\n*END STEP\n")


def _set_names(name: str, names: Sequence[str]) -> list[str]:
    """Names that every reader of .inp files takes."""
    written = [re.sub(r"[^A-Za-z0-9_]+", "_", entry).upper() for entry in names]
    if len(set(written)) != len(written) or max(map(len, written)) > _LONGEST_NAME:
        expected = "names that differ in their letters and digits (capitals or not), "
        expected += f"of at most {_LONGEST_NAME} characters, as .inp files ask for"
        raise MeshError(name, expected=expected, got=list(names), remedy="Rename them.")
    return written


def _sets(index: IntArray, names: Sequence[str]) -> Iterator[tuple[str, IntArray]]:
    """Yield name and members, rising, of every patch or region that is not empty."""
    for number, name in enumerate(names):
        members = np.flatnonzero(index == number)
        if len(members):
            yield name, members


def _rows(row: str, *columns: npt.NDArray) -> Iterator[str]:
    """Text of a table, in chunks: Python formats many rows at once much faster than one by one."""
    for start in range(0, len(columns[0]), _CHUNK):
        chunk = [column[start : start + _CHUNK].tolist() for column in columns]
        yield row * len(chunk[0]) % tuple(chain.from_iterable(zip(*chunk)))


def _number_lines(values: IntArray) -> Iterator[str]:
    """Numbers of a set, 16 per line."""
    full = len(values) // _NUMBERS_PER_LINE * _NUMBERS_PER_LINE
    table = values[:full].reshape(-1, _NUMBERS_PER_LINE)
    yield from _rows(", ".join(["%d"] * _NUMBERS_PER_LINE) + "\n", *table.T)
    if full < len(values):
        yield ", ".join(map(str, values[full:].tolist())) + "\n"


def _nodes_and_elements(content: FileContent, observed: BoolArray, regions: Sequence[str]) -> Iterator[str]:
    yield "*NODE, NSET=NALL\n"
    yield from _rows(f"%d, {_REAL}, {_REAL}, {_REAL}\n", np.arange(1, len(content.points_m) + 1), *content.points_m.T)
    used = list(_sets(content.region, regions))
    for name, members in used:
        yield f"*ELEMENT, TYPE=DC3D4, ELSET=REGION-{name}\n"
        yield from _rows("%d, %d, %d, %d, %d\n", members + 1, *(content.tets[members] + 1).T)
    yield "*ELSET, ELSET=EALL\n"
    yield "".join(f"REGION-{name}\n" for name, _ in used)
    if observed.any():
        yield "*NSET, NSET=OBSERVED\n"
        yield from _number_lines(np.flatnonzero(observed) + 1)


def _surfaces(content: FileContent, patches: Sequence[str], owner: IntArray, face: IntArray) -> Iterator[str]:
    areas = np.linalg.norm(facet_area_vectors(content.points_m, content.facets), axis=1)
    for name, members in _sets(content.patch, patches):
        mesh_m2 = float(areas[members].sum())
        true_m2 = float((areas[members] * content.area_factor[members]).sum())
        yield f"** PATCH-{name}: true area {true_m2:.9g} m2, area of its triangles {mesh_m2:.9g} m2\n"
        yield f"** Multiply film coefficients, emissivities and fluxes on PATCH-{name} by {true_m2 / mesh_m2:.9g}\n"
        yield f"*NSET, NSET=PATCH-{name}\n"
        yield from _number_lines(np.unique(content.facets[members]) + 1)
        yield f"*SURFACE, NAME=PATCH-{name}, TYPE=ELEMENT\n"
        yield from _rows("%d, S%d\n", owner[members] + 1, face[members])


def _materials(content: FileContent, regions: Sequence[str], step: HeatStep) -> Iterator[str]:
    used = [name for name, _ in _sets(content.region, regions)]
    yield f"*PHYSICAL CONSTANTS, ABSOLUTE ZERO={-ZERO_CELSIUS_K}, STEFAN BOLTZMANN={STEFAN_BOLTZMANN_W_M2K4:.9E}\n"
    for name in used:
        yield f"*MATERIAL, NAME=MATERIAL-{name}\n"
        yield f"*DENSITY\n{_REAL}\n" % step.density_kg_m3
        yield f"*CONDUCTIVITY\n{_REAL}\n" % step.conductivity_w_mk
        yield f"*SPECIFIC HEAT\n{_REAL}\n" % step.specific_heat_j_kgk
    for name in used:
        yield f"*SOLID SECTION, ELSET=REGION-{name}, MATERIAL=MATERIAL-{name}\n"
