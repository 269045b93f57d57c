"""The file formats that a mesh can be written in, by the ending of the file's name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import MeshError, OutputError
from thermoxels_ns.mesh.boundary.surface import Colouring
from thermoxels_ns.mesh.files.abaqus import HeatStep, write_inp
from thermoxels_ns.mesh.files.gltf import write_glb
from thermoxels_ns.mesh.files.gmsh import write_msh
from thermoxels_ns.mesh.files.stl_ply import check_stl, write_ply, write_stl
from thermoxels_ns.mesh.files.vtp import boundary_path, write_boundary_vtp
from thermoxels_ns.mesh.files.vtu import write_vtu
from thermoxels_ns.mesh.files.xdmf import heavy_data_path, write_xdmf
from thermoxels_ns.mesh.tetrahedra import TetMesh


@dataclass(frozen=True)
class _Request:
    """What `write_mesh` was asked for."""

    path: Path
    mesh: TetMesh
    temperature_c: npt.NDArray[np.floating] | None
    heat_step: HeatStep | None
    colouring: Colouring | None
    up: Sequence[float]


@dataclass(frozen=True)
class MeshFormat:
    """A way to write a mesh."""

    suffix: str
    """Ending of the file's name, with its dot."""
    description: str
    """What it holds and who reads it, in one line."""
    write: Callable[[_Request], None]
    """Writes the files."""
    companion: Callable[[Path], Path] | None = None
    """Names the second file, if the format takes two."""
    refuse: Callable[[TetMesh], None] | None = None
    """Raises if the format cannot hold a mesh that others can; so an export knows before anything slow runs."""


def _vtu(request: _Request) -> None:
    write_boundary_vtp(boundary_path(request.path), request.mesh, temperature_c=request.temperature_c)
    write_vtu(request.path, request.mesh, temperature_c=request.temperature_c)


def _inp(request: _Request) -> None:
    if request.heat_step is None:
        raise MeshError(
            "heat_step",
            expected="material and times, which an .inp file runs with",
            got=None,
            remedy="Pass heat_step=HeatStep(...), or choose another format.",
        )
    write_inp(request.path, request.mesh, request.heat_step, temperature_c=request.temperature_c)


MESH_FORMATS: dict[str, MeshFormat] = {
    entry.suffix: entry
    for entry in (
        MeshFormat(
            ".vtu",
            "body, and its tagged boundary as NAME-boundary.vtp: ParaView, pyvista",
            _vtu,
            boundary_path,
        ),
        MeshFormat(
            ".xdmf",
            "body and boundary with tags, data in NAME.h5: FEniCSx, ParaView",
            lambda request: write_xdmf(request.path, request.mesh, temperature_c=request.temperature_c),
            heavy_data_path,
        ),
        MeshFormat(
            ".msh",
            "body and boundary as physical groups, MSH 4.1: Gmsh and what reads its files",
            lambda request: write_msh(request.path, request.mesh, temperature_c=request.temperature_c),
        ),
        MeshFormat(".inp", "sets, surfaces and a heat transfer step that runs: CalculiX, Abaqus", _inp),
        MeshFormat(
            ".stl",
            "surface, shape only: CAD and 3D printing",
            lambda request: write_stl(request.path, request.mesh),
            refuse=check_stl,
        ),
        MeshFormat(
            ".ply",
            "surface with colours and temperatures: MeshLab, CloudCompare, Blender",
            lambda request: write_ply(
                request.path, request.mesh, temperature_c=request.temperature_c, colouring=request.colouring
            ),
        ),
        MeshFormat(
            ".glb",
            "surface coloured by temperature or by the photographs (glTF): browsers, phones, office programs",
            lambda request: write_glb(
                request.path,
                request.mesh,
                temperature_c=request.temperature_c,
                colouring=request.colouring or "temperature",
                up=request.up,
            ),
        ),
    )
}
"""All formats by suffix, those of solvers first."""


def mesh_format(path: Path | str) -> MeshFormat:
    """Find the format that the ending of a file's name stands for.

    >>> mesh_format("house.msh").description
    'body and boundary as physical groups, MSH 4.1: Gmsh and what reads its files'

    Raises:
        OutputError: No format has this ending.
    """
    path = Path(path)
    if path.suffix not in MESH_FORMATS:
        raise OutputError(
            "mesh file",
            expected=f"a name that ends in one of {', '.join(MESH_FORMATS)}",
            got=path.name,
            remedy="Rename the file.",
        )
    return MESH_FORMATS[path.suffix]


def mesh_file_paths(path: Path | str) -> list[Path]:
    """Name all files that `write_mesh` writes for a path, that path first.

    >>> [path.name for path in mesh_file_paths("house.xdmf")]
    ['house.xdmf', 'house.h5']

    Raises:
        OutputError: No format has this ending.
    """
    path = Path(path)
    companion = mesh_format(path).companion
    return [path] if companion is None else [path, companion(path)]


def check_format(path: Path | str, mesh: TetMesh) -> None:
    """Raise what `write_mesh` would because of the format, without writing.

    Raises:
        MeshError: The format cannot hold this mesh.
        OutputError: No format has this ending.
    """
    refuse = mesh_format(path).refuse
    if refuse is not None:
        refuse(mesh)


def write_mesh(
    path: Path | str,
    mesh: TetMesh,
    *,
    temperature_c: npt.NDArray[np.floating] | None = None,
    heat_step: HeatStep | None = None,
    colouring: Colouring | None = None,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> list[Path]:
    """Write a mesh in the format that the file's ending stands for, see `MESH_FORMATS`.

    Args:
        path: File to write; its folder is made if need be.
        mesh: The mesh.
        temperature_c: Temperatures to write in place of the mesh's own, shape (n,), [degrees Celsius].
        heat_step: Material and times; .inp needs it, the others do not look at it.
        colouring: What the colours of .ply and .glb show; None: each format's own choice.
        up: Direction that points up, in mesh coordinates, for .glb.

    Returns:
        All files written, `path` first.

    Raises:
        MeshError: An array does not fit the mesh or is not finite, or the format needs what is not there.
        OutputError: No format has this ending, or a file cannot be written.
    """
    path = Path(path)
    mesh_format(path).write(_Request(path, mesh, temperature_c, heat_step, colouring, up))
    return mesh_file_paths(path)
