"""Exact solids (balls, cylinders, boxes joined and cut, and unions of them) and where rays meet them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]

_COORDINATE_DECIMALS = 12
_EDGE_TOLERANCE = 1e-9
_PARALLEL_SINE_SQUARED = 1e-30


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays first enter a solid."""

    distance: FloatArray
    """Distance along the ray in multiples of its direction's length (metres for unit directions); infinite for a
    miss. Shape (n,)."""
    normal: FloatArray  # outward unit normal at the hit, zero for a miss. Shape (n, 3).

    @property
    def hit(self) -> BoolArray:
        """Which rays hit, shape (n,)."""
        return np.isfinite(self.distance)


class Solid(Protocol):
    """A closed set, lengths in metres; all that it tells is exact."""

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

    def contains(self, points: npt.ArrayLike, /) -> BoolArray:
        """Which of the points (n, 3) lie in the solid or on its surface."""
        return self.signed_distance(points) <= 0.0

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """Distance of the points (n, 3) to the surface [m], negative inside."""
        ...

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """First entry of rays: origins (n, 3) or one shared (3,), directions (n, 3).

        Only passing from outside to inside counts: a ray that starts within does not see walls from behind. Touching
        an edge counts as a hit.
        """
        ...

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """Draw points uniformly by area: positions (count, 3) and outward normals (count, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Sphere(Solid):
    """A ball; radius above 0 [m]."""

    centre: Vector
    radius: float

    @property
    def bounds(self) -> Box:
        """See `Solid`."""
        return box_between(np.subtract(self.centre, self.radius), np.add(self.centre, self.radius))

    @property
    def volume(self) -> float:
        """See `Solid`."""
        return 4.0 / 3.0 * math.pi * self.radius**3

    @property
    def area(self) -> float:
        """See `Solid`."""
        return 4.0 * math.pi * self.radius**2

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """See `Solid`."""
        return np.linalg.norm(np.subtract(points, self.centre), axis=-1) - self.radius

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """See `Solid`."""
        directions = np.asarray(directions, dtype=np.float64)
        start = np.broadcast_to(np.subtract(origins, self.centre), directions.shape)
        enter, _ = _through_circle(start, directions, self.radius)
        hit = np.isfinite(enter) & (enter >= 0.0)
        normal = (start + np.where(hit, enter, 0.0)[:, None] * directions) / self.radius
        return Hits(np.where(hit, enter, np.inf), np.where(hit[:, None], normal, 0.0))

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """See `Solid`."""
        normals = np.random.default_rng(seed).standard_normal((count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(self.centre) + self.radius * normals, normals


@dataclass(frozen=True, eq=False)
class Cylinder(Solid):
    """A closed circular cylinder with flat ends whose axis is parallel to x, y or z.

    >>> Cylinder((0.0, 0.0, 1.0), radius=0.5, length=2.0, axis=2).bounds
    ((-0.5, -0.5, 0.0), (0.5, 0.5, 2.0))
    """

    centre: Vector
    radius: float
    length: float  # middle of the axis, radius and length along the axis [m], above 0
    axis: int  # direction of the axis: 0 for x, 1 for y, 2 for z

    @property
    def bounds(self) -> Box:
        """See `Solid`."""
        half = np.where(np.arange(3) == self.axis, 0.5 * self.length, self.radius)
        return box_between(np.subtract(self.centre, half), np.add(self.centre, half))

    @property
    def volume(self) -> float:
        """See `Solid`."""
        return math.pi * self.radius**2 * self.length

    @property
    def area(self) -> float:
        """See `Solid`."""
        return 2.0 * math.pi * self.radius * (self.radius + self.length)

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """See `Solid`."""
        relative = np.subtract(points, self.centre)
        beside = np.linalg.norm(relative[:, self._across], axis=1) - self.radius
        beyond = np.abs(relative[:, self.axis]) - 0.5 * self.length
        outside = np.hypot(np.maximum(beside, 0.0), np.maximum(beyond, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(beside, beyond), 0.0), dtype=np.float64)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """See `Solid`. A ray enters where it is both between the planes of the ends and in the endless cylinder."""
        directions = np.asarray(directions, dtype=np.float64)
        start = np.broadcast_to(np.subtract(origins, self.centre), directions.shape)
        side_in, side_out = _through_circle(start[:, self._across], directions[:, self._across], self.radius)
        height, rise = start[:, self.axis], directions[:, self.axis]
        # A level ray meets the planes of the ends at infinity, to the same side of both if it runs above or below.
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            ends = (np.array([[-0.5], [0.5]]) * self.length - height) / rise
        end_in, end_out = np.fmin(*ends), np.fmax(*ends)
        entry = np.maximum(side_in, end_in)
        hit = (entry <= np.minimum(side_out, end_out)) & (entry >= 0.0) & np.isfinite(entry)
        through_end = hit & (end_in > side_in)
        normal = np.zeros(directions.shape)
        normal[through_end, self.axis] = -np.sign(rise[through_end])
        side = np.flatnonzero(hit & ~through_end)
        at = (start[side] + entry[side, None] * directions[side]) / self.radius
        at[:, self.axis] = 0.0
        normal[side] = at
        return Hits(np.where(hit, entry, np.inf), normal)

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """See `Solid`."""
        draw = np.random.default_rng(seed)
        on_side = draw.random(count) < self.length / (self.length + self.radius)
        angle = 2.0 * math.pi * draw.random(count)
        share, end = 2.0 * draw.random(count) - 1.0, np.where(draw.random(count) < 0.5, -1.0, 1.0)
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        normals, points = np.zeros((count, 3)), np.empty((count, 3))
        normals[:, self._across] = np.where(on_side[:, None], ring, 0.0)
        normals[:, self.axis] = np.where(on_side, 0.0, end)
        points[:, self._across] = self.radius * np.where(on_side, 1.0, np.sqrt(np.abs(share)))[:, None] * ring
        points[:, self.axis] = 0.5 * self.length * np.where(on_side, share, end)
        return points + self.centre, normals

    @property
    def _across(self) -> list[int]:
        """The two axes at right angles to the cylinder's."""
        return [a for a in range(3) if a != self.axis]


