"""The mesh file formats, by the ending of the file's name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from thermoxels_ns.core.errors import OutputError
from thermoxels_ns.mesh.files.solvers import HeatStep, heavy_data_path, write_inp, write_msh, write_xdmf
from thermoxels_ns.mesh.files.surface import write_glb, write_ply, write_stl
from thermoxels_ns.mesh.files.vtu import boundary_path, write_boundary_vtp, write_vtu
from thermoxels_ns.mesh.tetrahedra import TetMesh

MESH_FORMATS = (".vtu", ".xdmf", ".msh", ".inp", ".stl", ".ply", ".glb")
"""Endings of all formats: four with body and boundary (ParaView, FEniCSx, Gmsh, CalculiX), three with the surface."""


def mesh_file_paths(path: Path | str) -> list[Path]:
    """Return the paths of all files that `write_mesh` writes for a path, `path` itself first.

    Raises:
        OutputError: No format has this ending.

    >>> [path.name for path in mesh_file_paths("house.xdmf")]
    ['house.xdmf', 'house.h5']
    """
    path = Path(path)
    if path.suffix not in MESH_FORMATS:
        expected = f"a name that ends in one of {', '.join(MESH_FORMATS)}"
        raise OutputError("mesh file", expected=expected, got=path.name, remedy="Rename the file.")
    second = {".vtu": boundary_path, ".xdmf": heavy_data_path}.get(path.suffix)
    return [path] if second is None else [path, second(path)]


def write_mesh(
    path: Path | str,
    mesh: TetMesh,
    *,
    heat_step: HeatStep | None = None,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> None:
    """Write a mesh in the format given by the ending of the file's name, see `MESH_FORMATS`.

    Args:
        path: File to write; its folder is made if missing.
        mesh: The mesh.
        heat_step: Material and time steps, needed for .inp.
        up: Up direction in mesh coordinates, used for .glb.

    Raises:
        MeshError: An array does not fit the mesh or is not finite; or `up` is no direction, the mesh is too
            far from the origin for .stl or .ply, or names are too long or alike for the format.
        OutputError: No format has this ending, or a file cannot be written.
    """
    path = mesh_file_paths(path)[0]
    if path.suffix == ".vtu":
        write_boundary_vtp(boundary_path(path), mesh)
        write_vtu(path, mesh)
    elif path.suffix == ".inp":
        assert heat_step is not None, "an .inp file computes heat"
        write_inp(path, mesh, heat_step)
    elif path.suffix == ".glb":
        write_glb(path, mesh, up=up)
    else:
        {".xdmf": write_xdmf, ".msh": write_msh, ".stl": write_stl, ".ply": write_ply}[path.suffix](path, mesh)
