"""Files of a mesh's surface: .stl (shape only), .ply (with colours and temperatures), .glb (for browsers, phones)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import check_direction
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.content import colour_bytes, nodes_and_triangles, write_bytes
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas

_ROUNDING_NOTICED = 0.01  # largest move of a node by rounding, as a share of a triangle's side
_COLOUR_MAP = "inferno"  # perceptually uniform, readable in grey
_DARKEST = 0.1  # share of the colour map's dark end that is not used, because it looks like shading
_FAR_SIZES = 16.0  # .glb positions of a body farther from the origin than so many of its sizes count from its middle
_UNLIT = "KHR_materials_unlit"


def write_stl(path: Path | str, mesh: TetMesh) -> None:
    """Write the boundary triangles as binary STL, shape only, lengths in [m]; raises `MeshError` far from the origin.

    See `check_single_precision`.
    """
    from trimesh import Trimesh
    from trimesh.exchange.stl import export_stl

    mesh.check()
    check_single_precision(mesh)
    write_bytes(Path(path), [export_stl(Trimesh(mesh.points_m, mesh.facets, process=False))])


def write_ply(path: Path | str, mesh: TetMesh) -> None:
    """Write the boundary as binary PLY with colours and temperatures (read by MeshLab, CloudCompare, Blender).

    Vertex properties: x, y, z [m], red, green, blue, alpha and, if temperatures are known, `temperature_c` [degrees
    Celsius] and `observed`. The colours are those of the photographs, or stand for temperatures if the mesh has no
    colours. Raises `MeshError` far from the origin, see `check_single_precision`.
    """
    from trimesh import Trimesh
    from trimesh.exchange.ply import export_ply

    mesh.check()
    check_single_precision(mesh)
    nodes, triangles = nodes_and_triangles(mesh.facets)
    temperature_c = mesh.temperature_c[nodes]
    by_temperature = mesh.colour is None and mesh.has_temperatures
    colours = _temperature_colours(temperature_c) if by_temperature else _photographed_colours(mesh)[nodes]
    known: dict[str, Any] = {}
    if mesh.has_temperatures:
        known = {"temperature_c": temperature_c.astype(np.float32), "observed": mesh.observed[nodes].astype(np.uint8)}
    shown = Trimesh(
        mesh.points_m[nodes], triangles, process=False, vertex_colors=colour_bytes(colours), vertex_attributes=known
    )
    write_bytes(Path(path), [export_ply(shown, vertex_normal=False)])


def check_single_precision(mesh: TetMesh) -> None:
    """Check that the single precision of .stl and .ply suffices for a mesh's shape, as it does near the origin.

    Raises:
        MeshError: Rounding would move nodes by more than a hundredth of the side of a mean triangle.
    """
    if not len(mesh.facets):
        return
    side = float(np.sqrt(2.0 * facet_areas(mesh.points_m, mesh.facets).mean()))
    farthest = float(np.abs(mesh.points_m[mesh.facets]).max())
    rounding = 0.5 * float(np.spacing(np.float32(farthest)))
    if rounding > _ROUNDING_NOTICED * side:
        expected = "coordinates near the origin, because these formats have single precision"
        got = f"one at {farthest:.6g}, where single precision moves nodes by up to {rounding:.3g}"
        remedy = "Write .glb or .vtu, which hold such places, or shift the poses towards the origin."
        raise MeshError("mesh for .stl or .ply", expected=expected, got=got, remedy=remedy)


def write_glb(path: Path | str, mesh: TetMesh, *, up: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
    """Write the boundary as binary glTF 2.0, lengths in [m], with a colour per node that stands for its temperature, or
    is that of the photographs if the mesh has no temperatures.

    Up is +y in glTF, so the file holds a matrix that turns `up` to +y. Colours are stored as light intensities and
    shown without lamps (``KHR_materials_unlit``), so that shading does not change them. Positions have single
    precision; far from the origin they count from the body's middle, and the matrix moves them back. The vertex
    attribute ``_TEMPERATURE_C`` holds the temperatures, the mesh's ``extras`` hold the ends of the colour map.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    path = Path(path)
    mesh.check()
    nodes, triangles = nodes_and_triangles(mesh.facets)
    points, temperature_c = mesh.points_m[nodes], mesh.temperature_c[nodes]
    if not len(triangles):
        remedy = "Build the mesh with its boundary."
        raise MeshError("facets", expected="at least one triangle", got="none", remedy=remedy)
    x, y, z = check_direction("up", up, "Pass for instance (0, 0, 1).", MeshError).tolist()
    # The smallest turn to +y is about the axis up x y, or about any level axis if up is +y or -y itself.
    level = math.hypot(x, z)
    turn = trimesh.transformations.rotation_matrix(math.atan2(level, y), (-z, 0.0, x) if level else (1.0, 0.0, 0.0))
    # At five million metres from the origin, single precision has steps of half a metre.
    lower, upper = points.min(axis=0), points.max(axis=0)
    far = np.abs(points).max() > _FAR_SIZES * (upper - lower).max()
    origin = np.round(0.5 * (lower + upper)) if far else np.zeros(3)
    turn = turn @ trimesh.transformations.translation_matrix(origin)
    meaning: dict[str, Any] = {"colours": "photographs"}
    attributes: dict[str, Any] = {"_COLOR_0": _light(_photographed_colours(mesh)[nodes])}
    if mesh.has_temperatures:
        meaning = dict(zip(("colours", "lowest_c", "highest_c"), ("temperature", *_range_c(temperature_c))))
        attributes["_COLOR_0"] = _light(_temperature_colours(temperature_c))
        attributes["_TEMPERATURE_C"] = temperature_c.astype(np.float32)
    shown = trimesh.Trimesh(
        points - origin,
        triangles,
        process=False,
        metadata=meaning,
        vertex_attributes=attributes,
    )
    scene = trimesh.Scene()
    scene.add_geometry(shown, node_name="surface", geom_name="surface", transform=turn)
    write_bytes(path, [export_glb(scene, tree_postprocessor=_finish)])


def _range_c(temperature_c: FloatArray) -> tuple[float, float]:
    """Return the lowest and highest temperature, the ends of the colour map, [degrees Celsius]; 0, 0 without nodes."""
    return (float(temperature_c.min()), float(temperature_c.max())) if len(temperature_c) else (0.0, 0.0)


def _photographed_colours(mesh: TetMesh) -> FloatArray:
    """Return the colour of each node in the photographs, grey if not known, shape (n, 3)."""
    return np.full((len(mesh.points_m), 3), 0.5) if mesh.colour is None else np.asarray(mesh.colour, dtype=np.float64)


def _temperature_colours(temperature_c: FloatArray) -> FloatArray:
    """Return a colour (sRGB in [0, 1]) for each temperature, from a map that spans all of them, shape (m, 3)."""
    import matplotlib

    low, high = _range_c(temperature_c)
    share = (temperature_c - low) / (high - low) if high > low else np.full(len(temperature_c), 0.5)
    return matplotlib.colormaps[_COLOUR_MAP](_DARKEST + (1.0 - _DARKEST) * share)[:, :3]


def _light(colours: FloatArray) -> np.ndarray:
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
