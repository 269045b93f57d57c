"""Depth of any pixel of a photograph from the scene points around it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from thermoxels_ns.capture.rig_types import FloatArray

_NEIGHBOURS = 12
_NEAR_QUANTILE, _FAR_QUANTILE = 0.9, 0.1
_ONE_SURFACE = 0.04  # scatter about a plane, as a share of the inverse depth, up to which points belong to one surface
_SLOPE_RIDGE = 0.1  # holds the slope of a plane through points that lie on a line, or far away on one side


class SparseDepth:
    """Depth over the image plane at depth 1, from the nearest of the scene points around.

    The inverse depth of a plane is linear in the image, so a plane through the points gives the depth of a surface that
    is seen at a slant. Where the points lie on two surfaces it is the one in front that counts: edges that both bands
    show are mostly outlines, and an outline belongs to what stands in front. Single points that lie far too near do
    not count.
    """

    def __init__(self, points: FloatArray) -> None:
        """Take points (n, 3) in OpenCV camera axes; those not ahead of the camera are left out."""
        ahead = points[points[:, 2] > 0.0]
        self._inverse = 1.0 / ahead[:, 2]
        self._places = ahead[:, :2] * self._inverse[:, None]
        self._tree = KDTree(self._places) if len(ahead) else None

    def at(self, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Depth (n,) for rays (n, 3) of depth 1, and distance to the next point on that plane; inf without points."""
        if self._tree is None:
            return np.full(len(rays), np.inf), np.full(len(rays), np.inf)
        count = min(_NEIGHBOURS, len(self._inverse))
        distance, index = self._tree.query(rays[:, :2], k=count)
        distance, index = np.reshape(distance, (len(rays), count)), np.reshape(index, (len(rays), count))
        inverse = self._inverse[index]
        offset = self._places[index] - rays[:, None, :2]
        near, far = np.quantile(inverse, _NEAR_QUANTILE, axis=1), np.quantile(inverse, _FAR_QUANTILE, axis=1)
        result, scatter = _plane(offset, inverse, np.ones_like(inverse))
        several = scatter > _ONE_SURFACE * near
        in_front = inverse[several] >= 0.5 * (near + far)[several, None]
        result[several], _ = _plane(offset[several], inverse[several], in_front.astype(np.float64))
        return 1.0 / np.clip(result, far, near), distance[:, 0]


def _plane(offset: FloatArray, inverse: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse depth where the offset (n, k, 2) is 0 on planes through weighted points, and their scatter; (n,)."""
    reach = np.sqrt(np.mean(offset**2, axis=(1, 2)))[:, None, None] + 1e-12
    weight = weight / (1.0 + np.sum((offset / reach) ** 2, axis=2))
    total = weight.sum(axis=1)
    table = np.concatenate([np.ones_like(offset[..., :1]), offset / reach], axis=2)
    normal = np.einsum("nki,nk,nkj->nij", table, weight / total[:, None], table)
    normal[:, 1, 1] += _SLOPE_RIDGE
    normal[:, 2, 2] += _SLOPE_RIDGE
    right = np.einsum("nki,nk->ni", table, weight / total[:, None] * inverse)
    fit = np.linalg.solve(normal, right[..., None])[..., 0]
    off = inverse - np.einsum("nki,ni->nk", table, fit)
    return fit[:, 0], np.sqrt(np.sum(weight * off**2, axis=1) / total)
