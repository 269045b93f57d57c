"""The mesh file formats, by the ending of the file's name; and .glb, the surface for browsers and phones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import check_direction, replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.solvers import write_inp, write_msh, write_xdmf
from thermoxels_ns.mesh.files.vtu import body_grid, boundary_path, boundary_surface, write_vtk
from thermoxels_ns.mesh.tetrahedra import TetMesh, nodes_and_triangles

MESH_FORMATS = (".vtu", ".xdmf", ".msh", ".inp", ".glb")
"""Endings of all formats: four with body and boundary (ParaView, FEniCSx, Gmsh, CalculiX), .glb with the surface."""
_COLOUR_MAP = "inferno"  # perceptually uniform, readable in grey
_DARKEST = 0.1  # share of the colour map's dark end that is not used, because it looks like shading
_FAR_SIZES = 16.0  # positions of a body farther from the origin than so many of its sizes count from its middle
_UNLIT = "KHR_materials_unlit"


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
    writable_folder(path.parent)
    if path.suffix == ".vtu":
        write_vtk(boundary_path(path), boundary_surface(mesh))
        write_vtk(path, body_grid(mesh))
    elif path.suffix == ".glb":
        write_glb(path, mesh, up=up)
    else:
        {".xdmf": write_xdmf, ".msh": write_msh, ".inp": write_inp}[path.suffix](path, mesh)


def write_glb(path: Path | str, mesh: TetMesh, *, up: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
    """Write the boundary as binary glTF 2.0, lengths in [m], with a colour per node that stands for its temperature, or
    is that of the photographs if the mesh has no temperatures, or else grey.

    Up is +y in glTF, so the file holds a matrix that turns `up` to +y. Colours are stored as light intensities and
    shown without lamps (``KHR_materials_unlit``), so that shading does not change them. Positions have single
    precision; far from the origin they count from the body's middle, and the matrix moves them back. The vertex
    attribute ``_TEMPERATURE_C`` holds the temperatures, the mesh's ``extras`` hold the ends of the colour map.
    """
    import matplotlib
    import trimesh
    from trimesh.exchange.gltf import export_glb

    path = Path(path)
    mesh.check()
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
    # The smallest turn to +y is about the axis up x y, or about any level axis if up is +y or -y itself.
    level = math.hypot(x, z)
    turn = trimesh.transformations.rotation_matrix(math.atan2(level, y), (-z, 0.0, x) if level else (1.0, 0.0, 0.0))
    # At five million metres from the origin, single precision has steps of half a metre.
    lower, upper = points.min(axis=0), points.max(axis=0)
    far = np.abs(points).max() > _FAR_SIZES * (upper - lower).max()
    origin = np.round(0.5 * (lower + upper)) if far else np.zeros(3)
    shown = trimesh.Trimesh(
        points - origin,
        triangles,
        process=False,
        metadata=meaning,
        vertex_attributes={"_COLOR_0": _light(colours), **attributes},
    )
    place = turn @ trimesh.transformations.translation_matrix(origin)
    scene = trimesh.Scene()
    scene.add_geometry(shown, node_name="surface", geom_name="surface", transform=place)
    with replace_when_done(path) as temporary:
        temporary.write_bytes(export_glb(scene, tree_postprocessor=_finish))


def _light(colours: FloatArray) -> npt.NDArray[np.uint16]:
    """Return light intensities, 0 to 65535, of sRGB colours (IEC 61966-2-1), and full opacity, shape (m, 4)."""
    light = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return np.pad(np.floor(light * 65535.0 + 0.5), ((0, 0), (0, 1)), constant_values=65535.0).astype("<u2")


def _finish(tree: dict[str, Any]) -> None:
    """Make `_COLOR_0` the 16-bit colours of a glTF tree, which trimesh cannot write, shown without lamps."""
    (primitive,) = tree["meshes"][0]["primitives"]
    primitive["attributes"]["COLOR_0"] = number = primitive["attributes"].pop("_COLOR_0")
    tree["accessors"][number]["normalized"] = True
    primitive["material"] = 0
    dull = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree["materials"] = [{"name": "temperature", "pbrMetallicRoughness": dull, "extensions": {_UNLIT: {}}}]
    tree["extensionsUsed"] = [_UNLIT]
    tree["asset"]["generator"] = "thermoxels"
