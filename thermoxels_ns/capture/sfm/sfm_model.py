"""Result of structure from motion (one lens, poses and scene points), and depth interpolated between scene points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from thermoxels_ns.capture.rig_types import OPENGL_FROM_OPENCV
from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.camera import Camera

_NEIGHBOURS = 12
_NEAR_QUANTILE, _FAR_QUANTILE = 0.9, 0.1
_ONE_SURFACE = 0.04  # largest scatter of one surface's points about a plane, as a share of their inverse depth
_SLOPE_RIDGE = 0.1  # ridge that keeps a plane's slope small if the points are on a line, or all far away on one side


@dataclass(frozen=True)
class SfmModel:
    """Poses of the photographs and the scene points that they share, in one arbitrary unit of length."""

    frames: tuple[str, ...]  # names of the frames that have a pose, in order, all different
    camera: Camera  # lens of all photographs, at their original size
    camera_to_world: FloatArray  # poses, shape (f, 4, 4), camera axes x right, y up, z back, as in transforms.json
    points: FloatArray  # scene points, shape (n, 3), in world units
    point_error_px: FloatArray  # mean reprojection error of each point, shape (n,), [pixels of the photographs]
    seen: tuple[IntArray, ...]  # for each frame, indices into `points` of the points that it shows, rising
    errors_px: tuple[FloatArray, ...]  # for each frame, reprojection errors of these points [pixels of the photographs]

    @property
    def centres(self) -> FloatArray:
        """Positions of the cameras in the world, shape (f, 3)."""
        return self.camera_to_world[:, :3, 3]

    def in_camera(self, frame: int, points: npt.ArrayLike) -> FloatArray:
        """Return world points (m, 3) in a frame's camera axes x right, y down, z ahead, shape (m, 3)."""
        pose = self.camera_to_world[frame]
        return (np.asarray(points, dtype=np.float64) - pose[:3, 3]) @ pose[:3, :3] @ OPENGL_FROM_OPENCV[:3, :3]


class SparseDepth:
    """Depth of the scene in any direction from one camera, interpolated between the nearest scene points.

    The inverse depth of a plane is linear in the image. A linear fit to the points' inverse depths therefore also gives
    the depth of a slanted surface. If the points are on two surfaces, the surface in front is used: edges that both
    photograph and thermal image show are mostly outlines, which belong to the surface in front. Single points that are
    far too near have no influence.
    """

    def __init__(self, points: FloatArray) -> None:
        """Store points (n, 3) in OpenCV camera axes; points that are not ahead of the camera are left out."""
        ahead = points[points[:, 2] > 0.0]
        self._inverse = 1.0 / ahead[:, 2]
        self._places = ahead[:, :2] * self._inverse[:, None]
        self._tree = KDTree(self._places) if len(ahead) else None

    def at(self, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return depths (n,) along rays (n, 3) with z = 1, and distances (n,) at depth 1 to the nearest scene point."""
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
    """Return inverse depths (n,) at offset 0 of n planes, each fitted to k points, and the points' scatter (n,). The
    points have an `offset` (n, k, 2) in the image at depth 1, an `inverse` depth (n, k) and a `weight` (n, k)."""
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
