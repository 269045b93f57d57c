"""The mesh file formats, by the ending of the file's name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from thermoxels_ns.core.errors import OutputError
from thermoxels_ns.mesh.files.abaqus import HeatStep, write_inp
from thermoxels_ns.mesh.files.gmsh import write_msh
from thermoxels_ns.mesh.files.surface import check_stl, write_glb, write_ply, write_stl
from thermoxels_ns.mesh.files.vtu import boundary_path, write_boundary_vtp, write_vtu
from thermoxels_ns.mesh.files.xdmf import heavy_data_path, write_xdmf
from thermoxels_ns.mesh.tetrahedra import TetMesh


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
