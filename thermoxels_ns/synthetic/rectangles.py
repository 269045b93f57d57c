"""Axis-aligned rectangles in space: the exact surface of a solid made of boxes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

_PAIRS_PER_CHUNK = 1_000_000

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rectangles:
    """A list of axis-aligned rectangles, each with an outward normal along one axis."""

    lo: FloatArray
    """Lower corners [m], shape (m, 3); equal to `hi` along the rectangle's own axis."""
    hi: FloatArray
    """Upper corners [m], shape (m, 3)."""
    axis: npt.NDArray[np.int64]
    """Axis each normal is parallel to (0, 1 or 2), shape (m,)."""
    sign: npt.NDArray[np.int64]
    """Direction of each normal along its axis (+1 or -1), shape (m,)."""

    def __len__(self) -> int:
        return len(self.axis)

    @cached_property
    def areas(self) -> FloatArray:
        """Area of each rectangle [m2], shape (m,)."""
        sides = self.hi - self.lo
        sides[np.arange(len(self)), self.axis] = 1.0
        return np.prod(sides, axis=1)

    @cached_property
    def normals(self) -> FloatArray:
        """Outward unit normals, shape (m, 3)."""
        normals = np.zeros((len(self), 3))
        normals[np.arange(len(self)), self.axis] = self.sign
        return normals

    @cached_property
    def by_plane(self) -> list[tuple[int, int, float, npt.NDArray[np.int64]]]:
        """Rectangles that share a plane and a side: axis, sign, coordinate [m] and the rectangles' numbers."""
        coordinate = self.lo[np.arange(len(self)), self.axis]
        planes, group = np.unique(np.stack([self.axis, self.sign, coordinate], axis=1), axis=0, return_inverse=True)
        return [
            (int(axis), int(sign), float(at), np.flatnonzero(group.reshape(-1) == number))
            for number, (axis, sign, at) in enumerate(planes)
        ]

    def distance(self, points: npt.ArrayLike) -> FloatArray:
        """Distance from each point to the nearest rectangle.

        Args:
            points: Positions [m], shape (n, 3).

        Returns:
            Distances [m], at least 0, shape (n,).
        """
        points = np.asarray(points, dtype=np.float64)
        nearest = np.empty(len(points))
        step = max(_PAIRS_PER_CHUNK // len(self), 1)
        for start in range(0, len(points), step):
            chunk = points[start : start + step]
            squared = np.zeros((len(chunk), len(self)))
            for a in range(3):
                coordinate = chunk[:, a : a + 1]
                gap = coordinate - np.clip(coordinate, self.lo[:, a], self.hi[:, a])
                squared += gap * gap
            nearest[start : start + step] = np.sqrt(squared.min(axis=1))
        return nearest


def distance_to_box(points: npt.ArrayLike, lo: npt.ArrayLike, hi: npt.ArrayLike) -> FloatArray:
    """Distance from each point (n, 3) to a solid box, 0 inside it [m].

    >>> float(distance_to_box([[4.0, 5.0, 0.5]], (0, 0, 0), (1, 1, 1))[0])
    5.0
    """
    points = np.asarray(points, dtype=np.float64)
    gap = points - np.clip(points, np.asarray(lo, dtype=np.float64), np.asarray(hi, dtype=np.float64))
    return np.sqrt(np.einsum("ij,ij->i", gap, gap))


def exposed_rectangles(cells: npt.NDArray[np.bool_], edges: tuple[FloatArray, FloatArray, FloatArray]) -> Rectangles:
    """Collect the faces between filled and empty cells, merged into large rectangles.

    Args:
        cells: Which cells of a non-uniform grid are filled, shape (nx, ny, nz).
        edges: Increasing coordinates of the grid planes along each axis [m], lengths nx + 1, ny + 1, nz + 1.

    Returns:
        Rectangles that cover the boundary of the filled cells once, without overlap.
    """
    padded = np.pad(cells, 1)
    corners_lo, corners_hi, axes, signs = [], [], [], []
    for axis in range(3):
        u, v = (a for a in range(3) if a != axis)
        before = np.moveaxis(padded, axis, 0)[:-1, 1:-1, 1:-1]
        after = np.moveaxis(padded, axis, 0)[1:, 1:-1, 1:-1]
        for sign, faces in ((1, before & ~after), (-1, after & ~before)):
            for plane, mask in enumerate(faces):
                for u0, u1, v0, v1 in _merged_blocks(mask):
                    lo, hi = np.empty(3), np.empty(3)
                    lo[axis] = hi[axis] = edges[axis][plane]
                    lo[u], hi[u] = edges[u][u0], edges[u][u1]
                    lo[v], hi[v] = edges[v][v0], edges[v][v1]
                    corners_lo.append(lo)
                    corners_hi.append(hi)
                    axes.append(axis)
                    signs.append(sign)
    return Rectangles(
        np.reshape(corners_lo, (-1, 3)),
        np.reshape(corners_hi, (-1, 3)),
        np.array(axes, dtype=np.int64),
        np.array(signs, dtype=np.int64),
    )


def _merged_blocks(mask: npt.NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Cover the true entries of a mask by disjoint blocks [u0, u1) x [v0, v1), greedily along v, then u."""
    left = mask.copy()
    blocks = []
    for u0, v0 in np.argwhere(mask):
        if not left[u0, v0]:
            continue
        v1 = v0 + 1
        while v1 < left.shape[1] and left[u0, v1]:
            v1 += 1
        u1 = u0 + 1
        while u1 < left.shape[0] and left[u1, v0:v1].all():
            u1 += 1
        left[u0:u1, v0:v1] = False
        blocks.append((int(u0), int(u1), int(v0), int(v1)))
    return blocks
