"""Exact spheres and cylinders, and where rays hit them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]
FloatArray = npt.NDArray[np.float64]

_PARALLEL_SINE_SQUARED = 1e-30


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays first enter a solid."""

    distance: FloatArray
    """Distance along the ray in multiples of its direction's length (metres for unit directions); infinite for a
    miss. Shape (n,)."""
    normal: FloatArray  # outward unit normal at the hit, zero for a miss. Shape (n, 3).

    @property
    def hit(self) -> npt.NDArray[np.bool_]:
        """Which rays hit, shape (n,)."""
        return np.isfinite(self.distance)


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball; radius above 0 [m]."""

    centre: Vector
    radius: float

    def __post_init__(self) -> None:
        assert np.isfinite(self.centre).all() and math.isfinite(self.radius) and self.radius > 0

    @property
    def bounds(self) -> Box:
        """Lower and upper corner of the smallest box around the solid [m]."""
        return box_between(np.subtract(self.centre, self.radius), np.add(self.centre, self.radius))

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


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A closed circular cylinder with flat ends whose axis is parallel to x, y or z.

    >>> Cylinder((0.0, 0.0, 1.0), radius=0.5, length=2.0, axis=2).bounds
    ((-0.5, -0.5, 0.0), (0.5, 0.5, 2.0))
    """

    centre: Vector
    radius: float
    length: float  # middle of the axis, radius and length along the axis [m], above 0
    axis: int  # direction of the axis: 0 for x, 1 for y, 2 for z

    def __post_init__(self) -> None:
        finite = np.isfinite((*self.centre, self.radius, self.length)).all()
        assert finite and min(self.radius, self.length) > 0 and self.axis in (0, 1, 2)

    @property
    def bounds(self) -> Box:
        """Lower and upper corner of the smallest box around the solid [m]."""
        half = [self.radius] * 3
        half[self.axis] = 0.5 * self.length
        (x, y, z), (a, b, c) = self.centre, half
        return (x - a, y - b, z - c), (x + a, y + b, z + c)

    @property
    def volume(self) -> float:
        """Volume [m3]."""
        return math.pi * self.radius**2 * self.length

    @property
    def area(self) -> float:
        """Area of the surface, both ends included [m2]."""
        return 2.0 * math.pi * self.radius * (self.radius + self.length)

    def contains(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of the points (n, 3) lie in the solid or on its surface."""
        return self.signed_distance(points) <= 0.0

    def signed_distance(self, points: npt.ArrayLike) -> FloatArray:
        """Distance of the points (n, 3) to the surface [m], negative inside."""
        relative = np.subtract(points, self.centre)
        u, v = self._across
        beside = np.hypot(relative[:, u], relative[:, v]) - self.radius
        beyond = np.abs(relative[:, self.axis]) - 0.5 * self.length
        outside = np.hypot(np.maximum(beside, 0.0), np.maximum(beyond, 0.0))
        inside = np.minimum(np.maximum(beside, beyond), 0.0)
        return np.asarray(outside + inside, dtype=np.float64)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """First entry of rays: origins (n, 3) or one shared (3,), directions (n, 3).

        A ray is inside while it is both between the planes of the ends and within the endless cylinder; it enters
        where the later of the two begins. The half chord comes from the foot of the perpendicular to the axis, which
        does not cancel for far origins.
        """
        directions = np.asarray(directions, dtype=np.float64)
        start = np.broadcast_to(np.subtract(origins, self.centre), directions.shape)
        side_in, side_out = self._within_mantle(start, directions)
        end_in, end_out = self._between_ends(start[:, self.axis], directions[:, self.axis])
        entry = np.maximum(side_in, end_in)
        hit = (entry <= np.minimum(side_out, end_out)) & (entry >= 0.0) & np.isfinite(entry)
        through_end = hit & (end_in > side_in)
        through_side = hit & ~through_end
        normal = np.zeros(directions.shape)
        normal[through_end, self.axis] = -np.sign(directions[through_end, self.axis])
        at = start[through_side] + entry[through_side, None] * directions[through_side]
        for axis in self._across:
            normal[through_side, axis] = at[:, axis] / self.radius
        return Hits(np.where(hit, entry, np.inf), normal)

    def surface_points(self, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
        """Draw points uniformly by area: positions (count, 3) and outward normals (count, 3)."""
        draw = np.random.default_rng(seed)
        on_side = draw.random(count) < self.length / (self.length + self.radius)
        angle = 2.0 * math.pi * draw.random(count)
        share, end = 2.0 * draw.random(count) - 1.0, np.where(draw.random(count) < 0.5, -1.0, 1.0)
        u, v = self._across
        normals = np.zeros((count, 3))
        normals[:, u], normals[:, v] = np.where(on_side, (np.cos(angle), np.sin(angle)), 0.0)
        normals[:, self.axis] = np.where(on_side, 0.0, end)
        points = np.empty((count, 3))
        from_axis = self.radius * np.where(on_side, 1.0, np.sqrt(np.abs(share)))
        points[:, u] = from_axis * np.cos(angle)
        points[:, v] = from_axis * np.sin(angle)
        points[:, self.axis] = 0.5 * self.length * np.where(on_side, share, end)
        return points + self.centre, normals

    @property
    def _across(self) -> tuple[int, int]:
        """The two axes at right angles to the cylinder's."""
        u, v = (a for a in range(3) if a != self.axis)
        return u, v

    def _within_mantle(self, start: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where rays enter and leave the endless cylinder; infinity to minus infinity for those that miss it."""
        flat, way = start[:, list(self._across)], directions[:, list(self._across)]
        squared = np.einsum("ij,ij->i", way, way)
        # A tilt below rounding: the quotients below would lose all digits or overflow.
        parallel = squared <= _PARALLEL_SINE_SQUARED * np.einsum("ij,ij->i", directions, directions)
        squared = np.where(parallel, 1.0, squared)
        foot = np.where(parallel, 0.0, -np.einsum("ij,ij->i", flat, way) / squared)
        perpendicular = flat + foot[:, None] * way
        half_chord_squared = self.radius**2 - np.einsum("ij,ij->i", perpendicular, perpendicular)
        half_chord = np.sqrt(np.maximum(half_chord_squared, 0.0) / squared)
        meets = half_chord_squared >= 0.0
        enter = np.where(parallel, -np.inf, foot - half_chord)
        leave = np.where(parallel, np.inf, foot + half_chord)
        return np.where(meets, enter, np.inf), np.where(meets, leave, -np.inf)

    def _between_ends(self, height: FloatArray, rise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where rays enter and leave the slab between the ends; infinity to minus infinity for those that miss it."""
        half = 0.5 * self.length
        level = rise == 0.0
        # A nearly level ray may reach a plane at infinity, which is what it does.
        with np.errstate(over="ignore"):
            low, high = (-half - height) / np.where(level, 1.0, rise), (half - height) / np.where(level, 1.0, rise)
        enter, leave = np.minimum(low, high), np.maximum(low, high)
        inside = np.abs(height) <= half
        enter = np.where(level, np.where(inside, -np.inf, np.inf), enter)
        return enter, np.where(level, np.where(inside, np.inf, -np.inf), leave)


def box_between(lo: npt.ArrayLike, hi: npt.ArrayLike) -> Box:
    """Box with these corners, as plain numbers."""
    x0, y0, z0 = (float(v) for v in np.asarray(lo))
    x1, y1, z1 = (float(v) for v in np.asarray(hi))
    return (x0, y0, z0), (x1, y1, z1)


def box_beside(axis: int, across: tuple[float, float], along: tuple[float, float], height: tuple[float, float]) -> Box:
    """Box from its extents across a wall (at right angles to axis 0 or 1, in any order), along it and in z."""
    through = (min(across), max(across))
    (x0, x1), (y0, y1) = (through, along) if axis == 0 else (along, through)
    return (x0, y0, height[0]), (x1, y1, height[1])
