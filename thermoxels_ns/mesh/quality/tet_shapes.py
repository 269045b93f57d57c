"""Shapes of tetrahedra: volumes, flatness, dihedral angles and stiffness entries, all compiled."""

from __future__ import annotations

import math

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.kernel_cache import kernel

TET_EDGES: IntArray = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], dtype=np.int64)
"""Node positions of the two ends of a tetrahedron's six edges, shape (6, 2)."""
_FACE_PAIRS = ((2, 3), (1, 3), (1, 2), (0, 3), (0, 2), (0, 1))
"""The two faces that meet in each edge of `TET_EDGES`; face f is opposite node f."""
_ANGLE_ROUND_OFF = 32.0 * float(np.finfo(np.float64).eps)
"""Upper estimate of the round-off of a cosine if the tetrahedron's size equals its largest coordinate."""
_LEAST = float(np.finfo(np.float64).tiny)


def signed_volumes(points: FloatArray, tets: IntArray) -> FloatArray:
    """Return signed volumes det(p1 - p0, p2 - p0, p3 - p0) / 6, shape (t,), [m^3]; negative for inverted tetrahedra."""
    volumes = np.empty(len(tets))
    _volumes(*_checked(points, tets), volumes)
    return volumes


def flatness(points: FloatArray, tets: IntArray) -> FloatArray:
    """Return each tetrahedron's least height divided by its size, shape (t,); below 0 if it is inverted. The size is
    the largest x, y or z component of the sides at node 0."""
    flat = np.zeros(len(tets))
    _flatness(*_checked(points, tets), flat)
    return flat


def dihedral_cosines(points: FloatArray, tets: IntArray) -> FloatArray:
    """Return cosines of the dihedral angles at `TET_EDGES`, shape (t, 6); 1 at a face without area."""
    cosines = np.ones((len(tets), 6))
    _cosines(*_checked(points, tets), cosines)
    return cosines


def edge_stiffness(points: FloatArray, tets: IntArray) -> FloatArray:
    """Return the off-diagonal entries of each linear tetrahedron's stiffness matrix at conductivity 1, (t, 6), [m].

    The entry of edge ij in `TET_EDGES` is V grad(f_i) . grad(f_j) = n_i . n_j / (36 V) with the volume V, the shape
    functions f, and the normal n_i of the face opposite node i, of twice its area in length. This equals
    -l cot(a) / 6 with the length l and the dihedral angle a of the opposite edge. The entry is positive if a is obtuse.
    It is 0 if a differs from 90 degrees by round-off of the coordinates only, or if V is 0.
    """
    entries = np.zeros((len(tets), 6))
    _stiffness(*_checked(points, tets), _ANGLE_ROUND_OFF * float(np.abs(points).max(initial=0.0)), entries)
    return entries


def _checked(points: FloatArray, tets: IntArray) -> tuple[FloatArray, IntArray]:
    if len(tets) and not 0 <= tets.min() <= tets.max() < len(points):
        raise IndexError(f"nodes {tets.min()} to {tets.max()} of tetrahedra, but there are {len(points)} points")
    return np.ascontiguousarray(points, dtype=np.float64), np.ascontiguousarray(tets, dtype=np.int64)


@kernel
def _shape(points: FloatArray, tet: IntArray, normals: FloatArray, squares: FloatArray):
    """Return six times a tetrahedron's signed volume, and its size as `flatness` defines it.

    Row f of `normals` (4, 3) is overwritten with the inward normal of the face opposite node f, of twice the area in
    length; entry f of `squares` (4,) with the square of this length.
    """
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = _sides(points, tet)
    normals[1, 0], normals[1, 1], normals[1, 2] = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    normals[2, 0], normals[2, 1], normals[2, 2] = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    normals[3, 0], normals[3, 1], normals[3, 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    for k in range(3):
        normals[0, k] = -(normals[1, k] + normals[2, k] + normals[3, k])
    for face in range(4):
        squares[face] = _dot(normals, face, face)
    size = max(abs(ax), abs(ay), abs(az), abs(bx), abs(by), abs(bz), abs(cx), abs(cy), abs(cz))
    return ax * normals[1, 0] + ay * normals[1, 1] + az * normals[1, 2], size


@kernel
def _sides(points: FloatArray, tet: IntArray):
    """Return the vectors from node 0 of a tetrahedron to nodes 1, 2 and 3, [m]."""
    ox, oy, oz = points[tet[0], 0], points[tet[0], 1], points[tet[0], 2]
    a, b, c = tet[1], tet[2], tet[3]
    one = (points[a, 0] - ox, points[a, 1] - oy, points[a, 2] - oz)
    two = (points[b, 0] - ox, points[b, 1] - oy, points[b, 2] - oz)
    return one, two, (points[c, 0] - ox, points[c, 1] - oy, points[c, 2] - oz)


@kernel
def _dot(rows: FloatArray, i: int, j: int):
    return rows[i, 0] * rows[j, 0] + rows[i, 1] * rows[j, 1] + rows[i, 2] * rows[j, 2]


@kernel
def _volumes(points: FloatArray, tets: IntArray, volumes: FloatArray):
    for t in range(len(tets)):
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = _sides(points, tets[t])
        volumes[t] = (ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)) / 6.0


@kernel
def _flatness(points: FloatArray, tets: IntArray, flat: FloatArray):
    normals, squares = np.empty((4, 3)), np.empty(4)
    for t in range(len(tets)):
        six_volumes, size = _shape(points, tets[t], normals, squares)
        largest = math.sqrt(max(squares[0], squares[1], squares[2], squares[3]))
        if largest > 0.0:
            flat[t] = six_volumes / (largest * size)


@kernel
def _cosines(points: FloatArray, tets: IntArray, cosines: FloatArray):
    normals, squares = np.empty((4, 3)), np.empty(4)
    for t in range(len(tets)):
        _shape(points, tets[t], normals, squares)
        for edge, (i, j) in enumerate(_FACE_PAIRS):
            scale = math.sqrt(squares[i]) * math.sqrt(squares[j])
            if scale > 0.0:
                cosines[t, edge] = min(max(-_dot(normals, i, j) / scale, -1.0), 1.0)


@kernel
def _stiffness(points: FloatArray, tets: IntArray, round_off_m: float, entries: FloatArray):
    normals, squares = np.empty((4, 3)), np.empty(4)
    for t in range(len(tets)):
        six_volumes, size = _shape(points, tets[t], normals, squares)
        right = round_off_m / max(size, _LEAST)
        # Nodes i and j of edge e lie opposite the two faces that meet in the opposite edge, which is edge 5 - e.
        for edge, (i, j) in enumerate(_FACE_PAIRS):
            product = _dot(normals, i, j)
            if six_volumes != 0.0 and abs(product) > right * min(squares[i], squares[j]):
                entries[t, 5 - edge] = product * (1.0 / (6.0 * six_volumes))
