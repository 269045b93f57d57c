"""What all mesh writers need: tags of checked meshes, arrays per node, surfaces without unused nodes, files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import IntArray
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh


def checked_tags(mesh: TetMesh) -> Boundary:
    """Check a mesh as `TetMesh.check`, and return its tags; without tags, all triangles are seen and in one patch."""
    mesh.check()
    count = len(mesh.facets)
    return mesh.boundary or Boundary(
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


def nodes_and_triangles(facets: IntArray) -> tuple[IntArray, IntArray]:
    """Return the nodes that triangles (f, 3) use, ascending, shape (m,), and the triangles in numbers of these, (f, 3).

    >>> nodes_and_triangles(np.array([[3, 0, 2]]))[1].tolist()
    [[2, 0, 1]]
    """
    nodes, triangles = np.unique(facets, return_inverse=True)
    return nodes, triangles.reshape(-1, 3)
