"""Votes of photographs: which voxels are air, and which surfaces lie at the photographs' depths."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.feature_rays import MARGIN_ERRORS, MARGIN_VOXELS, FeatureRays
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.core.voxel_walk import cells_crossed
from thermoxels_ns.multiview.stereo import ERROR_PLANES, Depths

CountArray = npt.NDArray[np.int32]

FEWEST_POINTS = 2  # Points whose rays must cross a voxel before it counts as free: a single point may be wrong


def air_voxels(lattice: Lattice, rays: FeatureRays) -> BoolArray:
    """Return a mask of the voxels that are air, shape `lattice.cell_shape`.

    A voxel is free if it has no point, and if rays to at least `FEWEST_POINTS` points cross it and leave it at least
    `MARGIN_VOXELS` voxels plus `MARGIN_ERRORS` standard errors before their points. A free voxel is air if its six
    neighbours are free too, because a ray that grazes a surface crosses voxels with a part of the surface. (Drawn white
    house and courtyard, 32 and 128 voxels: 1 to 6 % of the voxels on the surface are free and at most 0.04 % are air;
    50 to 75 % of the voxels that truly are air are found.)
    """
    crossing, points = votes(lattice, rays)
    free = (crossing >= FEWEST_POINTS) & (points == 0)
    return np.asarray(ndimage.binary_erosion(free, border_value=1), dtype=np.bool_)


def hardly_shown(points: FloatArray, views: Views) -> BoolArray:
    """Return for each point (n, 3) whether fewer than two photographs show it, as around and behind cameras, (n,).

    At such a point no second photograph tells a depth, and no ray of another photograph refutes a floater. (A real
    room, draft quality: 22.2 dB with gains and poses fitted and 1.9 K without this rule, 23.2 dB and 1.4 K with it.)
    """
    eyes, left = views.camera_to_world[:, :, 3], np.arange(len(points))
    shown = np.zeros(len(points), dtype=np.int64)
    for camera, eye in enumerate(eyes):
        shown[left] += views.shows(camera, points[left] - eye)
        left = left[shown[left] < 2]
    return shown < 2


def votes(lattice: Lattice, rays: FeatureRays) -> tuple[CountArray, CountArray]:
    """Return two counts per voxel, both `lattice.cell_shape`: the points with a ray that crosses the voxel and leaves
    it at least the margin of `air_voxels` before its end, and the points in the voxel."""
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
    """Add 1 to ``crossing[voxel]`` for each point with a ray that leaves the voxel at least its margin before its end.
    `origins`, and `ends` by number of the point, are in corner indices, `margin` (rays,) is in voxels. `point` (rays,)
    must ascend, so that each point counts once. `last` (voxels,), the last point counted, must be -1 at the start."""
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
    """Return which photographs support a surface at given places because their own depth or a track's point lies there.

    If a photograph has no sure depth at a place (see `depths_of`), as on a plain wall, only tracks can support it. A
    surface that hangs in free space is not supported, because photographs have the depths of what stands behind it.

    Args:
        depths: Depths of the photographs.
        middle: Places on the surface, shape (g, 3), [world units].
        seen: True where a photograph sees a place, shape (g, photographs).
        voxel_size: Edge of a voxel, [world units].
        tracks: Feature rays from photographs to points of tracks, [world units]; None: no tracks.

    Returns:
        True where a photograph sees and supports a place, shape (g, photographs).
    """
    photographs, result = depths.photographs, np.zeros(seen.shape, dtype=np.bool_)
    for number in range(len(photographs)):
        (places,) = np.nonzero(seen[:, number])
        pixel, depth, shown = photographs.shown(number, middle[places])
        reach = MARGIN_VOXELS * voxel_size + MARGIN_ERRORS * ERROR_PLANES * depths.error[pixel]
        result[places, number] = shown & (np.abs(depths.depth[pixel] - depth) <= reach)  # false where it is NaN
    if tracks is not None and len(tracks.point) and len(middle):
        result |= _by_tracks(tracks, photographs.centres, middle, MARGIN_VOXELS * voxel_size)
    return result & seen


def _by_tracks(tracks: FeatureRays, centres: FloatArray, middle: FloatArray, reach: float) -> BoolArray:
    """Return whether each photograph has a feature ray to a point within `reach` of each place, (g, photographs)."""
    off, photograph = KDTree(centres).query(tracks.origins)
    own = np.asarray(off) <= 1e-3 * reach
    near = KDTree(middle).query_ball_point(tracks.points, reach)
    count = np.array([len(places) for places in near])[tracks.point[own]]
    found = np.zeros((len(middle), len(centres)), dtype=np.bool_)
    places = [place for point in tracks.point[own] for place in near[point]]
    found[np.array(places, dtype=np.int64), np.repeat(np.asarray(photograph)[own], count)] = True
    return found
