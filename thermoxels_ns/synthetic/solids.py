"""Exact solids: boxes with boxes cut out, and spheres.

Every solid is a closed set and answers, without approximation, where a point lies, how far the surface is, how
large volume and area are, and where a ray first enters. Lengths are metres; nothing here depends on a lattice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.rectangles import Rectangles, exposed_rectangles

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]
FloatArray = npt.NDArray[np.float64]

_COORDINATE_DECIMALS = 12
_EDGE_TOLERANCE = 1e-9
_RAYS_PER_CHUNK = 16_384


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays first enter a solid."""

    distance: FloatArray
    """Distance along the ray in multiples of its direction's length (metres for unit directions); infinite for a
    miss. Shape (n,)."""
    normal: FloatArray
    """Outward unit normal at the hit, zero for a miss. Shape (n, 3)."""

    @property
    def hit(self) -> npt.NDArray[np.bool_]:
        """Which rays hit, shape (n,)."""
        return np.isfinite(self.distance)


class Solid(Protocol):
    """What every exact solid can tell.

    `intersect` counts only the points where a ray passes from outside to inside, the surface's front: a ray that
    starts within the solid does not see its walls from behind. Touching an edge counts as a hit.
    """

    @property
    def bounds(self) -> Box:
        """Lower and upper corner of the smallest box around the solid [m]."""
        ...

    @property
    def volume(self) -> float:
        """Volume [m3]."""
        ...

    @property
    def area(self) -> float:
        """Area of the surface [m2]."""
        ...

    def contains(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of the points (n, 3) lie in the solid or on its surface."""
        ...

    def signed_distance(self, points: npt.ArrayLike) -> FloatArray:
        """Distance of the points (n, 3) to the surface [m], negative inside."""
        ...

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """First entry of rays: origins (n, 3) or one shared (3,), directions (n, 3)."""
        ...

    def surface_points(self, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
        """Draw points uniformly by area: positions (count, 3) and outward normals (count, 3)."""
        ...


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
    removed: Sequence[Box] = ()
    """Lower and upper corners [m] of the boxes to cut out."""

    def __post_init__(self) -> None:
        for name, boxes in (("boxes", self.boxes), ("removed", self.removed)):
            for number, (lo, hi) in enumerate(boxes):
                if not (np.isfinite([lo, hi]).all() and np.all(np.less(lo, hi))):
                    raise SceneError(
                        f"{name}[{number}]",
                        expected="finite corners with lo below hi along every axis",
                        got=f"{lo} to {hi}",
                        remedy="Swap or correct the corners.",
                    )
        if not (self.boxes and self._cells.any()):
            raise SceneError(
                "boxes",
                expected="a solid with a volume above 0",
                got=f"{len(self.boxes)} boxes of which the {len(self.removed)} removed ones leave nothing",
                remedy="Add a box or remove less.",
            )

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
        return _corners(self.rectangles.lo.min(axis=0), self.rectangles.hi.max(axis=0))

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
        x, y, z = (
            [np.searchsorted(e, points[:, a], side=side) for side in ("left", "right")]
            for a, e in enumerate(self._edges)
        )
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
            distance[part], rectangle[part] = self._first_rectangle(
                np.ascontiguousarray(origins[part].T), np.ascontiguousarray(directions[part].T)
            )
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
class Sphere:
    """A ball."""

    centre: Vector
    """Centre [m]."""
    radius: float
    """Radius [m], above 0."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.centre).all() and math.isfinite(self.radius) and self.radius > 0):
            raise SceneError(
                "sphere",
                expected="a finite centre and a radius above 0",
                got=f"centre {self.centre}, radius {self.radius}",
                remedy="Correct the two.",
            )

    @property
    def bounds(self) -> Box:
        """Lower and upper corner of the smallest box around the solid [m]."""
        return _corners(np.subtract(self.centre, self.radius), np.add(self.centre, self.radius))

    @property
    def volume(self) -> float:
        """Volume [m3]."""
        return 4.0 / 3.0 * math.pi * self.radius**3

    @property
    def area(self) -> float:
        """Area of the surface [m2]."""
        return 4.0 * math.pi * self.radius**2

    def contains(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of the points (n, 3) lie in the solid or on its surface."""
        return self.signed_distance(points) <= 0.0

    def signed_distance(self, points: npt.ArrayLike) -> FloatArray:
        """Distance of the points (n, 3) to the surface [m], negative inside."""
        return np.linalg.norm(np.subtract(points, self.centre), axis=-1) - self.radius

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """First entry of rays: origins (n, 3) or one shared (3,), directions (n, 3).

        The half chord comes from the foot of the perpendicular, which does not cancel for far origins.
        """
        directions = np.asarray(directions, dtype=np.float64)
        from_centre = np.broadcast_to(np.subtract(origins, self.centre), directions.shape)
        length_squared = np.einsum("ij,ij->i", directions, directions)
        foot = -np.einsum("ij,ij->i", from_centre, directions) / length_squared
        perpendicular = from_centre + foot[:, None] * directions
        half_chord_squared = self.radius**2 - np.einsum("ij,ij->i", perpendicular, perpendicular)
        t = foot - np.sqrt(np.maximum(half_chord_squared, 0.0) / length_squared)
        hit = (half_chord_squared >= 0.0) & (t >= 0.0)
        distance = np.where(hit, t, np.inf)
        normal = (from_centre + np.where(hit, t, 0.0)[:, None] * directions) / self.radius
        return Hits(distance, np.where(hit[:, None], normal, 0.0))

    def surface_points(self, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
        """Draw points uniformly by area: positions (count, 3) and outward normals (count, 3)."""
        normals = np.random.default_rng(seed).standard_normal((count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(self.centre) + self.radius * normals, normals


def _corners(lo: npt.ArrayLike, hi: npt.ArrayLike) -> Box:
    x0, y0, z0 = (float(v) for v in np.asarray(lo))
    x1, y1, z1 = (float(v) for v in np.asarray(hi))
    return (x0, y0, z0), (x1, y1, z1)
