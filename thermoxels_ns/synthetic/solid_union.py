"""Exact solids side by side: boxes, spheres and cylinders that do not overlap."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.box_solid import BoxSolid
from thermoxels_ns.synthetic.solids import Box, Cylinder, Hits, Sphere

FloatArray = npt.NDArray[np.float64]
Part = BoxSolid | Sphere | Cylinder

_TOUCHING = 1e-9


@dataclass(frozen=True, eq=False)
class SolidUnion:
    """Solids side by side that share no volume and no face; a sphere may touch another solid in a point."""

    parts: tuple[Part, ...]
    """The solids. Boxes that touch belong into one `BoxSolid`, which knows that the shared face is not exposed.
    Cylinders touch nothing, and the boxes around two that cross each other are apart too."""

    def __post_init__(self) -> None:
        for (i, first), (j, second) in combinations(enumerate(self.parts), 2):
            if _overlap(first, second):
                raise SceneError(
                    f"parts {i} and {j}",
                    expected="solids that do not overlap and share no face",
                    got=f"{type(first).__name__} {first.bounds} and {type(second).__name__} {second.bounds}",
                    remedy="Move one of them, or join boxes in one BoxSolid.",
                )

    @property
    def bounds(self) -> Box:
        """Lower and upper corner of the smallest box around the solid [m]."""
        corners = np.array([part.bounds for part in self.parts])
        (x0, y0, z0), (x1, y1, z1) = corners[:, 0].min(axis=0).tolist(), corners[:, 1].max(axis=0).tolist()
        return (x0, y0, z0), (x1, y1, z1)

    @property
    def volume(self) -> float:
        """Volume [m3]."""
        return sum(part.volume for part in self.parts)

    @property
    def area(self) -> float:
        """Area of the surface [m2]."""
        return sum(part.area for part in self.parts)

    def contains(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which of the points (n, 3) lie in the solid or on its surface."""
        return np.any([part.contains(points) for part in self.parts], axis=0)

    def signed_distance(self, points: npt.ArrayLike) -> FloatArray:
        """Distance of the points (n, 3) to the surface [m], negative inside; exact because the parts are disjoint."""
        return np.min([part.signed_distance(points) for part in self.parts], axis=0)

    def intersect(self, origins: npt.ArrayLike, directions: npt.ArrayLike) -> Hits:
        """First entry of rays: origins (n, 3) or one shared (3,), directions (n, 3)."""
        first = self.parts[0].intersect(origins, directions)
        distance, normal = first.distance, first.normal
        for part in self.parts[1:]:
            other = part.intersect(origins, directions)
            nearer = other.distance < distance
            distance = np.where(nearer, other.distance, distance)
            normal[nearer] = other.normal[nearer]
        return Hits(distance, normal)

    def surface_points(self, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
        """Draw points uniformly by area: positions (count, 3) and outward normals (count, 3)."""
        areas = np.array([part.area for part in self.parts])
        shares = np.random.default_rng(seed).multinomial(count, areas / areas.sum())
        drawn = [
            part.surface_points(int(share), seed + 1 + number)
            for number, (part, share) in enumerate(zip(self.parts, shares))
        ]
        return np.concatenate([points for points, _ in drawn]), np.concatenate([normals for _, normals in drawn])


def _overlap(first: Part, second: Part) -> bool:
    """Whether two solids share more than a point where a sphere touches."""
    for one, other in ((first, second), (second, first)):
        if isinstance(one, Sphere):
            gap = float(other.signed_distance([one.centre])[0]) - one.radius
            return gap < -_TOUCHING * one.radius
    for one, other in ((first, second), (second, first)):
        if isinstance(one, Cylinder):
            return _meets_cylinder(one, other)
    assert isinstance(first, BoxSolid) and isinstance(second, BoxSolid)
    (lo_a, hi_a), (lo_b, hi_b) = first.filled_boxes, second.filled_boxes
    return not bool(_apart(lo_a[:, None], hi_a[:, None], lo_b[None], hi_b[None]).all())


def _meets_cylinder(cylinder: Cylinder, other: Part) -> bool:
    """Whether a cylinder touches or cuts another part; for a crossing cylinder, whether the boxes around both do."""
    lo, hi = np.array(cylinder.bounds)
    axis, across = cylinder.axis, [a for a in range(3) if a != cylinder.axis]
    centre = np.asarray(cylinder.centre, dtype=np.float64)
    if isinstance(other, Cylinder):
        other_lo, other_hi = np.array(other.bounds)
        if other.axis != axis:
            return not bool(_apart(lo, hi, other_lo, other_hi))
        beside = np.linalg.norm((centre - other.centre)[across]) - other.radius
        other_lo, other_hi = other_lo[None], other_hi[None]
    else:
        assert isinstance(other, BoxSolid)
        other_lo, other_hi = other.filled_boxes
        nearest = np.clip(centre, other_lo, other_hi)
        beside = np.linalg.norm((nearest - centre)[:, across], axis=1)
    beyond = np.maximum(other_lo[:, axis] - hi[axis], lo[axis] - other_hi[:, axis])
    slack = _TOUCHING * cylinder.radius
    return bool(np.any((beside <= cylinder.radius + slack) & (beyond <= slack)))


def _apart(lo_a: FloatArray, hi_a: FloatArray, lo_b: FloatArray, hi_b: FloatArray) -> npt.NDArray[np.bool_]:
    """Whether boxes (..., 3) leave a gap along some axis."""
    return np.any((hi_a < lo_b) | (hi_b < lo_a), axis=-1)
