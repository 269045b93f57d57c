"""Exact solids: balls, cylinders, joined and cut boxes, and unions of these, with distances and ray intersections."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]

_COORDINATE_DECIMALS = 12
_EDGE_TOLERANCE = 1e-9
_PARALLEL_SINE_SQUARED = 1e-30


class Solid(Protocol):
    """A closed solid body: its surface belongs to it. Lengths are in metres; all values are exact up to rounding."""

    bounds: Box  # lower and upper corner of the smallest box around the solid [m]
    volume: float  # volume [m3]
    area: float  # area of the surface [m2]

    def contains(self, points: npt.ArrayLike, /) -> BoolArray:
        """Return a mask (n,), True for each of the points (n, 3) [m] that lies in the solid or on its surface."""
        return self.signed_distance(points) <= 0.0

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """Return the signed distances (n,) [m] of points (n, 3) [m] to the surface, negative inside the solid."""
        ...

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return where rays first enter the solid: distances (n,) and outward unit normals (n, 3) at the entry points.

        The rays start at `origins`, (n, 3) or one shared (3,) [m], and run along `directions` (n, 3) of any length.
        Distances are in multiples of the direction's length. For a miss, the distance is infinite and the normal zero.
        Only an entry from outside counts: a ray that starts inside does not hit the surface from behind. A ray that
        touches an edge hits the solid.
        """
        ...

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return random surface points (count, 3) [m], uniform by area, and their outward unit normals (count, 3)."""
        ...


@dataclass(eq=False)
class Sphere(Solid):
    """A ball around `centre` [m] with `radius` [m] above 0."""

    centre: Vector
    radius: float

    def __post_init__(self) -> None:
        self.bounds = box_between(np.subtract(self.centre, self.radius), np.add(self.centre, self.radius))
        self.volume = 4.0 / 3.0 * math.pi * self.radius**3
        self.area = 4.0 * math.pi * self.radius**2

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """Return the signed distance of each point, see `Solid.signed_distance`."""
        return np.linalg.norm(np.subtract(points, self.centre), axis=-1) - self.radius

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return where rays enter the solid, see `Solid.intersect`."""
        directions = np.asarray(directions, dtype=np.float64)
        start = np.broadcast_to(np.subtract(origins, self.centre), directions.shape)
        enter, _ = _through_circle(start, directions, self.radius)
        hit = np.isfinite(enter) & (enter >= 0.0)
        normal = (start + np.where(hit, enter, 0.0)[:, None] * directions) / self.radius
        return np.where(hit, enter, np.inf), np.where(hit[:, None], normal, 0.0)

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return random surface points and their normals, see `Solid.surface_points`."""
        normals = np.random.default_rng(seed).standard_normal((count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(self.centre) + self.radius * normals, normals


@dataclass(eq=False)
class Cylinder(Solid):
    """A solid circular cylinder with flat ends. Its axis is parallel to x, y or z.

    >>> Cylinder((0.0, 0.0, 1.0), radius=0.5, length=2.0, axis=2).bounds
    ((-0.5, -0.5, 0.0), (0.5, 0.5, 2.0))
    """

    centre: Vector  # middle of the axis [m]
    radius: float  # radius [m], above 0
    length: float  # length along the axis [m], above 0
    axis: int  # direction of the axis: 0 for x, 1 for y, 2 for z

    def __post_init__(self) -> None:
        half = np.where(np.arange(3) == self.axis, 0.5 * self.length, self.radius)
        self.bounds = box_between(np.subtract(self.centre, half), np.add(self.centre, half))
        self.volume = math.pi * self.radius**2 * self.length
        self.area = 2.0 * math.pi * self.radius * (self.radius + self.length)
        self._across = [a for a in range(3) if a != self.axis]

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """Return the signed distance of each point, see `Solid.signed_distance`."""
        relative = np.subtract(points, self.centre)
        beside = np.linalg.norm(relative[:, self._across], axis=1) - self.radius
        beyond = np.abs(relative[:, self.axis]) - 0.5 * self.length
        outside = np.hypot(np.maximum(beside, 0.0), np.maximum(beyond, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(beside, beyond), 0.0), dtype=np.float64)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """See `Solid.intersect`. Rays enter where they are first between the end planes and in the endless cylinder."""
        directions = np.asarray(directions, dtype=np.float64)
        start = np.broadcast_to(np.subtract(origins, self.centre), directions.shape)
        side_in, side_out = _through_circle(start[:, self._across], directions[:, self._across], self.radius)
        height, rise = start[:, self.axis], directions[:, self.axis]
        # A ray parallel to the ends meets both planes at infinity, with the same sign if it passes above or below them.
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
        return np.where(hit, entry, np.inf), normal

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return random surface points and their normals, see `Solid.surface_points`."""
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


