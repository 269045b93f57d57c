"""The boundary of a mesh as triangles with nodes and colours of their own, for files that know no tetrahedra."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.tetrahedra import TetMesh

Colouring = Literal["temperature", "photographs"]
"""What the colours of a surface show: temperatures through a colour map, or what the photographs saw."""

COLOUR_MAP = "inferno"
"""Colour map of temperatures: perceptually uniform, readable in grey."""

_DARKEST = 0.1
"""Share of the colour map left out at its dark end, where shading could not be told from cold."""


_FAR_SIZES = 16.0
"""Farther from the origin than this many times their own size, points lose in single precision what is seen of them."""


@dataclass(frozen=True)
class Surface:
    """Triangles that use every one of their nodes."""

    points_m: npt.NDArray[np.float64]
    """Nodes on the boundary, shape (m, 3), [m]."""
    triangles: npt.NDArray[np.int64]
    """Indices into `points_m`, shape (f, 3), right-hand normals outwards."""
    nodes: npt.NDArray[np.int64]
    """Number of each node in the mesh, rising, shape (m,)."""


def surface_of(points_m: npt.NDArray[np.float64], facets: npt.NDArray[np.int64]) -> Surface:
    """Leave out the nodes that no triangle uses.

    >>> surface_of(np.arange(12.0).reshape(4, 3), np.array([[3, 0, 2]])).triangles.tolist()
    [[2, 0, 1]]
    """
    used = np.zeros(len(points_m), dtype=bool)
    used[facets.ravel()] = True
    number = np.cumsum(used) - 1
    nodes = np.flatnonzero(used)
    return Surface(points_m[nodes], number[facets], nodes)


def far_origin(points_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | None:
    """Where to count positions from so that single precision can hold them.

    Five million metres from the origin, as in national coordinates, single precision has steps of half a metre.

    Args:
        points_m: Nodes, shape (n, 3), n at least 1, [m].

    Returns:
        The middle of the nodes in whole units, shape (3,); None where the origin of the coordinates will do.

    >>> far_origin(np.array([[4.0e6, 0.2, 0.0], [4.0e6 + 9.0, 2.6, 1.0]]))
    array([4.000004e+06, 1.000000e+00, 0.000000e+00])
    """
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    far = float(np.abs(points_m).max()) > _FAR_SIZES * float((high - low).max())
    return np.round(0.5 * (low + high)) if far else None


def surface_colours(
    mesh: TetMesh, surface: Surface, temperature_c: npt.NDArray[np.float64], colouring: Colouring
) -> npt.NDArray[np.float64]:
    """Colours of a surface's nodes, red, green, blue in [0, 1] as screens show them (sRGB), shape (m, 3).

    The colour map spans the surface's own temperatures; a surface of one temperature gets the map's middle.

    Raises:
        MeshError: The mesh has no colours from photographs, or `colouring` is none of the two.
    """
    if colouring == "photographs":
        if mesh.colour is None:
            raise MeshError(
                "colouring 'photographs'",
                expected="a mesh whose nodes have colours",
                got="a mesh without",
                remedy="Choose the colouring 'temperature', or build the mesh from a field that has colours.",
            )
        return np.clip(np.asarray(mesh.colour, dtype=np.float64)[surface.nodes], 0.0, 1.0)
    if colouring != "temperature":
        raise MeshError(
            "colouring", expected="'temperature' or 'photographs'", got=repr(colouring), remedy="Choose one."
        )
    import matplotlib

    low, high = surface_range_c(surface, temperature_c)
    values = temperature_c[surface.nodes]
    share = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    return matplotlib.colormaps[COLOUR_MAP](_DARKEST + (1.0 - _DARKEST) * share)[:, :3]


def surface_range_c(surface: Surface, temperature_c: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Lowest and highest temperature on a surface, the ends of its colour map, [degrees Celsius]."""
    values = temperature_c[surface.nodes]
    return (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
