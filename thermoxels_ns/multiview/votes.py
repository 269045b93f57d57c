"""What photographs vote for: which voxels are air, and which surfaces lie where they are said to lie."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.core.voxel_walk import cells_crossed
from thermoxels_ns.multiview.stereo import ERROR_PLANES, Depths

CountArray = npt.NDArray[np.int32]

FEWEST_POINTS = 2  # Different points whose rays must cross a voxel: a single one may be wrong
MARGIN_VOXELS = 1.5  # Voxels before a point that are not judged by the rays to it
MARGIN_ERRORS = 3.0  # Standard errors of a ray's length that are not judged either
CLEARANCE = 0.5  # Distance from a camera up to which nothing stands, relative to the nearest thing that it shows
FEWEST_RAYS = 20  # Feature rays of a camera that tell what it shows
_NEAREST = 1.0  # Percentile of their lengths that is the nearest: a few may be wrong
REACH = 1.5  # Distance from a surface up to which a depth or a track's point lies on it, [voxels]
REACH_ERRORS = 2.0  # Standard errors of a depth that are added


def air_voxels(lattice: Lattice, rays: FeatureRays) -> BoolArray:
    """Find the voxels that are air: one boolean per voxel, shape of the lattice's voxels.

    A voxel is free if the rays to at least `FEWEST_POINTS` points cross it and leave it `MARGIN_VOXELS` voxels and
    `MARGIN_ERRORS` standard errors before their points, and no point lies in it, with rays or without. It is air if its
    six neighbours are free too: a ray that grazes a surface crosses voxels that hold a part of it. (Of a white house
    and a courtyard, drawn, with 32 and 128 voxels, 1 to 6 % of the voxels on the surface are free and at most 0.04 %
    are air, and so are 50 to 75 % of the voxels that it should be.)
    """
    crossing, points = votes(lattice, rays)
    free = (crossing >= FEWEST_POINTS) & (points == 0)
    return np.asarray(ndimage.binary_erosion(free, border_value=1), dtype=np.bool_)


def around_cameras(points: FloatArray, rays: FeatureRays, views: Views) -> BoolArray:
    """Which points (n, 3) are much nearer to a camera than what it shows, and in view of fewer than two photographs.

    What no second photograph shows, no training ray contradicts, and a lump there hides what stands behind it from
    views that did not train; but where somebody held a camera is air. (A real room: 21.5 dB without, 23.6 dB with.)
    """
    origins, camera_of = np.unique(rays.origins, axis=0, return_inverse=True)
    lengths = np.linalg.norm(rays.points[rays.point] - rays.origins, axis=1)
    near = np.zeros(len(points), dtype=np.bool_)
    for number, origin in enumerate(origins):
        own = lengths[camera_of.reshape(-1) == number]
        if len(own) >= FEWEST_RAYS:
            near |= np.linalg.norm(points - origin, axis=1) < CLEARANCE * np.percentile(own, _NEAREST)
    shown, (left,) = np.zeros(len(points), dtype=np.int64), np.nonzero(near)
    for matrix, (width, height) in zip(views.matrices(), views.size):
        column, row, depth = matrix[:, :3] @ points[left].T + matrix[:, 3:]
        held = (depth > 0.0) & (column >= 0.0) & (column < width * depth) & (row >= 0.0) & (row < height * depth)
        shown[left] += held
        left = left[shown[left] < 2]
    return near & (shown < 2)


def votes(lattice: Lattice, rays: FeatureRays) -> tuple[CountArray, CountArray]:
    """Count the points to which rays cross each voxel, and the points in it, both of the shape of the voxels."""
    shape = np.asarray(lattice.cell_shape)
    origins, ends = lattice.world_to_index(rays.origins), lattice.world_to_index(rays.points)
    margin = MARGIN_VOXELS + MARGIN_ERRORS * rays.uncertainty / lattice.voxel_size
    crossing, last = np.zeros(shape.prod(), np.int32), np.full(shape.prod(), -1, np.int64)
    _count_crossings(origins, rays.point, ends, margin, shape, crossing, last)
    place = np.floor(ends).astype(np.int64)
    place = place[((place >= 0) & (place < shape)).all(axis=1)]
    points = np.bincount(np.ravel_multi_index(tuple(place.T), tuple(shape)), minlength=shape.prod()).astype(np.int32)
    return crossing.reshape(shape), points.reshape(shape)


@kernel
def _count_crossings(origins, point, ends, margin, shape, crossing, last):
    """Count the voxels that each ray leaves `margin` before its end; coordinates are those of the lattice.

    Rays to one point stand together: each point counts once per voxel.
    """
    cells, faces = np.empty(shape.sum(), np.int64), np.empty(shape.sum() + 1)
    for n in range(len(origins)):
        along = ends[point[n]] - origins[n]
        length = np.sqrt((along * along).sum())
        stop = length - margin[n]
        if not stop > 0.0:
            continue
        for k in range(cells_crossed(origins[n], along / length, stop, shape, cells, faces)):
            if faces[k + 1] <= stop and last[cells[k]] != point[n]:
                last[cells[k]] = point[n]
                crossing[cells[k]] += 1


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
    for number in range(len(photographs)):
        (places,) = np.nonzero(seen[:, number])
        pixel, depth, shown = photographs.shown(number, middle[places])
        reach = REACH * voxel_size + REACH_ERRORS * ERROR_PLANES * depths.error[pixel]
        result[places, number] = shown & (np.abs(depths.depth[pixel] - depth) <= reach)  # false where it is NaN
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
