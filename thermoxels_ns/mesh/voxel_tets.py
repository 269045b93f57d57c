"""Meshes along voxel faces: six conforming tetrahedra per voxel, their boundary and their edges."""

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
"""Voxel corners (`CORNER_OFFSETS`) of the six tetrahedra around the main diagonal, shape (6, 4), positively oriented.

Each permutation of the axes a, b, c gives a path 000 -> e_a -> e_a + e_b -> 111 along voxel edges (Kuhn 1960,
Freudenthal 1942); if the sign of the permutation is negative, the two corners in the middle are exchanged."""


def kuhn_tets(cells: BoolArray) -> tuple[IntArray, IntArray]:
    """Return six tetrahedra for every solid voxel, which share the voxel's main diagonal.

    The diagonal has the same direction in every voxel, so the mesh conforms. All dihedral angles are 45, 60 or 90
    degrees, so solutions of the heat equation keep the maximum principle.

    Returns:
        corner_indices: Lattice indices (i, j, k) of the corners of solid voxels, the nodes, in C order, shape (n, 3).
        tets: Row numbers in `corner_indices`, shape (6 * solid voxels, 4), positively oriented.

    >>> corners, tets = kuhn_tets(np.ones((1, 1, 1), dtype=bool))
    >>> corners.shape, tets.shape
    ((8, 3), (6, 4))
    """
    cells, number, first = _node_numbers(cells)
    strides = np.array([number.shape[1] * number.shape[2], number.shape[2], 1], dtype=np.int64)
    corners = (np.argwhere(cells) @ strides)[:, None] + CORNER_OFFSETS @ strides
    tets = number.ravel()[corners][:, KUHN_PATTERN].reshape(-1, 4)
    return np.argwhere(number >= 0) + first, tets


def used_corners(cells: BoolArray) -> IntArray:
    """Return the lattice indices (n, 3) of the corners of solid voxels in C order: the nodes of `kuhn_tets`."""
    number, first = _node_numbers(cells)[1:]
    return np.argwhere(number >= 0) + first


def lattice_edges(cells: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the edges of solid voxels, (e, 2) nodes of `kuhn_tets`, and how many solid voxels have each edge, (e,).

    Two neighbouring corners with only empty voxels around their connection are not joined by an edge.
    """
    cells, number, _ = _node_numbers(cells)
    flat_number = number.ravel()
    strides = (number.shape[1] * number.shape[2], number.shape[2], 1)
    edges, counts = [], []
    for axis in range(3):
        # This is the number of solid voxels around the edge that starts in each corner.
        around = np.zeros(number.shape, dtype=np.uint8)
        for offset in CORNER_OFFSETS[CORNER_OFFSETS[:, axis] == 0]:
            around[tuple(slice(o, o + n) for o, n in zip(offset, cells.shape))] += cells
        start = np.flatnonzero(around)
        edges.append(np.stack([flat_number[start], flat_number[start + strides[axis]]], axis=-1))
        counts.append(around.ravel()[start].astype(np.int64))
    return np.concatenate(edges), np.concatenate(counts)


def voxel_facets(cells: BoolArray) -> IntArray:
    """Return the boundary triangles of `kuhn_tets`, (f, 3), normals outwards: two per face between solid and empty.

    Each face is cut along the diagonal from its lowest to its highest corner, as `kuhn_tets` does.

    >>> voxel_facets(np.ones((1, 1, 1), dtype=bool)).shape
    (12, 3)
    """
    cells, number, _ = _node_numbers(cells)
    facets = []
    for axis in range(3):
        u, v = np.eye(3, dtype=np.int64)[(axis + 1) % 3], np.eye(3, dtype=np.int64)[(axis + 2) % 3]
        width = [(0, 0)] * 3
        width[axis] = (1, 1)
        steps = np.diff(np.pad(cells, width).astype(np.int8), axis=axis)
        for turned in (True, False):  # turned: the solid is above the face and the normal points down the axis
            low = np.argwhere(steps == (1 if turned else -1))
            a, b, c, d = (number[tuple((low + offset).T)] for offset in (0, u, u + v, v))
            pair = [(a, c, b), (a, d, c)] if turned else [(a, b, c), (a, c, d)]
            facets.append(np.stack([np.stack(triangle, axis=-1) for triangle in pair], axis=1).reshape(-1, 3))
    return np.concatenate(facets)


def boundary_tags(facets: IntArray, points_index: npt.NDArray, lattice_shape: tuple[int, ...]) -> IntArray:
    """Return `FACET_BOX` for facets on a side of the lattice, else `FACET_SURFACE`, (f,); points are corner indices."""
    # Each side of the lattice has one bit; a triangle lies on the sides that its three nodes have in common.
    sides = np.zeros(len(points_index), dtype=np.uint8)
    for axis, count in enumerate(lattice_shape):
        sides |= (points_index[:, axis] == 0).astype(np.uint8) << (2 * axis)
        sides |= (points_index[:, axis] == count - 1).astype(np.uint8) << (2 * axis + 1)
    common = sides[facets[:, 0]] & sides[facets[:, 1]] & sides[facets[:, 2]]
    return np.where(common > 0, FACET_BOX, FACET_SURFACE).astype(np.int64)


def _node_numbers(cells: BoolArray) -> tuple[BoolArray, IntArray, IntArray]:
    """Return the cells of the solid's bounding box, the node numbers of their corners, and the box's first index.

    Nodes are numbered in C order; corners of no solid voxel have -1. Corners are one more than cells along each axis.
    """
    box = bounding_box(cells)
    cells, first = np.ascontiguousarray(cells[box]), np.array([part.start for part in box], dtype=np.int64)
    nx, ny, nz = cells.shape
    used = np.zeros((nx + 1, ny + 1, nz + 1), dtype=bool)
    for dx, dy, dz in CORNER_OFFSETS:
        used[dx : dx + nx, dy : dy + ny, dz : dz + nz] |= cells
    number = np.cumsum(used.ravel(), dtype=np.int64).reshape(used.shape) - 1
    number[~used] = -1
    return cells, number, first
