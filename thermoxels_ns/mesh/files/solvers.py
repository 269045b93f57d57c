"""Mesh files for solvers: .xdmf (FEniCSx, ParaView), .msh (Gmsh), and .inp (CalculiX, Abaqus) that runs as it is."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.units import STEFAN_BOLTZMANN_W_M2K4, ZERO_CELSIUS_K
from thermoxels_ns.mesh.files.content import checked_tags, node_arrays, write_bytes
from thermoxels_ns.mesh.quality.checks import facet_owners
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh

BODY_GRID, FACET_GRID = "mesh", "facets"
"""Names of the two grids in .xdmf files, of tetrahedra and of boundary triangles; "mesh" is the default in FEniCSx."""
TEMPERATURE_VIEW = "temperature_c"  # name of the view of nodal temperatures in .msh files, [degrees Celsius]

_NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UChar"}
_LONGEST_GMSH_NAME, _LONGEST_INP_NAME = 127, 60  # [bytes], [characters]
_TRIANGLE, _TETRAHEDRON = 2, 4
_INT, _DOUBLE = np.dtype("<i4"), np.dtype("<f8")
_FACE_OPPOSITE: IntArray = np.array([3, 4, 2, 1], dtype=np.int64)
"""Number in .inp files of the face opposite each node: S1 has the nodes 1 2 3, S2 1 4 2, S3 2 4 3 and S4 3 4 1."""
_ROWS_AT_ONCE = 1 << 15
_REAL = "%.12E"  # Abaqus reads fields of at most 20 characters


def write_xdmf(path: Path | str, mesh: TetMesh) -> None:
    """Write a mesh as an .xdmf file that holds all numbers itself, as text (read by FEniCSx and ParaView).

    The grid "mesh" holds the tetrahedra with `region` per cell, and `temperature_c`, `temperature_k`, `observed` and
    `colour` per node, as far as known; the grid "facets" holds the boundary triangles with `patch` per triangle.
    Regions and patches are numbered from 1, as in .msh files; an ``Information`` element of each grid lists the names.
    In FEniCSx::

        with XDMFFile(comm, "mesh.xdmf", "r", encoding=XDMFFile.Encoding.ASCII) as file:
            mesh = file.read_mesh(name="mesh")
            regions = file.read_meshtags(mesh, name="mesh")
            mesh.topology.create_connectivity(2, 3)
            patches = file.read_meshtags(mesh, name="facets")
    """
    path, tags, points = Path(path), checked_tags(mesh), mesh.points_m
    # FEniCSx reads the first attribute of a grid as its tags.
    body = {"region": (mesh.region + 1).astype(np.int32), **node_arrays(mesh)}
    boundary = {"patch": (tags.patch + 1).astype(np.int32)}
    text = chain(
        ["<?xml version='1.0' encoding='utf-8'?>\n<Xdmf Version=\"3.0\">\n<Domain>\n"],
        _grid(f'Name="{BODY_GRID}"', "Tetrahedron", mesh.tets, points, body, mesh.region_names),
        _grid(f'Name="{FACET_GRID}"', "Triangle", mesh.facets, points, boundary, tags.patch_names),
        ["</Domain>\n</Xdmf>\n"],
    )
    write_bytes(path, (part.encode() for part in text))


def _grid(
    name: str, kind: str, cells: IntArray, points: FloatArray, arrays: dict[str, npt.NDArray], names: Sequence[str]
) -> Iterator[str]:
    """Yield the text of a grid; `arrays` begin with an array per cell, whose numbers from 1 have `names`."""
    tag, *_ = arrays
    numbered = quoteattr("; ".join(f"{number} = {entry}" for number, entry in enumerate(names, 1)))
    yield f'<Grid {name} GridType="Uniform">\n<Information Name="{tag}_names" Value={numbered}/>\n'
    size = 'NumberOfElements="{}" NodesPerElement="{}"'.format(*cells.shape)
    yield from _element("Topology", f'TopologyType="{kind}" {size}', cells)
    yield from _element("Geometry", 'GeometryType="XYZ"', points)
    for of, values in arrays.items():
        where = (
            f'Center="{"Cell" if of == tag else "Node"}" AttributeType="{"Vector" if values.ndim == 2 else "Scalar"}"'
        )
        yield from _element("Attribute", f'Name="{of}" {where}', values)
    yield "</Grid>\n"


def _element(name: str, attributes: str, values: npt.NDArray) -> Iterator[str]:
    """Yield the text of an element of an .xdmf file that holds numbers, shape (n,) or (n, k)."""
    size, kind = " ".join(map(str, values.shape)), _NUMBER_TYPES[values.dtype.kind]
    precision = f'NumberType="{kind}" Precision="{values.dtype.itemsize}"'
    yield f'<{name} {attributes}><DataItem Format="XML" Dimensions="{size}" {precision}>\n'
    columns = values.reshape(len(values), -1).T
    yield from _rows(" ".join(["%r"] * len(columns)) + "\n", *columns)
    yield f"</DataItem></{name}>\n"


def write_msh(path: Path | str, mesh: TetMesh) -> None:
    """Write a mesh as a Gmsh file, MSH 2.2, binary, with one physical group per region and per patch.

    Regions become physical volumes and patches physical surfaces, numbered from 1; empty regions and patches are left
    out. Nodal temperatures become a view, `TEMPERATURE_VIEW`. Node k and tetrahedron k of the mesh get the number
    k + 1, and the boundary triangles follow. Layout: "MSH file format version 2", Gmsh reference manual; other than
    version 4 it sorts no nodes by surfaces and volumes. meshio cannot write a patch named like a region.

    Raises:
        MeshError: A name is too long for Gmsh, or what `TetMesh.check` raises.
    """
    path = Path(path)
    tags = checked_tags(mesh)
    for name in (*mesh.region_names, *tags.patch_names):
        if len(name.encode()) > _LONGEST_GMSH_NAME:
            expected = f"at most {_LONGEST_GMSH_NAME} bytes, which is what Gmsh reads"
            got = f"{len(name.encode())} bytes: {name!r}"
            raise MeshError("name of a region or patch", expected=expected, got=got, remedy="Rename it.")
    names = [f'2 {number + 1} "{tags.patch_names[number]}"' for number in np.unique(tags.patch).tolist()]
    names += [f'3 {number + 1} "{mesh.region_names[number]}"' for number in np.unique(mesh.region).tolist()]
    nodes, points = len(mesh.points_m), ("point", _DOUBLE, 3)
    sections = {
        b"MeshFormat": b"2.2 1 8\n" + np.array(1, _INT).tobytes(),
        b"PhysicalNames": "\n".join([str(len(names)), *names]).encode(),
        b"Nodes": f"{nodes}\n".encode() + _numbered(1, points, mesh.points_m),
        b"Elements": f"{len(mesh.tets) + len(mesh.facets)}\n".encode()
        + _elements(_TRIANGLE, 1 + len(mesh.tets), mesh.facets, tags.patch)
        + _elements(_TETRAHEDRON, 1, mesh.tets, mesh.region),
    }
    if mesh.has_temperatures:
        # The entries are name, time 0, step 0, number of components and number of nodes.
        head = f'1\n"{TEMPERATURE_VIEW}"\n1\n0.0\n3\n0\n1\n{nodes}\n'
        sections[b"NodeData"] = head.encode() + _numbered(1, ("value", _DOUBLE), mesh.temperature_c)
    write_bytes(path, (b"$%b\n%b\n$End%b\n" % (name, text, name) for name, text in sections.items()))


def _numbered(first: int, field: tuple, values: npt.NDArray) -> bytes:
    """Return the rows of `values`, each behind its number, as bytes; numbers rise from `first`."""
    table = np.empty(len(values), dtype=[("number", _INT), field])
    table["number"], table[field[0]] = np.arange(first, first + len(values)), values
    return table.tobytes()


def _elements(kind: int, first: int, cells: IntArray, group: IntArray) -> bytes:
    """Return elements of one kind as bytes; `group` is their physical group and their geometrical entity."""
    if not len(cells):
        return b""
    rows = np.column_stack([group, group, cells]) + 1
    return np.array([kind, len(cells), 2], _INT).tobytes() + _numbered(first, ("row", _INT, rows.shape[1]), rows)


@dataclass(frozen=True)
class HeatStep:
    """Heat conduction for an .inp file to compute: a body of one material, insulated all round, in equal time steps."""

    conductivity_w_mk: float  # Thermal conductivity, [W / (m K)], above 0
    density_kg_m3: float  # Mass density, [kg / m3], above 0
    specific_heat_j_kgk: float  # Specific heat capacity, [J / (kg K)], above 0
    steps: int  # Number of steps, at least 1
    step_seconds: float  # Length of a step, [s], above 0


def write_inp(path: Path | str, mesh: TetMesh, heat_step: HeatStep) -> None:
    """Write a mesh as an input file of CalculiX and Abaqus that runs as it is: ``ccx NAME`` for ``NAME.inp``.

    Units are metres, kilograms, seconds and degrees Celsius; node k and tetrahedron k get the number k + 1. Contents:

    - ``NALL`` and ``EALL``: all nodes and all elements, of type DC3D4, which CalculiX reads as C3D4.
    - ``REGION-<name>``: elements of a region; ``MATERIAL-<name>``: its material, the same for all regions.
    - ``PATCH-<name>``: nodes of a boundary patch, and a surface of the same name that holds its element faces.
    - Initial temperatures, and a heat transfer step without boundary conditions that prints temperatures (``NT``).

    Names are in capitals, and other characters than letters, digits and underscores become underscores. Empty regions
    and patches are left out, because an empty set stops a solver. Raises `MeshError` if the mesh has no temperatures.
    """
    path = Path(path)
    tags = checked_tags(mesh)
    check_start(mesh)
    regions = _set_names("region_names", mesh.region_names)
    patches = _set_names("boundary.patch_names", tags.patch_names)
    # What can fail on a bad mesh is done before the file is opened.
    owner, opposite = facet_owners(mesh.tets, mesh.facets)
    writable_folder(path.parent)
    with replace_when_done(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as file:
        file.write("*HEADING\nTetrahedral mesh with measured temperatures; metres, seconds, degrees Celsius\n")
        file.writelines(_nodes_and_elements(mesh, regions))
        file.writelines(_surfaces(mesh, tags, patches, owner, _FACE_OPPOSITE[opposite]))
        file.writelines(_materials([name for name, _ in _sets(mesh.region, regions)], heat_step))
        file.write("*INITIAL CONDITIONS, TYPE=TEMPERATURE\n")
        numbers_from_1 = np.arange(1, len(mesh.points_m) + 1)
        file.writelines(_rows(f"%d, {_REAL}\n", numbers_from_1, mesh.temperature_c))
        # For equal steps, the shortest and the longest step that the solver may take are the length asked for.
        length, total = _REAL % heat_step.step_seconds, _REAL % (heat_step.steps * heat_step.step_seconds)
        file.write(f"*STEP, INC={heat_step.steps}\n*HEAT TRANSFER\n{length}, {total}, {length}, {length}\n")
        file.write("*NODE PRINT, NSET=NALL\nNT\n*NODE FILE\nNT\n*END STEP\n")


def check_start(mesh: TetMesh) -> None:
    """Raise `MeshError` if a mesh has no temperatures, with which a computation by an .inp file starts."""
    if not mesh.has_temperatures:
        remedy = "Pass --heat-preset a yaml file with initial: {temperature_c: 15}, or leave inp out of --formats."
        raise MeshError("mesh for .inp", expected="temperatures at the start", got="none", remedy=remedy)


def _set_names(name: str, names: Sequence[str]) -> list[str]:
    """Return the names as .inp files can hold them; raise `MeshError` if two become equal or one is too long."""
    written = [re.sub(r"[^A-Za-z0-9_]+", "_", entry).upper() for entry in names]
    if len(set(written)) != len(written) or max(map(len, written)) > _LONGEST_INP_NAME:
        expected = "names that differ in their letters and digits (capitals or not), "
        expected += f"of at most {_LONGEST_INP_NAME} characters, as .inp files ask for"
        raise MeshError(name, expected=expected, got=list(names), remedy="Rename them.")
    return written


def _sets(index: IntArray, names: Sequence[str]) -> Iterator[tuple[str, IntArray]]:
    """Yield each used name and its members, rising; `index` has the number of each element's patch or region."""
    for number, name in enumerate(names):
        members = np.flatnonzero(index == number)
        if len(members):
            yield name, members


