"""The mesh file formats, by the ending of the file's name; XDMF with HDF5 data, for FEniCSx and ParaView."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import remove_file, replace_when_done, writable_folder
from thermoxels_ns.core.errors import OutputError
from thermoxels_ns.mesh.files.abaqus import HeatStep, write_inp
from thermoxels_ns.mesh.files.content import FileContent, check_suffix, file_content, node_arrays
from thermoxels_ns.mesh.files.gmsh import write_msh
from thermoxels_ns.mesh.files.surface import check_stl, write_glb, write_ply, write_stl
from thermoxels_ns.mesh.files.vtu import boundary_path, write_boundary_vtp, write_vtu
from thermoxels_ns.mesh.tetrahedra import TetMesh

BODY_GRID = "mesh"  # name of the grid of tetrahedra: what `read_mesh` of FEniCSx asks for unless told otherwise
FACET_GRID = "facets"  # name of the grid of boundary triangles

_NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UChar"}


def heavy_data_path(path: Path | str) -> Path:
    """Name the HDF5 file that belongs to an .xdmf file.

    >>> heavy_data_path("house/mesh.xdmf").as_posix()
    'house/mesh.h5'
    """
    return Path(path).with_suffix(".h5")


def write_xdmf(path: Path | str, mesh: TetMesh) -> None:
    """Write a mesh as ``NAME.xdmf`` and ``NAME.h5``.

    The grid "mesh" holds the tetrahedra with `region` per cell and `temperature_c`, `temperature_k`, `observed` and,
    if the mesh has them, `colour` per node; the grid "facets" holds the boundary triangles with `patch`, `area_factor`
    (true area over the triangle's own, other than 1 in voxel meshes) and `normal` (of the true surface) per triangle.
    Region and patch are numbers from 1, as in .msh files, where 0 stands for none; ``Information`` elements of their
    grids say their names. In FEniCSx::

        with dolfinx.io.XDMFFile(comm, "mesh.xdmf", "r") as file:
            mesh = file.read_mesh(name="mesh")
            regions = file.read_meshtags(mesh, name="mesh")
            mesh.topology.create_connectivity(2, 3)
            patches = file.read_meshtags(mesh, name="facets")

    The .h5 comes first and the .xdmf, which points at it, last; in between there is no .xdmf.
    """
    import h5py

    path = check_suffix(path, ".xdmf")
    content = file_content(mesh)
    arrays: dict[str, npt.NDArray] = {
        "points_m": content.points_m,
        "tets": content.tets.astype(np.int64),
        "region": (content.region + 1).astype(np.int32),
        "facets": content.facets.astype(np.int64),
        "patch": (content.patch + 1).astype(np.int32),
        "area_factor": content.area_factor,
        "normal": content.normal,
        **node_arrays(mesh, content),
    }
    data_file = heavy_data_path(path)
    text = _index(content, arrays, data_file.name)

    writable_folder(path.parent)
    with replace_when_done(data_file) as temporary:
        with h5py.File(temporary, "w") as file:
            for name, values in arrays.items():
                # Times of day would make two files of one mesh differ.
                file.create_dataset(name, data=values, track_times=False)
        # An index of the old data does not fit the new.
        remove_file(path)
    with replace_when_done(path) as temporary:
        temporary.write_bytes(text)


def _index(content: FileContent, arrays: dict[str, npt.NDArray], data_file: str) -> bytes:
    """Text of the .xdmf file."""
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

    body = add_grid(BODY_GRID, "tets", "Tetrahedron", "region_names", content.region_names)
    boundary = add_grid(FACET_GRID, "facets", "Triangle", "patch_names", content.patch_names)
    # FEniCSx takes the first attribute of a grid for its tags.
    add_values(body, "region", "Cell")
    add_values(boundary, "patch", "Cell")
    add_values(boundary, "area_factor", "Cell")
    add_values(boundary, "normal", "Cell", "Vector")
    for grid in (body, boundary):
        for name in ("temperature_c", "temperature_k", "observed"):
            add_values(grid, name, "Node")
        if "colour" in arrays:
            add_values(grid, "colour", "Node", "Vector")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


@dataclass(frozen=True)
class MeshFormat:
    """A way to write a mesh."""

    description: str  # what it holds and who reads it, in one line
    write: Callable[..., None]  # writes the files; takes the path, the mesh and `options`
    options: tuple[str, ...] = ()  # arguments of `write_mesh` that it looks at
    companion: Callable[[Path], Path] | None = None  # names the second file, if the format takes two
    refuse: Callable[[TetMesh], None] | None = None
    """Raises if the format cannot hold a mesh that others can; so an export knows before anything slow runs."""


def _write_body_and_boundary(path: Path, mesh: TetMesh) -> None:
    write_boundary_vtp(boundary_path(path), mesh)
    write_vtu(path, mesh)


MESH_FORMATS: dict[str, MeshFormat] = {
    ".vtu": MeshFormat(
        "body, and its tagged boundary as NAME-boundary.vtp: ParaView, pyvista",
        _write_body_and_boundary,
        companion=boundary_path,
    ),
    ".xdmf": MeshFormat(
        "body and boundary with tags, data in NAME.h5: FEniCSx, ParaView", write_xdmf, companion=heavy_data_path
    ),
    ".msh": MeshFormat("body and boundary as physical groups, MSH 4.1: Gmsh and what reads its files", write_msh),
    ".inp": MeshFormat(
        "sets, surfaces and a heat transfer step that runs: CalculiX, Abaqus", write_inp, ("heat_step",)
    ),
    ".stl": MeshFormat("surface, shape only: CAD and 3D printing", write_stl, refuse=check_stl),
    ".ply": MeshFormat("surface with colours and temperatures: MeshLab, CloudCompare, Blender", write_ply),
    ".glb": MeshFormat("surface coloured by temperature (glTF): browsers, phones, office programs", write_glb, ("up",)),
}
"""All formats by suffix, those of solvers first."""


def mesh_format(path: Path | str) -> MeshFormat:
    """Find the format that the ending of a file's name stands for; `OutputError` if there is none.

    >>> mesh_format("house.msh").description
    'body and boundary as physical groups, MSH 4.1: Gmsh and what reads its files'
    """
    path = Path(path)
    if path.suffix not in MESH_FORMATS:
        expected = f"a name that ends in one of {', '.join(MESH_FORMATS)}"
        raise OutputError("mesh file", expected=expected, got=path.name, remedy="Rename the file.")
    return MESH_FORMATS[path.suffix]


def mesh_file_paths(path: Path | str) -> list[Path]:
    """Name all files that `write_mesh` writes for a path, that path first.

    >>> [path.name for path in mesh_file_paths("house.xdmf")]
    ['house.xdmf', 'house.h5']
    """
    path = Path(path)
    companion = mesh_format(path).companion
    return [path] if companion is None else [path, companion(path)]


def check_format(path: Path | str, mesh: TetMesh) -> None:
    """Raise what `write_mesh` would because of the format, without writing."""
    refuse = mesh_format(path).refuse
    if refuse is not None:
        refuse(mesh)


def write_mesh(
    path: Path | str,
    mesh: TetMesh,
    *,
    heat_step: HeatStep | None = None,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> list[Path]:
    """Write a mesh in the format that the file's ending stands for, see `MESH_FORMATS`.

    Args:
        path: File to write; its folder is made if need be.
        mesh: The mesh.
        heat_step: Material and times; .inp needs it, the others do not look at it.
        up: Direction that points up, in mesh coordinates, for .glb.

    Returns:
        All files written, `path` first.

    Raises:
        MeshError: An array does not fit the mesh or is not finite, or the format needs what is not there: material and
            times, an up direction, coordinates near the origin, or short and different names.
        OutputError: No format has this ending, or a file cannot be written.
    """
    path = Path(path)
    given = {"heat_step": heat_step, "up": up}
    chosen = mesh_format(path)
    chosen.write(path, mesh, **{name: given[name] for name in chosen.options})
    return mesh_file_paths(path)
