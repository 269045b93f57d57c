"""The surface of a mesh as .stl (shape only) and .ply (shape, colours and temperatures)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.content import (
    COLOUR_MAP,
    check_suffix,
    colour_bytes,
    file_content,
    surface_of,
    surface_range_c,
    temperature_colours,
    write_bytes,
)
from thermoxels_ns.mesh.quality.checks import facet_areas, facet_normals
from thermoxels_ns.mesh.tetrahedra import TetMesh

_STL_HEADER = b"Surface of a tetrahedral mesh, metres".ljust(80)
_ROUNDING_NOTICED = 0.01  # share of a triangle's side by which rounding may move its corners
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_stl(path: Path | str, mesh: TetMesh) -> None:
    """Write the boundary triangles as binary STL, which knows nothing but shapes; lengths are metres.

    Arguments and errors are those of `thermoxels_ns.mesh.files.formats.write_mesh`.
    """
    path = check_suffix(path, ".stl")
    content = file_content(mesh)
    check_stl(mesh)
    triangles = np.zeros(len(content.facets), dtype=_STL_TRIANGLE)
    triangles["normal"] = facet_normals(content.points_m, content.facets)
    triangles["corners"] = content.points_m[content.facets]
    write_bytes(path, [_STL_HEADER, np.array(len(triangles), "<u4").tobytes(), triangles.tobytes()])


def check_stl(mesh: TetMesh) -> None:
    """Refuse a mesh so far from the origin that STL, which has single precision, cannot hold its shape.

    Raises:
        MeshError: Rounding would move nodes by more than a hundredth of a triangle's side.
    """
    if not len(mesh.facets):
        return
    side = float(np.sqrt(2.0 * facet_areas(mesh.points_m, mesh.facets).mean()))
    farthest = float(np.abs(mesh.points_m[mesh.facets]).max())
    rounding = 0.5 * float(np.spacing(np.float32(farthest)))
    if rounding > _ROUNDING_NOTICED * side:
        expected = "coordinates near the origin, because STL has single precision"
        got = f"one at {farthest:.6g}, where single precision moves nodes by up to {rounding:.3g}"
        remedy = "Write .ply, which has double precision, or shift the poses towards the origin."
        raise MeshError("mesh for .stl", expected=expected, got=got, remedy=remedy)


def write_ply(path: Path | str, mesh: TetMesh) -> None:
    """Write the boundary as binary PLY with colours and temperatures (read by MeshLab, CloudCompare, Blender).

    Vertex properties: x, y, z [m], red, green, blue, `temperature_c` [degrees Celsius] and `observed` (1: measured,
    0: extended). Colours are those of the photographs, of temperatures where the mesh has none; a comment says which.

    Arguments and errors are those of `thermoxels_ns.mesh.files.formats.write_mesh`.
    """
    path = check_suffix(path, ".ply")
    content = file_content(mesh)
    surface = surface_of(content.points_m, content.facets)
    if mesh.colour is None:
        low, high = surface_range_c(surface, content.temperature_c)
        shown = f"{COLOUR_MAP} from {low:.6g} to {high:.6g} degrees Celsius"
        colours = colour_bytes(temperature_colours(surface, content.temperature_c))
    else:
        shown, colours = "photographs", colour_bytes(np.asarray(mesh.colour, dtype=np.float64)[surface.nodes])
    columns = {
        "x": ("double", "<f8", surface.points_m[:, 0]),
        "y": ("double", "<f8", surface.points_m[:, 1]),
        "z": ("double", "<f8", surface.points_m[:, 2]),
        "red": ("uchar", "u1", colours[:, 0]),
        "green": ("uchar", "u1", colours[:, 1]),
        "blue": ("uchar", "u1", colours[:, 2]),
        "temperature_c": ("float", "<f4", content.temperature_c[surface.nodes]),
        "observed": ("uchar", "u1", mesh.observed[surface.nodes]),
    }
    vertices = np.empty(len(surface.nodes), dtype=[(name, kind) for name, (_, kind, _) in columns.items()])
    for name, (_, _, values) in columns.items():
        vertices[name] = values
    faces = np.empty(len(surface.triangles), dtype=[("count", "u1"), ("nodes", "<i4", 3)])
    faces["count"] = 3
    faces["nodes"] = surface.triangles

    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment surface of a tetrahedral mesh, metres",
        f"comment colours: {shown}",
        f"element vertex {len(vertices)}",
        *(f"property {kind} {name}" for name, (kind, _, _) in columns.items()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    write_bytes(path, ["\n".join(header).encode("ascii"), vertices.tobytes(), faces.tobytes()])
