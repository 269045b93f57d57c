"""What every mesh writer needs: a checked mesh with tags, the nodes of a surface, values per node, whole files."""

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
    """Return a mesh that passed `TetMesh.check` and its tags; without tags all triangles are one patch, "boundary".

    `temperature_c` takes the place of the mesh's own, shape (n,), [degrees Celsius].

    Raises:
        MeshError: What `TetMesh.check` raises.
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
    """Return the values per node that files of the body hold; colours only if the mesh has them."""
    arrays: dict[str, npt.NDArray] = {
        "temperature_c": mesh.temperature_c,
        "temperature_k": celsius_to_kelvin(mesh.temperature_c),
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
    """Return triangles without the nodes that none of them uses.

    >>> surface_of(np.arange(12.0).reshape(4, 3), np.array([[3, 0, 2]])).triangles.tolist()
    [[2, 0, 1]]
    """
    used = np.zeros(len(points_m), dtype=bool)
    used[facets.ravel()] = True
    nodes = np.flatnonzero(used)
    return Surface(points_m[nodes], (np.cumsum(used) - 1)[facets], nodes)
