"""Mesh files for solvers: .xdmf (FEniCSx, ParaView), .msh (Gmsh), and .inp (CalculiX, Abaqus) that runs as it is."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import remove_file, replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError, OutputError
from thermoxels_ns.core.units import STEFAN_BOLTZMANN_W_M2K4, ZERO_CELSIUS_K
from thermoxels_ns.mesh.files.content import checked_tags, node_arrays
from thermoxels_ns.mesh.quality.checks import facet_owners
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh, facet_areas

BODY_GRID, FACET_GRID = "mesh", "facets"
"""Names of the two grids in .xdmf files, of tetrahedra and of boundary triangles; "mesh" is the default in FEniCSx."""
TEMPERATURE_VIEW = "temperature_c"  # name of the view of nodal temperatures in .msh files, [degrees Celsius]

_NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UChar"}
_LONGEST_GMSH_NAME, _LONGEST_INP_NAME = 127, 60  # [bytes], [characters]
_TRIANGLE, _TETRAHEDRON = 2, 4
_SIZE, _INT, _DOUBLE = np.dtype("<u8"), np.dtype("<i4"), np.dtype("<f8")
_FACE_OPPOSITE: IntArray = np.array([3, 4, 2, 1], dtype=np.int64)
"""Number in .inp files of the face opposite each node: S1 has the nodes 1 2 3, S2 1 4 2, S3 2 4 3 and S4 3 4 1."""
_ROWS_AT_ONCE = 1 << 15
_REAL = "%.12E"  # Abaqus reads fields of at most 20 characters


def heavy_data_path(path: Path | str) -> Path:
    """Return the path of the HDF5 file that belongs to an .xdmf file.

    >>> heavy_data_path("house/mesh.xdmf").as_posix()
    'house/mesh.h5'
    """
    return Path(path).with_suffix(".h5")


def write_xdmf(path: Path | str, mesh: TetMesh) -> None:
    """Write a mesh as ``NAME.xdmf`` and ``NAME.h5``.

    The grid "mesh" holds the tetrahedra with `region` per cell; the grid "facets" holds the boundary triangles with
    `patch` per triangle. Both hold `temperature_c`, `temperature_k`, `observed` and, if the mesh has colours, `colour`
    per node. Regions and patches are numbered from 1, as in .msh files; an ``Information`` element of each grid lists
    the names. In FEniCSx::

        with dolfinx.io.XDMFFile(comm, "mesh.xdmf", "r") as file:
            mesh = file.read_mesh(name="mesh")
            regions = file.read_meshtags(mesh, name="mesh")
            mesh.topology.create_connectivity(2, 3)
            patches = file.read_meshtags(mesh, name="facets")

    The .h5 is written first; there is no .xdmf until it is complete. Raises `OutputError` if `path` ends in .h5.
    """
    import h5py

    path = Path(path)
    if path == heavy_data_path(path):
        remedy = "Name the .xdmf; the .h5 beside it is written with it."
        raise OutputError(str(path), expected="a name that ends in .xdmf", got=path.suffix, remedy=remedy)
    tags = checked_tags(mesh)
    arrays: dict[str, npt.NDArray] = {
        "points_m": mesh.points_m,
        "tets": mesh.tets.astype(np.int64),
        "region": (mesh.region + 1).astype(np.int32),
        "facets": mesh.facets.astype(np.int64),
        "patch": (tags.patch + 1).astype(np.int32),
        **node_arrays(mesh),
    }
    data_file = heavy_data_path(path)
    text = _index(mesh.region_names, tags.patch_names, arrays, data_file.name)

    writable_folder(path.parent)
    with replace_when_done(data_file) as temporary:
        with h5py.File(temporary, "w") as file:
            for name, values in arrays.items():
                # Times of day would make two files of one mesh differ.
                file.create_dataset(name, data=values, track_times=False)
        # An old .xdmf does not fit the new data.
        remove_file(path)
    with replace_when_done(path) as temporary:
        temporary.write_bytes(text)


def _index(regions: Sequence[str], patches: Sequence[str], arrays: dict[str, npt.NDArray], data_file: str) -> bytes:
    """Return the text of the .xdmf file, which describes the arrays in `data_file`."""
    add = ElementTree.SubElement
    root = ElementTree.Element("Xdmf", Version="3.0")
    domain = add(root, "Domain")

    def add_data(parent: ElementTree.Element, name: str) -> None:
        shape, number = arrays[name].shape, arrays[name].dtype
        size, kind, width = " ".join(map(str, shape)), _NUMBER_TYPES[number.kind], str(number.itemsize)
        item = add(parent, "DataItem", Format="HDF", Dimensions=size, NumberType=kind, Precision=width)
        item.text = f"{data_file}:/{name}"

    def add_grid(name: str, cells: str, kind: str, names_of: str, names: Sequence[str]) -> ElementTree.Element:
        grid = add(domain, "Grid", Name=name, GridType="Uniform")
        numbered = "; ".join(f"{number} = {entry}" for number, entry in enumerate(names, 1))
        add(grid, "Information", Name=names_of, Value=numbered)
        count, per_cell = map(str, arrays[cells].shape)
        topology = add(grid, "Topology", TopologyType=kind, NumberOfElements=count, NodesPerElement=per_cell)
        add_data(topology, cells)
        add_data(add(grid, "Geometry", GeometryType="XYZ"), "points_m")
        return grid

    def add_values(grid: ElementTree.Element, name: str, centre: str, kind: str = "Scalar") -> None:
        add_data(add(grid, "Attribute", Name=name, AttributeType=kind, Center=centre), name)

    body = add_grid(BODY_GRID, "tets", "Tetrahedron", "region_names", regions)
    boundary = add_grid(FACET_GRID, "facets", "Triangle", "patch_names", patches)
    # FEniCSx reads the first attribute of a grid as its tags.
    add_values(body, "region", "Cell")
    add_values(boundary, "patch", "Cell")
    for grid in (body, boundary):
        for name in ("temperature_c", "temperature_k", "observed"):
            if name in arrays:
                add_values(grid, name, "Node")
        if "colour" in arrays:
            add_values(grid, "colour", "Node", "Vector")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def write_msh(path: Path | str, mesh: TetMesh) -> None:
    """Write a mesh as a Gmsh file, MSH 4.1, binary, with one physical group per region and per patch.

    Regions become physical volumes and patches physical surfaces, numbered from 1; empty regions and patches are left
    out. Nodal temperatures become a view, `TEMPERATURE_VIEW`. Tetrahedron k of the mesh gets the tag k + 1, and the
    boundary triangles follow. Nodes get new numbers, sorted by the patch or region that they lie on, as Gmsh asks for.
    Layout: "MSH file format", Gmsh reference manual, version 4.1; meshio cannot write a patch named like a region.

    Raises:
        MeshError: A name is too long for Gmsh, or what `TetMesh.check` and `facet_owners` raise.
    """
    path = Path(path)
    tags = checked_tags(mesh)
    for name in (*mesh.region_names, *tags.patch_names):
        if len(name.encode()) > _LONGEST_GMSH_NAME:
            expected = f"at most {_LONGEST_GMSH_NAME} bytes, which is what Gmsh reads"
            got = f"{len(name.encode())} bytes: {name!r}"
            raise MeshError("name of a region or patch", expected=expected, got=got, remedy="Rename it.")
    # What can fail on a bad mesh is done before the file is opened.
    owner, _ = facet_owners(mesh.tets, mesh.facets)
    blocks = _node_blocks(mesh, tags)
    order = np.concatenate([nodes for *_, nodes in blocks])
    tag = np.empty_like(order)
    tag[order] = np.arange(1, len(order) + 1)
    writable_folder(path.parent)
    with replace_when_done(path) as temporary, open(temporary, "wb") as file:
        file.write(b"$MeshFormat\n4.1 1 8\n" + _ints(1) + b"\n$EndMeshFormat\n")
        lines = [f'2 {group + 1} "{tags.patch_names[group]}"' for group in _used(tags.patch)]
        lines += [f'3 {group + 1} "{mesh.region_names[group]}"' for group in _used(mesh.region)]
        file.write("\n".join(["$PhysicalNames", str(len(lines)), *lines, "$EndPhysicalNames", ""]).encode())
        for section, chunks in (
            ("Entities", _entities(mesh, tags, owner)),
            ("Nodes", _nodes(blocks, mesh)),
            ("Elements", _elements(mesh, tags, tag)),
        ):
            file.write(f"${section}\n".encode())
            file.writelines(chunks)
            file.write(f"\n$End{section}\n".encode())
        if mesh.has_temperatures:
            file.write(_view_of_nodes(TEMPERATURE_VIEW, mesh.temperature_c[order]))


def _ints(*values: int) -> bytes:
    return np.array(values, dtype=_INT).tobytes()


def _sizes(*values: int) -> bytes:
    return np.array(values, dtype=_SIZE).tobytes()


def _used(index: IntArray) -> list[int]:
    """Return the numbers of the patches or regions that have members, rising; `index` has the number of each member."""
    return np.flatnonzero(np.bincount(index)).tolist() if len(index) else []


def _bounds(mesh: TetMesh, nodes: IntArray) -> bytes:
    points = mesh.points_m[nodes.ravel()]
    return np.concatenate([points.min(axis=0), points.max(axis=0)]).astype(_DOUBLE).tobytes()


def _entities(mesh: TetMesh, tags: Boundary, owner: IntArray) -> Iterator[bytes]:
    # Each patch is one surface and each region one volume, in the physical group with the same number.
    patches, regions = _used(tags.patch), _used(mesh.region)
    yield _sizes(0, 0, len(patches), len(regions))
    for group in patches:
        yield _ints(group + 1) + _bounds(mesh, mesh.facets[tags.patch == group])
        yield _sizes(1) + _ints(group + 1) + _sizes(0)
    for group in regions:
        around = _used(tags.patch[mesh.region[owner] == group])
        yield _ints(group + 1) + _bounds(mesh, mesh.tets[mesh.region == group])
        yield _sizes(1) + _ints(group + 1) + _sizes(len(around)) + _ints(*(patch + 1 for patch in around))


def _node_blocks(mesh: TetMesh, tags: Boundary) -> list[tuple[int, int, IntArray]]:
    """Return dimension, number and nodes of every entity; nodes belong to their first patch, else to a region."""
    blocks, free = [], np.ones(len(mesh.points_m), dtype=bool)
    for dimension, cells, index in ((2, mesh.facets, tags.patch), (3, mesh.tets, mesh.region)):
        for group in _used(index):
            inside = np.zeros_like(free)
            inside[cells[index == group]] = True
            blocks.append((dimension, group + 1, np.flatnonzero(inside & free)))
            free &= ~inside
    dimension, number, nodes = blocks[-1]
    blocks[-1] = dimension, number, np.concatenate([nodes, np.flatnonzero(free)])  # nodes in no tetrahedron
    return [block for block in blocks if len(block[2])]


def _nodes(blocks: list[tuple[int, int, IntArray]], mesh: TetMesh) -> Iterator[bytes]:
    count, first = len(mesh.points_m), 1
    yield _sizes(len(blocks), count, 1, count)
    for dimension, tag, nodes in blocks:
        yield _ints(dimension, tag, 0) + _sizes(len(nodes))
        yield np.arange(first, first + len(nodes), dtype=_SIZE).tobytes()
        yield mesh.points_m[nodes].astype(_DOUBLE).tobytes()
        first += len(nodes)


def _elements(mesh: TetMesh, tags: Boundary, tag: IntArray) -> Iterator[bytes]:
    patches, regions = _used(tags.patch), _used(mesh.region)
    count = len(mesh.tets) + len(mesh.facets)
    yield _sizes(len(patches) + len(regions), count, 1, count)
    for dimension, kind, groups, cells, index, before in (
        (2, _TRIANGLE, patches, mesh.facets, tags.patch, len(mesh.tets)),
        (3, _TETRAHEDRON, regions, mesh.tets, mesh.region, 0),
    ):
        for group in groups:
            rows = np.flatnonzero(index == group)
            yield _ints(dimension, group + 1, kind) + _sizes(len(rows))
            table = np.empty((len(rows), 1 + cells.shape[1]), dtype=_SIZE)
            table[:, 0] = rows + (before + 1)
            table[:, 1:] = tag[cells[rows]]
            yield table.tobytes()


def _view_of_nodes(name: str, values: FloatArray) -> bytes:
    """Return the bytes of a view of one value per node; `values`, shape (n,), are in the order of the nodes' tags."""
    table = np.empty(len(values), dtype=[("tag", _INT), ("value", _DOUBLE)])
    table["tag"], table["value"] = np.arange(1, len(values) + 1), values
    # The entries are name, time 0, step 0, number of components and number of nodes.
    head = f'$NodeData\n1\n"{name}"\n1\n0.0\n3\n0\n1\n{len(values)}\n'
    return head.encode() + table.tobytes() + b"\n$EndNodeData\n"


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
    - ``PATCH-<name>``: nodes of a boundary patch, and a surface of the same name that holds its element faces. A
      comment before the node set says the area of the patch, [m2].
    - ``OBSERVED``: the nodes whose temperature was measured, if there are any.
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
        remedy = "Leave inp out of --formats."
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
    if mesh.observed.any():
        yield "*NSET, NSET=OBSERVED\n"
        yield from _rows("%d\n", np.flatnonzero(mesh.observed) + 1)


def _surfaces(mesh: TetMesh, tags: Boundary, patches: Sequence[str], owner: IntArray, face: IntArray) -> Iterator[str]:
    areas = facet_areas(mesh.points_m, mesh.facets)
    for name, members in _sets(tags.patch, patches):
        yield f"** PATCH-{name}: {float(areas[members].sum()):.9g} m2\n"
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
