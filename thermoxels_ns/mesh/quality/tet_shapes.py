"""Shapes of tetrahedra: volumes, dihedral angles and stiffness entries."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray

TET_EDGES: IntArray = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], dtype=np.int64)
"""Node positions of the two ends of a tetrahedron's six edges, shape (6, 2)."""
_CHUNK = 1 << 14  # tetrahedra worked on at a time, so that their data stay in the processor's cache
_FACE_PAIRS = ((2, 3), (1, 3), (1, 2), (0, 3), (0, 2), (0, 1))
"""For each edge of `TET_EDGES` the two faces that meet in the edge; face f is opposite node f."""
_ANGLE_ROUND_OFF = 32.0 * float(np.finfo(np.float64).eps)
"""Upper estimate of the round-off of the cosine of an angle, for a tetrahedron as large as its largest coordinate."""


@dataclass(frozen=True)
class TetShapes:
    """Sides, face normals and volumes of tetrahedra; every tetrahedron is one column of the arrays."""

    sides: tuple[FloatArray, FloatArray, FloatArray]
    """Vectors from node 0 to nodes 1, 2 and 3, each of shape (3, t), [m]."""
    normals: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    """Inward normals of the faces opposite nodes 0 to 3, with twice the face's area as length, each (3, t), [m^2]."""
    six_volumes: FloatArray  # six times the signed volume, shape (t,), [m^3]
    reach: float  # largest coordinate of the mesh in magnitude, from which round-off is estimated, [m]

    def dihedral_cosines(self) -> FloatArray:
        """Return the cosines of the dihedral angles at `TET_EDGES`, (6, t); angles at a face without area are 0."""
        lengths = [np.sqrt(_dot(normal, normal)) for normal in self.normals]
        cosines = np.empty((6, len(self.six_volumes)))
        for edge, (i, j) in enumerate(_FACE_PAIRS):
            scale = lengths[i] * lengths[j]
            cosine = np.divide(-_dot(self.normals[i], self.normals[j]), scale, out=cosines[edge], where=scale > 0.0)
            cosine[scale == 0.0] = 1.0
        return np.clip(cosines, -1.0, 1.0, out=cosines)

    @property
    def flatness(self) -> FloatArray:
        """Return the least height of each tetrahedron over its longest side along an axis, below 0 if turned over."""
        largest = np.sqrt(np.max([_dot(normal, normal) for normal in self.normals], axis=0))
        return np.divide(self.six_volumes, largest * self.size, out=np.zeros_like(largest), where=largest > 0.0)

    @property
    def size(self) -> FloatArray:
        """Return the longest extent of the sides along an axis, shape (t,), [m]."""
        return np.max([np.abs(side).max(axis=0) for side in self.sides], axis=0)

    def stiffness(self) -> FloatArray:
        """Return the stiffness entries of each tetrahedron's edges at conductivity 1, shape (6, t), [m].

        For linear shape functions f the entry of edge ij is V grad(f_i) . grad(f_j) = n_i . n_j / (36 V) (`normals` n).
        This equals -l cot(a) / 6 with the length l of the opposite edge and the dihedral angle a there: the entry is
        positive if a is obtuse, and 0 if a is right up to round-off of the coordinates, or if V is 0.
        """
        entries = np.empty((6, len(self.six_volumes)))
        weight = np.zeros_like(self.six_volumes)
        np.divide(1.0, 6.0 * self.six_volumes, out=weight, where=self.six_volumes != 0.0)
        squares = [_dot(normal, normal) for normal in self.normals]
        right = _ANGLE_ROUND_OFF * self.reach / np.maximum(self.size, np.finfo(np.float64).tiny)
        # Nodes i and j of edge e lie opposite the two faces that meet in the opposite edge, which is edge 5 - e.
        for edge, (i, j) in enumerate(reversed(_FACE_PAIRS)):
            product = _dot(self.normals[i], self.normals[j])
            product[np.abs(product) <= right * np.minimum(squares[i], squares[j])] = 0.0
            np.multiply(product, weight, out=entries[edge])
        return entries


def shapes_in_chunks(points: FloatArray, tets: IntArray) -> Iterator[tuple[slice, TetShapes]]:
    """Yield, for one chunk of tetrahedra (t, 4) after another, its slice of `tets` and its shapes, to save memory."""
    columns = np.ascontiguousarray(np.asarray(points, dtype=np.float64).T)
    reach = float(np.abs(columns).max(initial=0.0))
    for start in range(0, len(tets), _CHUNK):
        which = slice(start, min(start + _CHUNK, len(tets)))
        nodes = np.ascontiguousarray(tets[which].T)
        origin = columns.take(nodes[0], axis=1)
        a, b, c = (columns.take(nodes[n], axis=1) - origin for n in (1, 2, 3))
        one, two, three = _cross(b, c), _cross(c, a), _cross(a, b)
        yield which, TetShapes((a, b, c), (-(one + two + three), one, two, three), _dot(a, one), reach)


def signed_volumes(points: FloatArray, tets: IntArray) -> FloatArray:
    """Return volumes det(p1 - p0, p2 - p0, p3 - p0) / 6, shape (t,), [m^3]; negative for tetrahedra turned over."""
    volumes = np.empty(len(tets))
    for which, shapes in shapes_in_chunks(points, tets):
        volumes[which] = shapes.six_volumes / 6.0
    return volumes


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross products of the columns of a and b, shape (3, t)."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=out[i])
        out[i] -= a[k] * b[j]
    return out


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the dot products of the columns of a and b, shape (t,)."""
    out = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return out
