"""Writers of mesh files, chosen by the ending of the file's name.

They are .xdmf (FEniCSx, ParaView), .msh (Gmsh), .inp (CalculiX, Abaqus; ready to run) and .glb (the surface alone, for
browsers and phones); the module `vtu` writes .vtu.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import IntArray
from thermoxels_ns.core.checks import check_direction, remove_file, replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.units import STEFAN_BOLTZMANN_W_M2K4, ZERO_CELSIUS_K
from thermoxels_ns.mesh.files.vtu import body_grid, boundary_path, boundary_surface, node_arrays, write_vtk
from thermoxels_ns.mesh.quality.checks import facet_owners
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh, nodes_and_triangles

MESH_FORMATS = (".vtu", ".xdmf", ".msh", ".inp", ".glb")
"""Endings of all formats: four with body and boundary (ParaView, FEniCSx, Gmsh, CalculiX), .glb with the surface."""
_COLOUR_MAP = "inferno"  # perceptually uniform, readable in grey
_DARKEST = 0.1  # share of the colour map's dark end that is not used, because it looks like shading
_FAR_SIZES = 16.0  # a body is far away if its distance from the origin exceeds its size by this factor
_UNLIT = "KHR_materials_unlit"

BODY_GRID, FACET_GRID = "mesh", "facets"
"""Names of the two grids in .xdmf files, of tetrahedra and of boundary triangles; "mesh" is the default in FEniCSx."""
TEMPERATURE_VIEW = "temperature_c"  # name of the view of nodal temperatures in .msh files, [degrees Celsius]

_NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UChar"}
_TRIANGLE, _TETRAHEDRON = 2, 4
_INT, _DOUBLE = np.dtype("<i4"), np.dtype("<f8")
_FACE_OPPOSITE: IntArray = np.array([3, 4, 2, 1], dtype=np.int64)
"""Number in .inp files of the face opposite to each node: S1 has the nodes 1 2 3, S2 1 4 2, S3 2 4 3 and S4 3 4 1."""
_ROWS_AT_ONCE = 1 << 15
_CONDUCTIVITY_W_MK, _DENSITY_KG_M3, _SPECIFIC_HEAT_J_KGK = 1.7, 2200.0, 880.0  # concrete, as in the Thermoxels paper
_REAL = "%.12E"  # Abaqus reads fields of at most 20 characters


def mesh_file_paths(path: Path | str) -> list[Path]:
    """Return the paths of all files that `write_mesh` writes for a path, `path` itself first.

    >>> [path.name for path in mesh_file_paths("house.xdmf")]
    ['house.xdmf', 'house.h5']
    """
    path = Path(path)
    second = {".vtu": [boundary_path(path)], ".xdmf": [path.with_suffix(".h5")]}
    return [path, *second.get(path.suffix, [])]


def write_mesh(path: Path | str, mesh: TetMesh, *, up: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
    """Write a mesh in the format given by the ending of the file's name, one of `MESH_FORMATS`.

    Args:
        path: File to write; its folder is made if missing.
        mesh: The mesh.
        up: Up direction in mesh coordinates, used for .glb.

    Raises:
        MeshError: An array does not fit the mesh or is not finite, `up` is zero or not finite (.glb), or the mesh has
            no temperatures or two names become equal (.inp).
        OutputError: A file cannot be written.
    """
    path = Path(path)
    mesh.check()  # before a folder is made
    writable_folder(path.parent)
    if path.suffix == ".vtu":
        write_vtk(boundary_path(path), boundary_surface(mesh))
        write_vtk(path, body_grid(mesh))
    elif path.suffix == ".glb":
        write_glb(path, mesh, up=up)
    else:
        {".xdmf": write_xdmf, ".msh": write_msh, ".inp": write_inp}[path.suffix](path, mesh)


def write_glb(path: Path, mesh: TetMesh, *, up: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
    """Write the boundary as binary glTF 2.0, in metres, with a colour per node.

    Colours show temperatures. A mesh without temperatures gets the colours of the photographs, or else grey. Colours
    are stored as linear light and shown without lamps (``KHR_materials_unlit``), so shading does not change them. Up is
    +y in glTF, so the file holds a matrix that turns `up` to +y. Positions are of single precision. A body far from the
    origin has positions relative to its middle, and the matrix also moves them back. The vertex attribute
    ``_TEMPERATURE_C`` holds temperatures, the mesh's ``extras`` hold the temperatures at the ends of the colour map.
    """
    import matplotlib
    import trimesh
    from trimesh.exchange.gltf import export_glb

    x, y, z = check_direction("up", up, "Pass for instance (0, 0, 1).", MeshError).tolist()
    nodes, triangles = nodes_and_triangles(mesh.facets)
    points, temperature_c = mesh.points_m[nodes], mesh.temperature_c[nodes]
    meaning: dict[str, Any] = {"colours": "photographs"}
    attributes: dict[str, Any] = {}
    colours = np.full((len(nodes), 3), 0.5) if mesh.colour is None else mesh.colour[nodes].astype(np.float64)
    if mesh.has_temperatures:
        low, high = float(temperature_c.min()), float(temperature_c.max())
        meaning = {"colours": "temperature", "lowest_c": low, "highest_c": high}
        share = (temperature_c - low) / (high - low) if high > low else np.full(len(nodes), 0.5)
        colours = matplotlib.colormaps[_COLOUR_MAP](_DARKEST + (1.0 - _DARKEST) * share)[:, :3]
        attributes["_TEMPERATURE_C"] = temperature_c.astype(np.float32)
    # Light intensities of sRGB colours (IEC 61966-2-1), 0 to 65535, and full opacity.
    light = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    light = np.pad(np.floor(light * 65535.0 + 0.5), ((0, 0), (0, 1)), constant_values=65535.0).astype("<u2")
    # The smallest turn to +y is about the axis up x y, or about any level axis if up is +y or -y itself.
    level = math.hypot(x, z)
    turn = trimesh.transformations.rotation_matrix(math.atan2(level, y), (-z, 0.0, x) if level else (1.0, 0.0, 0.0))
    # At five million metres from the origin, single precision has steps of half a metre.
    lower, upper = points.min(axis=0), points.max(axis=0)
    far = np.abs(points).max() > _FAR_SIZES * (upper - lower).max()
    origin = np.round(0.5 * (lower + upper)) if far else np.zeros(3)
    shown = trimesh.Trimesh(
        points - origin, triangles, process=False, metadata=meaning, vertex_attributes={"_COLOR_0": light, **attributes}
    )
    place = turn @ trimesh.transformations.translation_matrix(origin)
    scene = trimesh.Scene()
    scene.add_geometry(shown, node_name="surface", geom_name="surface", transform=place)
    with replace_when_done(path) as temporary:
        temporary.write_bytes(export_glb(scene, tree_postprocessor=_finish))


def _finish(tree: dict[str, Any]) -> None:
    """Turn `_COLOR_0` of a glTF tree in place into 16-bit colours, which trimesh cannot write, shown without lamps."""
    (primitive,) = tree["meshes"][0]["primitives"]
    primitive["attributes"]["COLOR_0"] = number = primitive["attributes"].pop("_COLOR_0")
    tree["accessors"][number]["normalized"] = True
    primitive["material"] = 0
    dull = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree["materials"] = [{"name": "temperature", "pbrMetallicRoughness": dull, "extensions": {_UNLIT: {}}}]
    tree["extensionsUsed"] = [_UNLIT]
    tree["asset"]["generator"] = "thermoxels"


def write_xdmf(path: Path, mesh: TetMesh) -> None:
    """Write a mesh as ``NAME.xdmf`` and ``NAME.h5``.

    The grid "mesh" holds the tetrahedra with `region` per cell; the grid "facets" holds the boundary triangles with
    `patch` per triangle. Both hold `temperature_c`, `observed` and, if the mesh has colours, `colour`
    per node. Regions and patches are numbered from 1, as in .msh files; an ``Information`` element of each grid lists
    the names. In FEniCSx::

        with dolfinx.io.XDMFFile(comm, "mesh.xdmf", "r") as file:
            mesh = file.read_mesh(name="mesh")
            regions = file.read_meshtags(mesh, name="mesh")
            mesh.topology.create_connectivity(2, 3)
            patches = file.read_meshtags(mesh, name="facets")

    The .h5 is written first. No .xdmf exists until the .h5 is complete.
    """
    import h5py

    tags = mesh.boundary
    arrays: dict[str, npt.NDArray] = {
        "points_m": mesh.points_m,
        "tets": mesh.tets.astype(np.int64),
        "region": (mesh.region + 1).astype(np.int32),
        "facets": mesh.facets.astype(np.int64),
        "patch": (tags.patch + 1).astype(np.int32),
        **node_arrays(mesh),
    }
    data_file = path.with_suffix(".h5")
    text = _index(mesh.region_names, tags.patch_names, arrays, escape(data_file.name))

    with replace_when_done(data_file) as temporary:
        with h5py.File(temporary, "w") as file:
            for name, values in arrays.items():
                # Times of day would make two files of one mesh differ.
                file.create_dataset(name, data=values, track_times=False)
        # An old .xdmf does not fit the new data.
        remove_file(path)
    with replace_when_done(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _index(regions: Sequence[str], patches: Sequence[str], arrays: dict[str, npt.NDArray], data_file: str) -> str:
    """Return the text of the .xdmf file, which describes the arrays in `data_file`."""

    def data(name: str) -> str:
        shape, number = " ".join(map(str, arrays[name].shape)), arrays[name].dtype
        kind = f'NumberType="{_NUMBER_TYPES[number.kind]}" Precision="{number.itemsize}"'
        return f'<DataItem Format="HDF" Dimensions="{shape}" {kind}>{data_file}:/{name}</DataItem>'

    def values(name: str, centre: str) -> str:
        kind = "Vector" if name == "colour" else "Scalar"
        return f'<Attribute Name="{name}" AttributeType="{kind}" Center="{centre}">{data(name)}</Attribute>'

    def grid(name: str, kind: str, cells: str, tag: str, names: Sequence[str]) -> str:
        numbered = quoteattr("; ".join(f"{number} = {entry}" for number, entry in enumerate(names, 1)))
        size = 'NumberOfElements="{}" NodesPerElement="{}"'.format(*arrays[cells].shape)
        lines = (
            f'<Grid Name="{name}" GridType="Uniform">',
            f'<Information Name="{tag}_names" Value={numbered}/>',
            f'<Topology TopologyType="{kind}" {size}>{data(cells)}</Topology>',
            f'<Geometry GeometryType="XYZ">{data("points_m")}</Geometry>',
            values(tag, "Cell"),  # FEniCSx reads the first attribute of a grid as its tags
            *(values(one, "Node") for one in ("temperature_c", "observed", "colour") if one in arrays),
            "</Grid>",
        )
        return "\n".join(lines)

    body = grid(BODY_GRID, "Tetrahedron", "tets", "region", regions)
    boundary = grid(FACET_GRID, "Triangle", "facets", "patch", patches)
    start = "<?xml version='1.0' encoding='utf-8'?>\n<Xdmf Version=\"3.0\">\n<Domain>\n"
    return f"{start}{body}\n{boundary}\n</Domain>\n</Xdmf>\n"


def write_msh(path: Path, mesh: TetMesh) -> None:
    """Write a mesh as a Gmsh file, MSH 2.2, binary, with one physical group per region and per patch.

    Regions become physical volumes and patches physical surfaces, numbered from 1; empty regions and patches are left
    out. Nodal temperatures become a view, `TEMPERATURE_VIEW`. Node k and tetrahedron k of the mesh get the number
    k + 1; boundary triangles get the numbers after the tetrahedra. Layout: "MSH file format version 2", Gmsh reference
    manual; it does not group nodes as version 4 does. meshio cannot write a patch that has the name of a region.
    """
    tags = mesh.boundary
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
    with replace_when_done(path) as temporary, open(temporary, "wb") as file:
        file.writelines(b"$%b\n%b\n$End%b\n" % (name, text, name) for name, text in sections.items())


def _numbered(first: int, field: tuple, values: npt.NDArray) -> bytes:
    """Return a table as bytes: each row has a number, counted from `first`, and one of `values`, of type `field`."""
    table = np.empty(len(values), dtype=[("number", _INT), field])
    table["number"], table[field[0]] = np.arange(first, first + len(values)), values
    return table.tobytes()


def _elements(kind: int, first: int, cells: IntArray, group: IntArray) -> bytes:
    """Return elements (n, k) of one kind as bytes, numbered from `first`. `group` (n,), from 0, becomes both the
    physical group and the geometrical entity, from 1."""
    if not len(cells):
        return b""
    rows = np.column_stack([group, group, cells]) + 1
    return np.array([kind, len(cells), 2], _INT).tobytes() + _numbered(first, ("row", _INT, rows.shape[1]), rows)


def write_inp(path: Path, mesh: TetMesh, *, steps: int = 10, step_seconds: float = 60.0) -> None:
    """Write a mesh as an input file of CalculiX and Abaqus that runs as it is: ``ccx NAME`` for ``NAME.inp``.

    Units are metres, kilograms, seconds and degrees Celsius; node k and tetrahedron k get the number k + 1. Contents:

    - ``NALL`` and ``EALL``: all nodes and all elements, of type DC3D4, which CalculiX reads as C3D4.
    - ``REGION-<name>``: elements of a region; ``MATERIAL-<name>``: its material, concrete for all regions.
    - ``PATCH-<name>``: nodes of a boundary patch, and a surface of the same name that holds its element faces.
    - Initial temperatures, and a heat transfer step without boundary conditions, of `steps` equal time steps, that
      prints temperatures (``NT``).

    Names are in capitals, and other characters than letters, digits and underscores become underscores. Empty regions
    and patches are left out, because an empty set stops a solver. Raises `MeshError` if the mesh has no temperatures.
    """
    tags = mesh.boundary
    check_start(mesh)
    regions = _set_names("region_names", mesh.region_names)
    patches = _set_names("boundary.patch_names", tags.patch_names)
    # What can fail on a bad mesh is done before the file is opened.
    owner, opposite = facet_owners(mesh.tets, mesh.facets)
    with replace_when_done(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as file:
        file.write("*HEADING\nTetrahedral mesh with measured temperatures; metres, seconds, degrees Celsius\n")
        file.writelines(_nodes_and_elements(mesh, regions))
        file.writelines(_surfaces(mesh, tags, patches, owner, _FACE_OPPOSITE[opposite]))
        file.writelines(_materials([name for name, _ in _sets(mesh.region, regions)]))
        file.write("*INITIAL CONDITIONS, TYPE=TEMPERATURE\n")
        numbers_from_1 = np.arange(1, len(mesh.points_m) + 1)
        file.writelines(_rows(f"%d, {_REAL}\n", numbers_from_1, mesh.temperature_c))
        # For equal steps, the shortest and the longest step that the solver may take are the length asked for.
        length, total = _REAL % step_seconds, _REAL % (steps * step_seconds)
        file.write(f"*STEP, INC={steps}\n*HEAT TRANSFER\n{length}, {total}, {length}, {length}\n")
        file.write("*NODE PRINT, NSET=NALL\nNT\n*NODE FILE\nNT\n*END STEP\n")


def check_start(mesh: TetMesh) -> None:
    """Raise `MeshError` if a mesh has no temperatures; an .inp file needs them as initial temperatures."""
    if not mesh.has_temperatures:
        remedy = "Leave inp out of --formats."
        raise MeshError("mesh for .inp", expected="temperatures at the start", got="none", remedy=remedy)


def _set_names(name: str, names: Sequence[str]) -> list[str]:
    """Return the names in capitals, letters, digits and underscores only; raise `MeshError` if two become equal."""
    written = [re.sub(r"[^A-Za-z0-9_]+", "_", entry).upper() for entry in names]
    if len(set(written)) != len(written):
        expected = "names that differ in their letters and digits (capitals or not), as .inp files ask for"
        raise MeshError(name, expected=expected, got=list(names), remedy="Rename them.")
    return written


def _sets(index: IntArray, names: Sequence[str]) -> Iterator[tuple[str, IntArray]]:
    """Yield each name that has elements, and these elements' numbers, ascending. `index` (n,) holds the patch or region
    of each element, as an index into `names`."""
    for number, name in enumerate(names):
        members = np.flatnonzero(index == number)
        if len(members):
            yield name, members


def _rows(row: str, *columns: npt.NDArray) -> Iterator[str]:
    """Yield the text of a table in chunks of many rows, which is faster than row by row; `row` is a % format."""
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


def _materials(used: Sequence[str]) -> Iterator[str]:
    yield f"*PHYSICAL CONSTANTS, ABSOLUTE ZERO={-ZERO_CELSIUS_K}, STEFAN BOLTZMANN={STEFAN_BOLTZMANN_W_M2K4:.9E}\n"
    for name in used:
        yield f"*MATERIAL, NAME=MATERIAL-{name}\n"
        yield f"*DENSITY\n{_REAL}\n" % _DENSITY_KG_M3
        yield f"*CONDUCTIVITY\n{_REAL}\n" % _CONDUCTIVITY_W_MK
        yield f"*SPECIFIC HEAT\n{_REAL}\n" % _SPECIFIC_HEAT_J_KGK
    for name in used:
        yield f"*SOLID SECTION, ELSET=REGION-{name}, MATERIAL=MATERIAL-{name}\n"
