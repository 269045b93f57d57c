"""Solids made of axis-aligned boxes, with their exact surface as rectangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.synthetic.solids import Box, Hits, box_beside, box_between

FloatArray = npt.NDArray[np.float64]

_COORDINATE_DECIMALS = 12
_EDGE_TOLERANCE = 1e-9
_RAYS_PER_CHUNK = 16_384
_PAIRS_PER_CHUNK = 1_000_000


@dataclass(frozen=True, eq=False)
class BoxSolid:
    """The union of axis-aligned boxes, minus other axis-aligned boxes.

    All `boxes` are joined first, then all `removed` ones are cut out. The coordinates of all faces span a small
    non-uniform grid whose cells are filled or empty; the surface is the list of rectangles between the two kinds.

    >>> notched = BoxSolid([((0, 0, 0), (2, 1, 1))], removed=[((1, 0, 0.5), (2, 1, 1))])
    >>> notched.volume, notched.area
    (1.5, 9.0)
    """

    boxes: Sequence[Box]
    """Lower and upper corners [m] of the boxes to join; rounded to 1e-12 m so that touching faces coincide."""
    removed: Sequence[Box] = ()  # lower and upper corners [m] of the boxes to cut out

    def __post_init__(self) -> None:
        for lo, hi in (*self.boxes, *self.removed):
            assert np.isfinite([lo, hi]).all() and np.all(np.less(lo, hi)), f"no box: {lo} to {hi}"
        assert self.boxes and self._cells.any(), "nothing is left of the boxes"

    @cached_property
    def _edges(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coordinates of all faces along each axis, sorted and unique."""
        corners = np.round(np.array([*self.boxes, *self.removed], dtype=np.float64), _COORDINATE_DECIMALS)
        x, y, z = (np.unique(corners[..., a]) for a in range(3))
        return x, y, z

    @cached_property
    def _cells(self) -> npt.NDArray[np.bool_]:
        """Which cells of the grid between the faces are filled."""
        cells = np.zeros([len(e) - 1 for e in self._edges], dtype=bool)
        for boxes, value in ((self.boxes, True), (self.removed, False)):
            for lo, hi in np.round(np.array(boxes, dtype=np.float64).reshape(-1, 2, 3), _COORDINATE_DECIMALS):
                cells[tuple(slice(*np.searchsorted(e, (lo[a], hi[a]))) for a, e in enumerate(self._edges))] = value
        return cells

    @cached_property
    def rectangles(self) -> Rectangles:
        """The exposed surface."""
        return exposed_rectangles(self._cells, self._edges)

    @property
    def filled_boxes(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corners (n, 3) of disjoint boxes that fill the solid [m]."""
        index = np.argwhere(self._cells)
        lo = np.stack([self._edges[a][index[:, a]] for a in range(3)], axis=1)
        hi = np.stack([self._edges[a][index[:, a] + 1] for a in range(3)], axis=1)
        return lo, hi

    @property
    def bounds(self) -> Box:
        """Lower and upper corner of the smallest box around the solid [m]."""
        return box_between(self.rectangles.lo.min(axis=0), self.rectangles.hi.max(axis=0))

    @property
    def volume(self) -> float:
        """Volume [m3]."""
        lo, hi = self.filled_boxes
        return float(np.prod(hi - lo, axis=1).sum())

    @property
    def area(self) -> float:
        """Area of the surface [m2]."""
        return float(self.rectangles.areas.sum())

    def contains(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of the points (n, 3) lie in the solid or on its surface."""
        points = np.asarray(points, dtype=np.float64)
        padded = np.pad(self._cells, 1)
        inside = np.zeros(len(points), dtype=bool)
        # A point on a grid plane belongs to the cells on both sides: the solid is closed.
        sides = ("left", "right")
        x, y, z = ([np.searchsorted(e, points[:, a], side=s) for s in sides] for a, e in enumerate(self._edges))
        for i in x:
            for j in y:
                for k in z:
                    inside |= padded[i, j, k]
        return inside

    def signed_distance(self, points: npt.ArrayLike) -> FloatArray:
        """Distance of the points (n, 3) to the surface [m], negative inside."""
        points = np.asarray(points, dtype=np.float64)
        distance = self.rectangles.distance(points)
        return np.where(self.contains(points), -distance, distance)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """First entry of rays: origins (n, 3) or one shared (3,), directions (n, 3).

        Rectangles are widened by 1e-9 of the solid's size, so that rounding lets no ray slip between two of them.
        """
        directions = np.asarray(directions, dtype=np.float64)
        origins = np.broadcast_to(np.asarray(origins, dtype=np.float64), directions.shape)
        distance = np.empty(len(directions))
        rectangle = np.empty(len(directions), dtype=np.int64)
        for start in range(0, len(directions), _RAYS_PER_CHUNK):
            part = slice(start, start + _RAYS_PER_CHUNK)
            rays = np.ascontiguousarray(origins[part].T), np.ascontiguousarray(directions[part].T)
            distance[part], rectangle[part] = self._first_rectangle(*rays)
        normals = np.concatenate([self.rectangles.normals, np.zeros((1, 3))])
        return Hits(distance, normals[rectangle])

    def _first_rectangle(self, origin: FloatArray, direction: FloatArray) -> tuple[FloatArray, npt.NDArray[np.int64]]:
        """Distance and index of the first rectangle each ray (columns) enters through; -1 for a miss."""
        count = direction.shape[1]
        best = np.full(count, np.inf)
        index = np.full(count, -1, dtype=np.int64)
        faces = self.rectangles
        slack = _EDGE_TOLERANCE * float(np.subtract(self.bounds[1], self.bounds[0]).max())
        # A nearly parallel ray may reach its plane at infinity; the comparisons below then are false, as they must.
        with np.errstate(over="ignore", invalid="ignore"):
            for axis, sign, coordinate, numbers in faces.by_plane:
                height = (origin[axis] - coordinate) * sign
                front = (height >= 0.0) & (direction[axis] * sign < 0.0)
                if not front.any():
                    continue
                t = (coordinate - origin[axis]) / np.where(front, direction[axis], 1.0)
                front &= t < best
                u, v = (a for a in range(3) if a != axis)
                at_u, at_v = origin[u] + t * direction[u], origin[v] + t * direction[v]
                for number in numbers:
                    lo, hi = faces.lo[number] - slack, faces.hi[number] + slack
                    entered = front & (at_u >= lo[u]) & (at_u <= hi[u]) & (at_v >= lo[v]) & (at_v <= hi[v])
                    best[entered] = t[entered]
                    index[entered] = number
        return best, index

    def surface_points(self, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
        """Draw points uniformly by area: positions (count, 3) and outward normals (count, 3)."""
        draw = np.random.default_rng(seed)
        faces = self.rectangles
        chosen = draw.choice(len(faces), size=count, p=faces.areas / faces.areas.sum())
        share = draw.random((count, 3))
        points = faces.lo[chosen] + share * (faces.hi[chosen] - faces.lo[chosen])
        return points, faces.normals[chosen]


@dataclass(frozen=True, eq=False)
class Rectangles:
    """A list of axis-aligned rectangles, each with an outward normal along one axis."""

    lo: FloatArray  # lower corners [m], shape (m, 3); equal to `hi` along the rectangle's own axis
    hi: FloatArray  # upper corners [m], shape (m, 3)
    axis: npt.NDArray[np.int64]  # axis each normal is parallel to (0, 1 or 2), shape (m,)
    sign: npt.NDArray[np.int64]  # direction of each normal along its axis (+1 or -1), shape (m,)

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
        """Distance from each point (n, 3) to the nearest rectangle [m], at least 0, shape (n,)."""
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


def recesses(openings: Sequence[tuple[Any, ...]], depth_m: float, pane_m: float) -> tuple[list[Box], list[Box]]:
    """Boxes cut out of walls for openings, and the boxes of the panes behind them.

    An opening begins with its plane's axis, outward sign and position, (along the wall from, to) and (z from, to).
    """
    cut, panes = [], []
    for axis, sign, plane, along, height, *_ in openings:
        back = plane - sign * depth_m
        cut.append(box_beside(axis, (plane, back), along, height))
        panes.append(box_beside(axis, (back, back - sign * pane_m), along, height))
    return cut, panes


def exposed_rectangles(cells: npt.NDArray[np.bool_], edges: tuple[FloatArray, FloatArray, FloatArray]) -> Rectangles:
    """Cover the boundary between filled and empty cells (nx, ny, nz) once, by large rectangles.

    `edges` are the increasing coordinates of the grid's planes [m], one more than cells along each axis.
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
    corners = np.reshape(corners_lo, (-1, 3)), np.reshape(corners_hi, (-1, 3))
    return Rectangles(*corners, np.array(axes, dtype=np.int64), np.array(signs, dtype=np.int64))


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
