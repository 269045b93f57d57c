"""Which photographs say that a surface lies where it is said to lie."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.multiview.stereo import ERROR_PLANES, Depths

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

REACH = 1.5  # Distance from a surface up to which a depth or a track's point lies on it, [voxels]
REACH_ERRORS = 2.0  # Standard errors of a depth that are added


def supporting_photographs(
    depths: Depths, middle: FloatArray, seen: BoolArray, voxel_size: float, tracks: FeatureRays | None = None
) -> BoolArray:
    """Tell which photographs see a surface at given places where their own depth, or a track's point, lies on it.

    Depths are those on which photographs agree, see `depths_of`: a plain wall has none of its own, and a surface that
    hangs in free space is refuted by what they see behind it.

    Args:
        depths: Depths of the photographs.
        middle: Places, shape (g, 3), [world units].
        seen: Whether each photograph sees each place, shape (g, photographs).
        voxel_size: Edge of a voxel, [world units].
        tracks: Lines from photographs to points, in the same world.

    Returns:
        Whether each photograph supports each place, only where it sees it, shape (g, photographs).
    """
    photographs, result = depths.photographs, np.zeros(seen.shape, dtype=np.bool_)
    for number, (matrix, (width, height)) in enumerate(zip(photographs.matrices, photographs.sizes)):
        (places,) = np.nonzero(seen[:, number])
        x, y, depth = matrix[:, :3] @ middle[places].T + matrix[:, 3:]
        column, row = (np.clip(at / depth, 0, size - 1).astype(np.int64) for at, size in ((x, width), (y, height)))
        pixel = photographs.firsts[number] + row * width + column
        reach = REACH * voxel_size + REACH_ERRORS * ERROR_PLANES * depths.error[pixel]
        result[places, number] = np.abs(depths.depth[pixel] - depth) <= reach  # false where it is NaN
    if tracks is not None and len(tracks.point) and len(middle):
        result |= _by_tracks(tracks, photographs.centres, middle, REACH * voxel_size)
    return result & seen


def _by_tracks(tracks: FeatureRays, centres: FloatArray, middle: FloatArray, reach: float) -> BoolArray:
    """Which photographs have a line to a point within `reach` of each place, shape (g, photographs)."""
    off, photograph = KDTree(centres).query(tracks.origins)
    own = np.asarray(off) <= 1e-3 * reach
    near = KDTree(middle).query_ball_point(tracks.points, reach)
    count = np.array([len(places) for places in near])[tracks.point[own]]
    found = np.zeros((len(middle), len(centres)), dtype=np.bool_)
    places = [place for point in tracks.point[own] for place in near[point]]
    found[np.array(places, dtype=np.int64), np.repeat(np.asarray(photograph)[own], count)] = True
    return found
