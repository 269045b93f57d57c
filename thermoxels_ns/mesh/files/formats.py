"""The mesh file formats, by the ending of the file's name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from thermoxels_ns.mesh.files.glb import write_glb
from thermoxels_ns.mesh.files.solvers import write_inp, write_msh, write_xdmf
from thermoxels_ns.mesh.files.vtu import boundary_path, write_boundary_vtp, write_vtu
from thermoxels_ns.mesh.tetrahedra import TetMesh

MESH_FORMATS = (".vtu", ".xdmf", ".msh", ".inp", ".glb")
"""Endings of all formats: four with body and boundary (ParaView, FEniCSx, Gmsh, CalculiX), .glb with the surface."""


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
        MeshError: An array does not fit the mesh or is not finite, `up` is no direction, or names are alike for .inp.
        OutputError: A file cannot be written.
    """
    path = Path(path)
    if path.suffix == ".vtu":
        write_boundary_vtp(boundary_path(path), mesh)
        write_vtu(path, mesh)
    elif path.suffix == ".glb":
        write_glb(path, mesh, up=up)
    else:
        {".xdmf": write_xdmf, ".msh": write_msh, ".inp": write_inp}[path.suffix](path, mesh)
