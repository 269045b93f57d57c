"""Depth of any pixel of a photograph from the scene points that structure from motion saw in it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

FloatArray = npt.NDArray[np.float64]

_NEIGHBOURS = 12
_NEAR_QUANTILE = 0.9


class SparseDepth:
    """Depth over the image plane at depth 1: near the nearest of the scene points around.

    Edges that both bands show are mostly outlines, and an outline belongs to what stands in front. So a high quantile
    of the inverse depths is taken, not their mean; single points that lie far too near do not count.
    """

    def __init__(self, points: FloatArray) -> None:
        """Take points (n, 3) in OpenCV camera axes; those not ahead of the camera are left out."""
        ahead = points[points[:, 2] > 0.0]
        self._inverse = 1.0 / ahead[:, 2]
        self._tree = KDTree(ahead[:, :2] * self._inverse[:, None]) if len(ahead) else None

    def at(self, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Depth along the camera's axis for rays (n, 3) of depth 1.

        Returns:
            Depth (n,) and the distance to the nearest scene point on the plane at depth 1 (n,); both infinite where
            the frame has no points.
        """
        if self._tree is None:
            return np.full(len(rays), np.inf), np.full(len(rays), np.inf)
        count = min(_NEIGHBOURS, len(self._inverse))
        distance, index = self._tree.query(rays[:, :2], k=count)
        distance, index = np.reshape(distance, (len(rays), count)), np.reshape(index, (len(rays), count))
        return 1.0 / np.quantile(self._inverse[index], _NEAR_QUANTILE, axis=1), distance[:, 0]
