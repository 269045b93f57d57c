"""Which photographs rays belong to, and feature rays: from cameras to points that their photographs agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray

# A batch is one `RayBundle` whose ``metadata["stream"]`` holds these bits per ray, shape (n, 1), uint8.
RGB_STREAM = 1  # The ray carries a colour target
THERMAL_STREAM = 2  # The ray carries a temperature target

NEIGHBOURS = 8  # Points nearest to a point in a photograph that its distance is compared with
FEWEST_NEIGHBOURS = 4  # With fewer in a photograph it says nothing about the point
STEEPEST = 3.0  # Slope of a surface against the photograph up to which neighbours on it agree: 72 degrees
LEAST_TOLERANCE = 0.01  # Share of the distance by which neighbours may differ at any slope: surfaces are rough
TOLERANCE_ERRORS = 3.0  # Standard errors of a ray's length by which they may differ too
_RAYS_AT_ONCE = 1 << 18


@dataclass(frozen=True, eq=False)
class FeatureRays:
    """Rays from cameras to points that their photographs agree on: what lies between is air. World units."""

    origins: FloatArray  # Where the cameras stood, shape (s, 3)
    point: IntArray  # Index into `points`, ascending, shape (s,)
    points: FloatArray  # Shape (n, 3)
    uncertainty: FloatArray  # Standard error of each ray's length, shape (s,)

    def moved(self, rotation: FloatArray, translation: FloatArray, scale: float) -> FeatureRays:
        """Return the same rays in another world: scale (rotation p + translation)."""
        origins, points = (scale * (p @ rotation.T + translation) for p in (self.origins, self.points))
        return FeatureRays(origins, self.point, points, scale * self.uncertainty)

    def joined_with(self, others: FeatureRays) -> FeatureRays:
        """Return these rays with others behind them."""
        shifted = FeatureRays(others.origins, len(self.points) + others.point, others.points, others.uncertainty)
        return FeatureRays(*map(np.concatenate, zip(vars(self).values(), vars(shifted).values())))

    def of_points(self, chosen: BoolArray) -> FeatureRays:
        """Return the rays to the chosen points, one boolean per point; all points stay, with their numbers."""
        kept = chosen[self.point]
        return FeatureRays(self.origins[kept], self.point[kept], self.points, self.uncertainty[kept])


def agrees_with_neighbours(rays: FeatureRays) -> BoolArray:
    """Return which points lie where the points around them in the photographs do: wrong matches lie anywhere.

    A photograph (all rays of one origin) vouches for a point if at least half of the `NEIGHBOURS` points that it sees
    nearest to it are as far away, give or take the largest of three lengths: `STEEPEST` times how far apart the two are
    across the ray, the share `LEAST_TOLERANCE` of the distance, and `TOLERANCE_ERRORS` standard errors. A point agrees
    if half of its photographs vouch for it, or if it has no rays or no neighbours. A point on something thin before
    other things may fail.
    """
    from scipy.spatial import KDTree  # slow to import and only needed here

    along = rays.points[rays.point] - rays.origins
    length = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(length, 1e-300)[:, None]
    photograph = np.unique(rays.origins, axis=0, return_inverse=True)[1].reshape(-1)
    key = np.column_stack((direction, 10.0 * photograph))  # far from those of all other photographs
    tree = KDTree(key) if len(key) else None
    vouched = np.zeros(len(key), dtype=bool)
    for first in range(0, len(key), _RAYS_AT_ONCE):
        assert tree is not None
        some = slice(first, first + _RAYS_AT_ONCE)
        # Of each ray the nearest is itself. A distance is the chord of an angle, or infinite where there is no other.
        found = tree.query(key[some], NEIGHBOURS + 1, distance_upper_bound=3.0)
        apart, other = (np.asarray(value)[:, 1:] for value in found)
        known = np.isfinite(apart)
        own = length[some, None]
        least = np.maximum(LEAST_TOLERANCE * own, TOLERANCE_ERRORS * rays.uncertainty[some, None])
        off = np.abs(length[np.where(known, other, 0)] - own)
        agree = known & (off <= np.maximum(STEEPEST * own * np.where(known, apart, 0.0), least))
        count = known.sum(axis=1)
        vouched[some] = (2 * agree.sum(axis=1) >= count) | (count < FEWEST_NEIGHBOURS)
    photographs, vouching = (np.bincount(rays.point, w, len(rays.points)) for w in (None, vouched))
    return 2 * vouching >= photographs
