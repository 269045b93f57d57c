"""Exact solids side by side: boxes, spheres and cylinders that do not overlap."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.box_solid import BoxSolid
from thermoxels_ns.synthetic.solids import Box, Cylinder, Hits, Sphere, box_between

FloatArray = npt.NDArray[np.float64]
Part = BoxSolid | Sphere | Cylinder

_TOUCHING = 1e-9
_POINTS = 2000


@dataclass(frozen=True, eq=False)
class SolidUnion:
    """Solids side by side that share no volume and no face; round ones may touch others in a point or a line."""

    parts: tuple[Part, ...]
    """The solids. Boxes that touch belong into one `BoxSolid`, which knows that the shared face is not exposed."""

    def __post_init__(self) -> None:
        for (i, first), (j, second) in combinations(enumerate(self.parts), 2):
            if _overlap(first, second):
                expected = "solids that do not overlap and share no face"
                got = f"{type(first).__name__} {first.bounds} and {type(second).__name__} {second.bounds}"
                remedy = "Move one of them, or join boxes in one BoxSolid."
                raise SceneError(f"parts {i} and {j}", expected=expected, got=got, remedy=remedy)

    @property
    def bounds(self) -> Box:
        """Lower and upper corner of the smallest box around the solid [m]."""
        corners = np.array([part.bounds for part in self.parts])
        return box_between(corners[:, 0].min(axis=0), corners[:, 1].max(axis=0))

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
        parts = enumerate(zip(self.parts, shares), start=seed + 1)
        drawn = zip(*(part.surface_points(int(share), own_seed) for own_seed, (part, share) in parts))
        points, normals = (np.concatenate(each) for each in drawn)
        return points, normals


def _overlap(first: Part, second: Part) -> bool:
    """Whether points drawn on the surface of one solid lie in the other or on its surface."""
    for one, other in ((first, second), (second, first)):
        slack = _TOUCHING * float(np.subtract(other.bounds[1], other.bounds[0]).max())
        if other.signed_distance(one.surface_points(_POINTS, seed=0)[0]).min() <= slack:
            return True
    return False


Solid = BoxSolid | Sphere | Cylinder | SolidUnion
"""What every exact solid can tell, it tells without approximation and without a lattice: a closed set, lengths in m.

`intersect` counts only the points where a ray passes from outside to inside, the surface's front: a ray that starts
within the solid does not see its walls from behind. Touching an edge counts as a hit.
"""
