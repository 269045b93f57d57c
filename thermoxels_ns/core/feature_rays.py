"""Bits that say which targets a ray has, and feature rays: from cameras to points on which photographs agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray

# A batch is a `RayBundle` whose ``metadata["stream"]`` holds the sum of these bits per ray, shape (n, 1), uint8.
RGB_STREAM = 1  # The ray carries a colour target
THERMAL_STREAM = 2  # The ray carries a temperature target

MARGIN_VOXELS, MARGIN_ERRORS = 1.5, 2.0
"""Margin around the point of a feature ray: so many voxels plus so many standard errors of the ray's length. Air
reaches to the margin, and the surface lies within it: for the loss, for votes on air, for the support of surfaces."""
NEIGHBOURS = 8  # Number of nearest points in a photograph with which the distance of a point is compared
FEWEST_NEIGHBOURS = 4  # A photograph with fewer neighbours of a point cannot contradict the point
STEEPEST = 3.0  # Largest slope of a surface against the photograph at which points on it agree: 72 degrees
LEAST_TOLERANCE = 0.01  # Share of the distance by which neighbours may differ at any slope: surfaces are rough
TOLERANCE_ERRORS = 3.0  # Standard errors of a ray's length by which neighbours may differ at any slope
_RAYS_AT_ONCE = 1 << 18  # Rays whose neighbours are sought at once, to limit memory


@dataclass(frozen=True, eq=False)
class FeatureRays:
    """Rays from camera centres to points on which photographs agree, [world units]; rays pass through air only."""

    origins: FloatArray  # Camera centre of each ray, shape (s, 3)
    point: IntArray  # Index into `points` of each ray, ascending, shape (s,)
    points: FloatArray  # Points at the ends of rays, shape (n, 3); a point may have no ray
    uncertainty: FloatArray  # Standard error of each ray's length, shape (s,)

    def moved(self, rotation: FloatArray, translation: FloatArray, scale: float) -> FeatureRays:
        """Return the same rays in another world, where a point p is at scale * (rotation @ p + translation)."""
        origins, points = (scale * (p @ rotation.T + translation) for p in (self.origins, self.points))
        return FeatureRays(origins, self.point, points, scale * self.uncertainty)

    def joined_with(self, others: FeatureRays) -> FeatureRays:
        """Return these rays followed by `others`, with the points of both."""
        shifted = FeatureRays(others.origins, len(self.points) + others.point, others.points, others.uncertainty)
        return FeatureRays(*map(np.concatenate, zip(vars(self).values(), vars(shifted).values())))

    def of_points(self, chosen: BoolArray) -> FeatureRays:
        """Return only the rays to the chosen points, one boolean per point; `points` is unchanged."""
        kept = chosen[self.point]
        return FeatureRays(self.origins[kept], self.point[kept], self.points, self.uncertainty[kept])


def agrees_with_neighbours(rays: FeatureRays) -> BoolArray:
    """Return for each point, (n,), whether it is about as far from the cameras as its neighbours in photographs are.

    For wrong matches this is rarely so. All rays of one origin form a photograph. The neighbours of a point in a
    photograph are the `NEIGHBOURS` points whose directions are nearest. A neighbour agrees if its distance differs by
    at most the largest of: `STEEPEST` times its distance across the ray, the share `LEAST_TOLERANCE` of the point's
    distance, `TOLERANCE_ERRORS` standard errors. A photograph vouches for the point if at least half of the neighbours
    agree, or if there are fewer than `FEWEST_NEIGHBOURS`. The result is True if at least half of the photographs vouch
    for the point, or if the point has no rays. A right point on a thin thing in front of other things may be False.
    """
    from scipy.spatial import KDTree  # slow to import and only needed here

    along = rays.points[rays.point] - rays.origins
    length = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(length, 1e-300)[:, None]
    photograph = np.unique(rays.origins, axis=0, return_inverse=True)[1].reshape(-1)
    key = np.column_stack((direction, 10.0 * photograph))  # far from the keys of all other photographs
    tree = KDTree(key)
    vouched = np.zeros(len(key), dtype=bool)
    for first in range(0, len(key), _RAYS_AT_ONCE):
        some = slice(first, first + _RAYS_AT_ONCE)
        # The nearest ray of each is itself. A distance is the chord of an angle, or infinite where there is no ray.
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