@dataclass(eq=False)
class BoxSolid(Solid):
    """The union of axis-aligned boxes, minus other axis-aligned boxes.

    First all `boxes` are joined, then all `removed` are cut out. The coordinates of all faces span a small non-uniform
    grid whose cells are filled or empty; the rectangles between filled and empty cells are the surface.

    >>> notched = BoxSolid([((0, 0, 0), (2, 1, 1))], removed=[((1, 0, 0.5), (2, 1, 1))])
    >>> notched.volume, notched.area
    (1.5, 9.0)
    """

    boxes: Sequence[Box]
    """Lower and upper corners [m] of the boxes to join; rounded to 1e-12 m so that touching faces coincide."""
    removed: Sequence[Box] = ()  # lower and upper corners [m] of the boxes to cut out

    def __post_init__(self) -> None:
        corners = np.round(np.array([*self.boxes, *self.removed], dtype=np.float64), _COORDINATE_DECIMALS)
        self._edges = [np.unique(corners[..., axis]) for axis in range(3)]
        self._cells = np.zeros([len(edge) - 1 for edge in self._edges], dtype=bool)
        for number, box in enumerate(corners):
            within = tuple(slice(*np.searchsorted(edge, ends)) for edge, ends in zip(self._edges, box.T))
            self._cells[within] = number < len(self.boxes)
        assert self._cells.any(), "nothing is left of the boxes"
        self._find_rectangles()
        widths = [np.diff(edge) for edge in self._edges]
        self.volume = float(np.einsum("ijk,i,j,k->", self._cells, *widths))
        self._areas = np.prod(np.where(self._normals == 0.0, self._hi - self._lo, 1.0), axis=1)
        self.area = float(self._areas.sum())
        self.bounds = box_between(self._lo.min(axis=0), self._hi.max(axis=0))

    def _find_rectangles(self) -> None:
        """Set `_lo`, `_hi`, `_normals` and `_planes` to m large rectangles that cover the surface without overlap.
        `_lo` and `_hi` are lower and upper corners [m], `_normals` outward unit normals, each of shape (m, 3). Each of
        `_planes` holds the axis and sign of its normal, its coordinate [m], and the indices of its rectangles."""
        filled, found = np.pad(self._cells, 1).astype(np.int8), []
        self._planes: list[tuple[int, int, float, range]] = []
        for axis in range(3):
            u, v = (a for a in range(3) if a != axis)
            rise = np.moveaxis(np.diff(filled, axis=axis), axis, 0)[:, 1:-1, 1:-1]
            for sign in (1, -1):
                for coordinate, faces in zip(self._edges[axis], rise == -sign):
                    first = len(found)
                    for u0, u1, v0, v1 in _merged_blocks(faces):
                        one = np.zeros((3, 3))
                        one[:2, axis], one[2, axis] = coordinate, sign
                        one[:2, u], one[:2, v] = self._edges[u][[u0, u1]], self._edges[v][[v0, v1]]
                        found.append(one)
                    if len(found) > first:
                        self._planes.append((axis, sign, coordinate, range(first, len(found))))
        self._planes.sort(key=lambda plane: plane[:3])
        self._lo, self._hi, self._normals = np.stack(found, axis=1)

    def contains(self, points: npt.ArrayLike, /) -> BoolArray:
        """Return the mask of `Solid.contains`. A point on a plane of the grid belongs to the cells on both sides."""
        padded, columns = np.pad(self._cells, 1), np.asarray(points, dtype=np.float64).T
        sides = (
            [np.searchsorted(edge, at, side="left"), np.searchsorted(edge, at, side="right")]
            for edge, at in zip(self._edges, columns)
        )
        return np.any([padded[cell] for cell in itertools.product(*sides)], axis=0)

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """Return the signed distance of each point, see `Solid.signed_distance`."""
        nearest = np.full(len(np.asarray(points)), np.inf)
        for lo, hi in zip(self._lo, self._hi):
            nearest = np.minimum(nearest, distance_to_box(points, lo, hi))
        return np.where(self.contains(points), -nearest, nearest)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """See `Solid.intersect`. Rectangles are widened by 1e-9 of the solid's size, so that no ray slips through."""
        direction = np.ascontiguousarray(np.asarray(directions, dtype=np.float64).T)
        origin = np.ascontiguousarray(np.broadcast_to(origins, direction.T.shape).T, dtype=np.float64)
        slack = _EDGE_TOLERANCE * float(np.subtract(self.bounds[1], self.bounds[0]).max())
        lo, hi = self._lo - slack, self._hi + slack
        best, index = np.full(direction.shape[1], np.inf), np.full(direction.shape[1], -1)
        # A ray nearly parallel to a plane may meet it at infinity; the comparisons below are then false: no hit.
        with np.errstate(over="ignore", invalid="ignore"):
            for axis, sign, coordinate, numbers in self._planes:
                front = ((origin[axis] - coordinate) * sign >= 0.0) & (direction[axis] * sign < 0.0)
                if not front.any():
                    continue
                t = (coordinate - origin[axis]) / np.where(front, direction[axis], 1.0)
                front &= t < best
                u, v = (a for a in range(3) if a != axis)
                at_u, at_v = origin[u] + t * direction[u], origin[v] + t * direction[v]
                for n in numbers:
                    entered = front & (at_u >= lo[n, u]) & (at_u <= hi[n, u]) & (at_v >= lo[n, v]) & (at_v <= hi[n, v])
                    best[entered], index[entered] = t[entered], n
        return best, np.concatenate([self._normals, np.zeros((1, 3))])[index]

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return random surface points and their normals, see `Solid.surface_points`."""
        draw, lo, hi = np.random.default_rng(seed), self._lo, self._hi
        chosen = draw.choice(len(lo), size=count, p=self._areas / self._areas.sum())
        return lo[chosen] + draw.random((count, 3)) * (hi[chosen] - lo[chosen]), self._normals[chosen]


@dataclass(eq=False)
class SolidUnion(Solid):
    """The union of solids that share no volume and no face. A round solid may touch others in a point or a line."""

    parts: tuple[Solid, ...]
    """The solids. Touching boxes must be in one `BoxSolid`, which leaves their shared face out of the surface."""

    def __post_init__(self) -> None:
        corners = np.array([part.bounds for part in self.parts])
        self.bounds = box_between(corners[:, 0].min(axis=0), corners[:, 1].max(axis=0))
        self.volume = sum(part.volume for part in self.parts)
        self.area = sum(part.area for part in self.parts)

    def signed_distance(self, points: npt.ArrayLike, /) -> FloatArray:
        """Return the signed distance of each point, see `Solid.signed_distance`."""
        return np.min([part.signed_distance(points) for part in self.parts], axis=0)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return where rays enter the solid, see `Solid.intersect`."""
        return first_hits(self.parts, origins, directions)[:2]

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return random surface points and their normals, see `Solid.surface_points`."""
        areas = np.array([part.area for part in self.parts])
        shares = np.random.default_rng(seed).multinomial(count, areas / areas.sum())
        parts = enumerate(zip(self.parts, shares), start=seed + 1)
        drawn = zip(*(part.surface_points(int(share), own_seed) for own_seed, (part, share) in parts))
        points, normals = map(np.concatenate, drawn)
        return points, normals


def first_hits(
    solids: Sequence[Solid], origins: npt.ArrayLike, directions: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return each ray's first entry, as `Solid.intersect` does, and the index (n,) of the solid entered; -1: none."""
    distance, normal = map(np.array, zip(*(solid.intersect(origins, directions) for solid in solids)))
    first, every = distance.argmin(axis=0), np.arange(distance.shape[1])
    nearest = distance[first, every]
    return nearest, normal[first, every], np.where(np.isfinite(nearest), first, -1)


