"""What every file format writes of a mesh, checked once for all of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import OutputError
from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.mesh.quality.checks import facet_normals
from thermoxels_ns.mesh.tetrahedra import TetMesh

UNTAGGED_PATCH = "boundary"  # name of the one patch that a mesh without tags is written with
COLOUR_MAP = "inferno"  # colour map of temperatures: perceptually uniform, readable in grey
_DARKEST = 0.1  # share of the colour map left out at its dark end, where shading could not be told from cold
_FAR_SIZES = 16.0
"""Farther from the origin than this many times their own size, points lose in single precision what is seen of them."""


@dataclass(frozen=True)
class FileContent:
    """A mesh's arrays, checked, with a temperature for every node and a name for every patch and region."""

    points_m: FloatArray  # nodes, shape (n, 3), [m]
    tets: IntArray  # node indices, shape (t, 4)
    temperature_c: FloatArray  # nodal temperature, shape (n,), [degrees Celsius]
    region: IntArray  # index into `region_names`, shape (t,)
    region_names: tuple[str, ...]  # names of the regions, all different; some may have no tetrahedron
    facets: IntArray  # boundary triangles, shape (f, 3), right-hand normals outwards
    patch: IntArray  # index into `patch_names`, shape (f,)
    patch_names: tuple[str, ...]  # names of the patches, all different; some may have no triangle
    normal: FloatArray  # outward unit normal of the true surface at each boundary triangle, shape (f, 3)
    area_factor: FloatArray  # True area that each boundary triangle stands for, over its own, shape (f,)


def file_content(mesh: TetMesh, temperature_c: npt.NDArray[np.floating] | None = None) -> FileContent:
    """Check the mesh; one without boundary tags gets one patch, `UNTAGGED_PATCH`, of all triangles.

    `temperature_c` takes the place of the mesh's own, shape (n,), [degrees Celsius].

    Raises:
        MeshError: What `TetMesh.check` raises.
    """
    if temperature_c is not None:
        mesh = replace(mesh, temperature_c=temperature_c)
    mesh.check()
    points, tags = np.asarray(mesh.points_m, dtype=np.float64), mesh.boundary
    if tags is None:
        count = len(mesh.facets)
        patch, names = np.zeros(count, dtype=np.int64), (UNTAGGED_PATCH,)
        normal, factor = facet_normals(points, mesh.facets), np.ones(count)
    else:
        patch, names, normal, factor = tags.patch, tuple(tags.patch_names), tags.normal, tags.area_factor
    return FileContent(
        points_m=points,
        tets=mesh.tets,
        temperature_c=np.asarray(mesh.temperature_c, dtype=np.float64),
        region=mesh.region,
        region_names=tuple(mesh.region_names),
        facets=mesh.facets,
        patch=patch,
        patch_names=names,
        normal=normal,
        area_factor=factor,
    )


def node_arrays(mesh: TetMesh, content: FileContent) -> dict[str, npt.NDArray]:
    """Values per node that files of the body hold, colours only if the mesh has them."""
    arrays: dict[str, npt.NDArray] = {
        "temperature_c": content.temperature_c,
        "temperature_k": celsius_to_kelvin(content.temperature_c),
        "observed": mesh.observed.astype(np.uint8),
    }
    if mesh.colour is not None:
        arrays["colour"] = colour_bytes(mesh.colour)
    return arrays


def write_bytes(path: Path, chunks: Iterable[bytes]) -> None:
    """Write a file, whole or not at all; its folder is made if need be."""
    writable_folder(path.parent)
    with replace_when_done(path) as temporary, open(temporary, "wb") as file:
        file.writelines(chunks)


def check_suffix(path: Path | str, suffix: str) -> Path:
    """Return `path` if its name ends in `suffix`, else raise `OutputError`."""
    path = Path(path)
    if path.suffix != suffix:
        expected = f"a name that ends in {suffix}"
        raise OutputError("mesh file", expected=expected, got=path.name, remedy="Rename the file.")
    return path


def colour_bytes(colour: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Turn colours in [0, 1] into bytes; what is outside is clipped.

    >>> colour_bytes(np.array([[0.0, 0.5, 1.2]])).tolist()
    [[0, 128, 255]]
    """
    return np.floor(np.clip(colour, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


@dataclass(frozen=True)
class Surface:
    """Triangles that use every one of their nodes."""

    points_m: FloatArray  # nodes on the boundary, shape (m, 3), [m]
    triangles: IntArray  # indices into `points_m`, shape (f, 3), right-hand normals outwards
    nodes: IntArray  # number of each node in the mesh, rising, shape (m,)


def surface_of(points_m: FloatArray, facets: IntArray) -> Surface:
    """Leave out the nodes that no triangle uses.

    >>> surface_of(np.arange(12.0).reshape(4, 3), np.array([[3, 0, 2]])).triangles.tolist()
    [[2, 0, 1]]
    """
    used = np.zeros(len(points_m), dtype=bool)
    used[facets.ravel()] = True
    number = np.cumsum(used) - 1
    nodes = np.flatnonzero(used)
    return Surface(points_m[nodes], number[facets], nodes)


def far_origin(points_m: FloatArray) -> FloatArray | None:
    """Where to count positions from so that single precision holds them: the middle of the nodes in whole units.

    None where the origin will do. Five million metres from it single precision has steps of half a metre.

    >>> far_origin(np.array([[4.0e6, 0.2, 0.0], [4.0e6 + 9.0, 2.6, 1.0]]))
    array([4.000004e+06, 1.000000e+00, 0.000000e+00])
    """
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    far = float(np.abs(points_m).max()) > _FAR_SIZES * float((high - low).max())
    return np.round(0.5 * (low + high)) if far else None


def temperature_colours(surface: Surface, temperature_c: FloatArray) -> FloatArray:
    """Colours of a surface's nodes in [0, 1] (sRGB), shape (m, 3), from a map that spans the surface's temperatures."""
    import matplotlib

    low, high = surface_range_c(surface, temperature_c)
    values = temperature_c[surface.nodes]
    share = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    return matplotlib.colormaps[COLOUR_MAP](_DARKEST + (1.0 - _DARKEST) * share)[:, :3]


def surface_range_c(surface: Surface, temperature_c: FloatArray) -> tuple[float, float]:
    """Lowest and highest temperature on a surface, the ends of its colour map, [degrees Celsius]."""
    values = temperature_c[surface.nodes]
    return (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
