"""Meshes along voxel faces: six conforming tetrahedra per voxel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, IntArray
from thermoxels_ns.core.lattice import CORNER_OFFSETS
from thermoxels_ns.mesh.solid.morphology import bounding_box
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, FACET_SURFACE

KUHN_PATTERN: IntArray = np.array(
    [[0, 4, 6, 7], [0, 5, 4, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 1, 5, 7], [0, 3, 1, 7]], dtype=np.int64
)
"""Voxel corners (rows of `CORNER_OFFSETS`) of six tetrahedra around the main diagonal, (6, 4), positively oriented.

Each permutation a, b, c of the axes gives a path 000 -> e_a -> e_a + e_b -> 111 along voxel edges (Kuhn 1960,
Freudenthal 1942). If the sign of the permutation is negative, the two middle corners are exchanged."""


def kuhn_tets(cells: BoolArray) -> tuple[IntArray, IntArray]:
    """Return six tetrahedra per solid voxel, all at the voxel's main diagonal, and their nodes.

    The diagonal has the same direction in every voxel, so the mesh conforms. All dihedral angles are 45, 60 or 90
    degrees, so solutions of the heat equation satisfy the maximum principle.

    Returns:
        corner_indices: The nodes: lattice indices (i, j, k) of corners of solid voxels, in C order, shape (n, 3).
        tets: Nodes of tetrahedra, rows of `corner_indices`, shape (6 * solid voxels, 4), positively oriented.

    >>> corners, tets = kuhn_tets(np.ones((1, 1, 1), dtype=bool))
    >>> corners.shape, tets.shape
    ((8, 3), (6, 4))
    """
    box = bounding_box(cells)
    cells, first = cells[box], np.array([part.start for part in box], dtype=np.int64)
    nx, ny, nz = cells.shape
    used = np.zeros((nx + 1, ny + 1, nz + 1), dtype=bool)
    for dx, dy, dz in CORNER_OFFSETS:
        used[dx : dx + nx, dy : dy + ny, dz : dz + nz] |= cells
    number = np.cumsum(used.ravel(), dtype=np.int64) - 1
    strides = np.array([used.shape[1] * used.shape[2], used.shape[2], 1], dtype=np.int64)
    corners = (np.argwhere(cells) @ strides)[:, None] + CORNER_OFFSETS @ strides
    return np.argwhere(used) + first, number[corners][:, KUHN_PATTERN].reshape(-1, 4)


def boundary_tags(facets: IntArray, points_index: npt.NDArray, lattice_shape: tuple[int, ...]) -> IntArray:
    """Return `FACET_BOX` for triangles on a side of the lattice, else `FACET_SURFACE`, (f,). `points_index` (n, 3) are
    the nodes in corner indices; `lattice_shape` is the number of corners along each axis."""
    # A triangle lies on the sides of the lattice, of which there are six, that its three nodes have in common.
    sides = np.concatenate([points_index == 0, points_index == np.array(lattice_shape) - 1], axis=1)
    on_box = sides[facets].all(axis=1).any(axis=1)
    return np.where(on_box, FACET_BOX, FACET_SURFACE).astype(np.int64)