def box_between(lo: npt.ArrayLike, hi: npt.ArrayLike) -> Box:
    """Return the box with lower corner `lo` and upper corner `hi`, each (3,), as tuples of Python numbers."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(lo).tolist(), np.asarray(hi).tolist()
    return (x0, y0, z0), (x1, y1, z1)


def box_beside(axis: int, across: tuple[float, float], along: tuple[float, float], height: tuple[float, float]) -> Box:
    """Return a box: `across` (ends in any order) on `axis` (0: x, 1: y), `along` on the other one, `height` in z."""
    through = (min(across), max(across))
    (x0, x1), (y0, y1) = (through, along) if axis == 0 else (along, through)
    return (x0, y0, height[0]), (x1, y1, height[1])


def distance_to_box(points: npt.ArrayLike, lo: npt.ArrayLike, hi: npt.ArrayLike) -> FloatArray:
    """Return the distance of each point (n, 3) to a box [m], 0 inside the box, shape (n,).

    >>> float(distance_to_box([[4.0, 5.0, 0.5]], (0, 0, 0), (1, 1, 1))[0])
    5.0
    """
    points = np.asarray(points, dtype=np.float64)
    gap = points - np.clip(points, np.asarray(lo, dtype=np.float64), np.asarray(hi, dtype=np.float64))
    return np.sqrt(np.einsum("ij,ij->i", gap, gap))


def _through_circle(start: FloatArray, way: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """Return the distances (n,) at which rays enter and leave a circle or ball around the origin; a miss: inf and -inf.
    The rays run from `start` along `way`, both (n, 2) or (n, 3); distances are in lengths of `way`. The half chord is
    computed at the foot of the perpendicular, so that it keeps its digits for a far start."""
    squared = np.einsum("ij,ij->i", way, way)
    # A ray along a cylinder's axis, or tilted from the axis by less than rounding, is inside for ever or never.
    along = squared <= _PARALLEL_SINE_SQUARED
    squared = np.where(along, 1.0, squared)
    foot = np.where(along, 0.0, -np.einsum("ij,ij->i", start, way) / squared)
    perpendicular = start + foot[:, None] * way
    half_squared = radius**2 - np.einsum("ij,ij->i", perpendicular, perpendicular)
    half = np.where(along, np.inf, np.sqrt(np.maximum(half_squared, 0.0) / squared))
    return np.where(half_squared >= 0.0, foot - half, np.inf), np.where(half_squared >= 0.0, foot + half, -np.inf)


def _merged_blocks(mask: BoolArray) -> Iterator[tuple[int, int, int, int]]:
    """Yield u0, u1, v0, v1 of disjoint blocks [u0, u1) x [v0, v1) that cover `mask`. They grow along v, then u."""
    left = mask.copy()
    for u0, v0 in np.argwhere(mask):
        if not left[u0, v0]:
            continue
        v1 = v0 + int(np.argmin(np.append(left[u0, v0:], False)))
        u1 = u0 + int(np.argmin(np.append(left[u0:, v0:v1].all(axis=1), False)))
        left[u0:u1, v0:v1] = False
        yield u0, u1, v0, v1