def _rows(row: str, *columns: npt.NDArray) -> Iterator[str]:
    """Yield the text of a table in chunks of many rows, which Python formats much faster than single rows."""
    for start in range(0, len(columns[0]), _ROWS_AT_ONCE):
        chunk = [column[start : start + _ROWS_AT_ONCE].tolist() for column in columns]
        yield row * len(chunk[0]) % tuple(chain.from_iterable(zip(*chunk)))


def _nodes_and_elements(mesh: TetMesh, regions: Sequence[str]) -> Iterator[str]:
    yield "*NODE, NSET=NALL\n"
    yield from _rows(f"%d, {_REAL}, {_REAL}, {_REAL}\n", np.arange(1, len(mesh.points_m) + 1), *mesh.points_m.T)
    used = list(_sets(mesh.region, regions))
    for name, members in used:
        yield f"*ELEMENT, TYPE=DC3D4, ELSET=REGION-{name}\n"
        yield from _rows("%d, %d, %d, %d, %d\n", members + 1, *(mesh.tets[members] + 1).T)
    yield "*ELSET, ELSET=EALL\n"
    yield "".join(f"REGION-{name}\n" for name, _ in used)


def _surfaces(mesh: TetMesh, tags: Boundary, patches: Sequence[str], owner: IntArray, face: IntArray) -> Iterator[str]:
    for name, members in _sets(tags.patch, patches):
        yield f"*NSET, NSET=PATCH-{name}\n"
        yield from _rows("%d\n", np.unique(mesh.facets[members]) + 1)
        yield f"*SURFACE, NAME=PATCH-{name}, TYPE=ELEMENT\n"
        yield from _rows("%d, S%d\n", owner[members] + 1, face[members])


def _materials(used: Sequence[str], step: HeatStep) -> Iterator[str]:
    yield f"*PHYSICAL CONSTANTS, ABSOLUTE ZERO={-ZERO_CELSIUS_K}, STEFAN BOLTZMANN={STEFAN_BOLTZMANN_W_M2K4:.9E}\n"
    for name in used:
        yield f"*MATERIAL, NAME=MATERIAL-{name}\n"
        yield f"*DENSITY\n{_REAL}\n" % step.density_kg_m3
        yield f"*CONDUCTIVITY\n{_REAL}\n" % step.conductivity_w_mk
        yield f"*SPECIFIC HEAT\n{_REAL}\n" % step.specific_heat_j_kgk
    for name in used:
        yield f"*SOLID SECTION, ELSET=REGION-{name}, MATERIAL=MATERIAL-{name}\n"
