"""Helpers of all mesh writers: checked meshes with tags, arrays per node, surfaces without unused nodes, files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh


def checked_mesh(mesh: TetMesh, temperature_c: FloatArray | None = None) -> tuple[TetMesh, Boundary]:
    """Check a mesh, and return the mesh and its tags; without tags, all triangles are seen and in the patch "boundary".

    The argument `temperature_c`, shape (n,), [degrees Celsius], replaces the mesh's own if given.

    Raises:
        MeshError: `TetMesh.check` fails.
    """
    if temperature_c is not None:
        mesh = replace(mesh, temperature_c=np.asarray(temperature_c, dtype=np.float64))
    mesh.check()
    count = len(mesh.facets)
    return mesh, mesh.boundary or Boundary(
        seen=np.ones(count, dtype=bool),
        patch=np.zeros(count, dtype=np.int64),
        patch_names=("boundary",),
    )


def node_arrays(mesh: TetMesh) -> dict[str, npt.NDArray]:
    """Return arrays per node by name: `temperature_c`, `temperature_k`, `observed`, and `colour` in bytes, if known."""
    arrays: dict[str, npt.NDArray] = {}
    if mesh.has_temperatures:
        arrays["temperature_c"] = mesh.temperature_c
        arrays["temperature_k"] = celsius_to_kelvin(mesh.temperature_c)
        arrays["observed"] = mesh.observed.astype(np.uint8)
    if mesh.colour is not None:
        arrays["colour"] = colour_bytes(mesh.colour)
    return arrays


def write_bytes(path: Path, chunks: Iterable[bytes]) -> None:
    """Write `chunks`, one after another, to a file, completely or not at all; the folder is made if missing."""
    writable_folder(path.parent)
    with replace_when_done(path) as temporary, open(temporary, "wb") as file:
        file.writelines(chunks)


def colour_bytes(colour: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Return colours in [0, 1] as bytes; values outside are clipped.

    >>> colour_bytes(np.array([[0.0, 0.5, 1.2]])).tolist()
    [[0, 128, 255]]
    """
    return np.floor(np.clip(colour, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


@dataclass(frozen=True)
class Surface:
    """Boundary triangles, with just the nodes that they use."""

    points_m: FloatArray  # nodes on the boundary, shape (m, 3), [m]
    triangles: IntArray  # indices into `points_m`, shape (f, 3), right-hand normals outwards
    nodes: IntArray  # index in the mesh of each node of `points_m`, ascending, shape (m,)


def surface_of(points_m: FloatArray, facets: IntArray) -> Surface:
    """Return the triangles `facets` (f, 3) as a surface that holds only the nodes of `points_m` that they use.

    >>> surface_of(np.arange(12.0).reshape(4, 3), np.array([[3, 0, 2]])).triangles.tolist()
    [[2, 0, 1]]
    """
    used = np.zeros(len(points_m), dtype=bool)
    used[facets.ravel()] = True
    nodes = np.flatnonzero(used)
    return Surface(points_m[nodes], (np.cumsum(used) - 1)[facets], nodes)