@dataclass(frozen=True, eq=False)
class BoxSolid(Solid):
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

    @cached_property
    def _edges(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coordinates of all faces along each axis, sorted and unique."""
        corners = np.round(np.array([*self.boxes, *self.removed], dtype=np.float64), _COORDINATE_DECIMALS)
        x, y, z = (np.unique(corners[..., a]) for a in range(3))
        return x, y, z

    @cached_property
    def _cells(self) -> BoolArray:
        """Which cells of the grid between the faces are filled."""
        cells = np.zeros([len(e) - 1 for e in self._edges], dtype=bool)
        for boxes, value in ((self.boxes, True), (self.removed, False)):
            for lo, hi in np.round(np.array(boxes, dtype=np.float64).reshape(-1, 2, 3), _COORDINATE_DECIMALS):
                cells[tuple(slice(*np.searchsorted(e, (lo[a], hi[a]))) for a, e in enumerate(self._edges))] = value
        assert cells.any(), "nothing is left of the boxes"
        return cells

    @cached_property
    def rectangles(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Lower corners, upper corners [m] and outward unit normals of rectangles that cover the surface once, (m, 3).

        They are large: neighbouring faces of cells are joined.
        """
        filled, found = np.pad(self._cells, 1).astype(np.int8), []
        for axis in range(3):
            u, v = (a for a in range(3) if a != axis)
            rise = np.moveaxis(np.diff(filled, axis=axis), axis, 0)[:, 1:-1, 1:-1]
            for sign in (1, -1):
                for plane, faces in enumerate(rise == -sign):
                    for u0, u1, v0, v1 in _merged_blocks(faces):
                        one = np.zeros((3, 3))
                        one[:2, axis], one[2, axis] = self._edges[axis][plane], sign
                        one[:2, u], one[:2, v] = self._edges[u][[u0, u1]], self._edges[v][[v0, v1]]
                        found.append(one)
        lo, hi, normals = np.stack(found, axis=1)
        return lo, hi, normals

    @cached_property
    def _planes(self) -> list[tuple[int, float, float, npt.NDArray[np.int64]]]:
        """Rectangles that share a plane and a side: axis, sign, coordinate [m] and the rectangles' numbers."""
        lo, _, normals = self.rectangles
        axis = np.abs(normals).argmax(axis=1)
        keys = np.stack([axis, normals.sum(axis=1), lo[np.arange(len(lo)), axis]], axis=1)
        planes, group = np.unique(keys, axis=0, return_inverse=True)
        return [(int(p[0]), p[1], p[2], np.flatnonzero(group.reshape(-1) == n)) for n, p in enumerate(planes)]

    @cached_property
    def _areas(self) -> FloatArray:
        lo, hi, normals = self.rectangles
        return np.prod(np.where(normals == 0.0, hi - lo, 1.0), axis=1)

    @property
    def bounds(self) -> Box:
        """See `Solid`."""
        return box_between(self.rectangles[0].min(axis=0), self.rectangles[1].max(axis=0))

    @property
    def volume(self) -> float:
        """See `Solid`."""
        x, y, z = (np.diff(edges) for edges in self._edges)
        return float(np.einsum("ijk,i,j,k->", self._cells, x, y, z))

    @property
    def area(self) -> float:
        """See `Solid`."""
        return float(self._areas.sum())

    def contains(self, points: npt.ArrayLike, /) -> BoolArray:
        """See `Solid`; a point on a plane of the grid belongs to the cells on both sides."""
        padded, inside = np.pad(self._cells, 1), np.zeros(len(np.asarray(points)), dtype=bool)
        x, y, z = (
            [np.searchsorted(e, at, side="left"), np.searchsorted(e, at, side="right")]
            for e, at in zip(self._edges, np.asarray(points, dtype=np.float64).T)
        )
        for i in x:
            for j in y:
                for k in z:
                    inside |= padded[i, j, k]
        return inside

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """See `Solid`."""
        nearest = np.full(len(np.asarray(points)), np.inf)
        for lo, hi in zip(*self.rectangles[:2]):
            nearest = np.minimum(nearest, distance_to_box(points, lo, hi))
        return np.where(self.contains(points), -nearest, nearest)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """See `Solid`. Rectangles are a billionth of the solid's size wider, so that no ray slips between two."""
        direction = np.ascontiguousarray(np.asarray(directions, dtype=np.float64).T)
        origin = np.ascontiguousarray(np.broadcast_to(origins, direction.T.shape).T, dtype=np.float64)
        lo, hi, normals = self.rectangles
        slack = _EDGE_TOLERANCE * float(np.subtract(self.bounds[1], self.bounds[0]).max())
        best, index = np.full(direction.shape[1], np.inf), np.full(direction.shape[1], -1)
        # A nearly parallel ray may reach its plane at infinity; the comparisons below then are false, as they must.
        with np.errstate(over="ignore", invalid="ignore"):
            for axis, sign, coordinate, numbers in self._planes:
                front = ((origin[axis] - coordinate) * sign >= 0.0) & (direction[axis] * sign < 0.0)
                if not front.any():
                    continue
                t = (coordinate - origin[axis]) / np.where(front, direction[axis], 1.0)
                front &= t < best
                u, v = (a for a in range(3) if a != axis)
                at_u, at_v = origin[u] + t * direction[u], origin[v] + t * direction[v]
                for number in numbers:
                    low, high = lo[number] - slack, hi[number] + slack
                    entered = front & (at_u >= low[u]) & (at_u <= high[u]) & (at_v >= low[v]) & (at_v <= high[v])
                    best[entered], index[entered] = t[entered], number
        return Hits(best, np.concatenate([normals, np.zeros((1, 3))])[index])

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """See `Solid`."""
        draw, (lo, hi, normals) = np.random.default_rng(seed), self.rectangles
        chosen = draw.choice(len(lo), size=count, p=self._areas / self._areas.sum())
        return lo[chosen] + draw.random((count, 3)) * (hi[chosen] - lo[chosen]), normals[chosen]


@dataclass(frozen=True, eq=False)
class SolidUnion(Solid):
    """Solids side by side that share no volume and no face; round ones may touch others in a point or a line."""

    parts: tuple[Solid, ...]
    """The solids. Boxes that touch belong into one `BoxSolid`, which knows that the shared face is not exposed."""

    @property
    def bounds(self) -> Box:
        """See `Solid`."""
        corners = np.array([part.bounds for part in self.parts])
        return box_between(corners[:, 0].min(axis=0), corners[:, 1].max(axis=0))

    @property
    def volume(self) -> float:
        """See `Solid`."""
        return sum(part.volume for part in self.parts)

    @property
    def area(self) -> float:
        """See `Solid`."""
        return sum(part.area for part in self.parts)

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """See `Solid`."""
        return np.min([part.signed_distance(points) for part in self.parts], axis=0)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """See `Solid`."""
        hits = [part.intersect(origins, directions) for part in self.parts]
        distance, every = np.array([one.distance for one in hits]), np.arange(len(hits[0].distance))
        first = distance.argmin(axis=0)
        return Hits(distance[first, every], np.array([one.normal for one in hits])[first, every])

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """See `Solid`."""
        areas = np.array([part.area for part in self.parts])
        shares = np.random.default_rng(seed).multinomial(count, areas / areas.sum())
        parts = enumerate(zip(self.parts, shares), start=seed + 1)
        drawn = zip(*(part.surface_points(int(share), own_seed) for own_seed, (part, share) in parts))
        points, normals = (np.concatenate(each) for each in drawn)
        return points, normals


def box_between(lo: npt.ArrayLike, hi: npt.ArrayLike) -> Box:
    """Box with these corners, as plain numbers."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(lo).tolist(), np.asarray(hi).tolist()
    return (x0, y0, z0), (x1, y1, z1)


def box_beside(axis: int, across: tuple[float, float], along: tuple[float, float], height: tuple[float, float]) -> Box:
    """Box from its extents across a wall (at right angles to axis 0 or 1, in any order), along it and in z."""
    through = (min(across), max(across))
    (x0, x1), (y0, y1) = (through, along) if axis == 0 else (along, through)
    return (x0, y0, height[0]), (x1, y1, height[1])


def distance_to_box(points: npt.ArrayLike, lo: npt.ArrayLike, hi: npt.ArrayLike) -> FloatArray:
    """Distance from each point (n, 3) to a solid box, 0 inside it [m].

    >>> float(distance_to_box([[4.0, 5.0, 0.5]], (0, 0, 0), (1, 1, 1))[0])
    5.0
    """
    points = np.asarray(points, dtype=np.float64)
    gap = points - np.clip(points, np.asarray(lo, dtype=np.float64), np.asarray(hi, dtype=np.float64))
    return np.sqrt(np.einsum("ij,ij->i", gap, gap))


def fade_towards(values: FloatArray, points: FloatArray, core: Box, value: float, reach: float) -> None:
    """Change values (n,) at points (n, 3) to `value` within a box, smoothly back to their own over `reach` around."""
    near = np.maximum(1.0 - distance_to_box(points, *core) / reach, 0.0)
    values += (value - values) * near * near * (3.0 - 2.0 * near)


def _through_circle(start: FloatArray, way: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """Where rays (n, 2 or 3) enter and leave a circle or ball around the origin; infinity, minus infinity for a miss.

    The half chord comes from the foot of the perpendicular, which does not cancel for far origins.
    """
    squared = np.einsum("ij,ij->i", way, way)
    # Along a cylinder's axis, or tilted from it by less than rounding, a ray is inside for ever or never.
    along = squared <= _PARALLEL_SINE_SQUARED
    squared = np.where(along, 1.0, squared)
    foot = np.where(along, 0.0, -np.einsum("ij,ij->i", start, way) / squared)
    perpendicular = start + foot[:, None] * way
    half_squared = radius**2 - np.einsum("ij,ij->i", perpendicular, perpendicular)
    half = np.where(along, np.inf, np.sqrt(np.maximum(half_squared, 0.0) / squared))
    return np.where(half_squared >= 0.0, foot - half, np.inf), np.where(half_squared >= 0.0, foot + half, -np.inf)


def _merged_blocks(mask: BoolArray) -> Iterator[tuple[int, int, int, int]]:
    """Cover the true entries of a mask by disjoint blocks [u0, u1) x [v0, v1), greedily along v, then u."""
    left = mask.copy()
    for u0, v0 in np.argwhere(mask):
        if not left[u0, v0]:
            continue
        v1 = v0 + int(np.argmin(np.append(left[u0, v0:], False)))
        u1 = u0 + int(np.argmin(np.append(left[u0:, v0:v1].all(axis=1), False)))
        left[u0:u1, v0:v1] = False
        yield u0, u1, v0, v1
