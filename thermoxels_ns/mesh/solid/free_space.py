"""Lines of sight among voxels: the first solid voxel on a ray, the ends of rays, what cameras see."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import RayEvidence, Views
from thermoxels_ns.core.voxel_walk import cells_crossed

MOST_CAMERAS = 128  # largest number of cameras that are counted; from more cameras, this number is chosen evenly
SEEN_SHARE = 0.1
"""Least share of the cameras whose image holds a voxel that must have a free line to it for the voxel to be seen; at
least one camera must. The share ignores pinholes of the reconstruction, through which only single cameras look."""
CLEAR_OF_CAMERA = 1.5  # solid voxels this close to a camera do not block it, [voxels]: floaters stick to cameras
REACH = 1.5
"""Length of the part of a ray before and behind its end in which `distance_to_ends` uses the ray and `without_front`
looks for solid, [voxels]. 1 and 2.5 gave the same F-score within 0.0005 (wild-3, wild-12)."""
START_ABOVE_SURFACE = (1.0, 0.5)
"""Distances along the normal from a triangle to the start of its line of sight, [voxels]. The first clears the steps
of voxel faces. The second replaces it if the first point is in a solid voxel, as in a gap one voxel wide."""
_STEP = 0.5  # Distance between the points of a ray at which voxels are looked up, [voxels]


@dataclass(frozen=True)
class CameraCounts:
    """Counts for each voxel of cameras whose image holds the voxel, and of these cameras with a free line to it."""

    in_image: npt.NDArray[np.uint8]
    """Number of cameras whose image holds the voxel's centre, shape `lattice.cell_shape`."""
    free: npt.NDArray[np.uint8]  # number of these cameras with a free line to the voxel (free or solid itself)

    @property
    def seen(self) -> BoolArray:
        """True for voxels that enough cameras see, by the rule of `SEEN_SHARE`."""
        return (self.free > 0) & (self.free >= np.float32(SEEN_SHARE) * self.in_image)

    @property
    def hidden(self) -> BoolArray:
        """True for voxels that lie in some camera's image but are not seen, because solid voxels block the view."""
        return (self.in_image > 0) & ~self.seen


def count_cameras(cells: BoolArray, lattice: Lattice, views: Views) -> CameraCounts:
    """Return for each voxel the counts of cameras that hold and see it, from at most `MOST_CAMERAS` cameras.

    Voxels that are True in `cells` block the view. The space around each camera is divided into six pyramids, one per
    side of the lattice. In each pyramid, rays that are one voxel apart at the far end are followed from layer to layer.
    The rays meet a layer in a regular grid, so one look-up per axis finds the ray of a voxel. The cost per camera is
    two or three passes over the lattice.
    """
    chosen = np.arange(len(views.focal))
    if len(chosen) > MOST_CAMERAS:
        chosen = np.linspace(0, len(chosen) - 1, MOST_CAMERAS).round().astype(np.int64)
    eyes = lattice.world_to_index(views.camera_to_world[:, :, 3])
    both = np.zeros((2, *cells.shape), dtype=np.uint8)
    for order in ((0, 1, 2), (1, 0, 2), (2, 0, 1)):
        # The layers across the first axis of `order` are contiguous in memory.
        solid = np.ascontiguousarray(cells.transpose(order))
        counts = np.zeros((2, *solid.shape), dtype=np.uint8)
        for camera in chosen.tolist():
            for sign in (1, -1):
                _count_along(solid, counts, views, camera, eyes[camera, list(order)], order, sign)
        both += counts.transpose(0, *(1 + np.argsort(order)))
    return CameraCounts(*both)


def _count_along(
    solid: BoolArray,
    counts: npt.NDArray[np.uint8],
    views: Views,
    camera: int,
    eye: FloatArray,
    order: tuple[int, int, int],
    sign: int,
) -> None:
    """Add one camera's view to `counts` (in place), in the pyramid around the half `sign` (1 or -1) of axis `order[0]`.
    `solid`, `counts` (2, ...) and `eye` have their axes in `order`; `counts` holds the arrays of `CameraCounts`."""
    distance = sign * (np.arange(len(solid)) + 0.5 - eye[0])
    ahead = np.flatnonzero(distance > 0.0)[::sign]
    if len(ahead) == 0:
        return
    away = distance[ahead]
    ends = (np.array([[0], [1]]) * solid.shape[1:] - eye[1:])[:, None] / away[[0, -1], None]  # slopes, (2, 2, 2)
    low, high = np.maximum(ends[0].min(axis=0), -1.0), np.minimum(ends[1].max(axis=0), 1.0)
    if (low >= high).any():
        return
    count = np.ceil((high - low) * away[-1]).astype(np.int64)
    step = (high - low) / count
    u, v = (low[axis] + (np.arange(count[axis]) + 0.5) * step[axis] for axis in (0, 1))
    direction = np.empty((*count, 3))
    direction[..., order[0]] = sign
    direction[..., order[1]], direction[..., order[2]] = u[:, None], v
    held = views.shows(camera, direction)
    if held.any():
        # Rays of slope exactly 1 or -1 belong to the pyramid around the lower axis.
        _follow(solid, held, eye, u, v, low, step, np.greater(order[1:], order[0]), ahead, away, *counts)


@kernel
def _follow(solid, held, eye, u, v, low, step, owns, ahead, away, in_image, free):
    """Follow rays through the layers `ahead` at the distances `away` (l,) from the camera, and count voxels in place.

    One is added to `in_image` at each voxel whose ray is in the image, `held` (a, b), and to `free` if also no `solid`
    voxel blocks the ray. Rays start at `eye` with the slopes `u` (a,) and `v` (b,), which begin at `low` and differ by
    `step` (2,). `owns` (2,) says for both axes whether rays of slope exactly 1 or -1 belong to this pyramid.
    """
    clear, (_, num_u, num_v) = held.copy(), solid.shape
    ray_of_u, ray_of_v = np.empty(num_u, np.int64), np.empty(num_v, np.int64)
    for layer, distance in zip(ahead, away):
        for axis, ray_of, rays in ((0, ray_of_u, len(u)), (1, ray_of_v, len(v))):
            for n in range(len(ray_of)):
                slope = (n + 0.5 - eye[axis + 1]) / distance
                ray = max(-1.0, min(np.floor((slope - low[axis]) / step[axis]), float(rays)))
                if owns[axis] and slope == 1.0:
                    ray = rays - 1.0
                outside = ray == rays or (slope == -1.0 and not owns[axis])
                ray_of[n] = -1 if outside else ray
        inside_v = np.flatnonzero(ray_of_v >= 0)
        for i in np.flatnonzero(ray_of_u >= 0):
            for j in inside_v:
                if held[ray_of_u[i], ray_of_v[j]]:
                    in_image[layer, i, j] += 1
                    free[layer, i, j] += clear[ray_of_u[i], ray_of_v[j]]
        if distance > CLEAR_OF_CAMERA and solid[layer].any():
            rows = np.floor(eye[1] + u * distance).astype(np.int64)
            columns = np.floor(eye[2] + v * distance).astype(np.int64)
            inside_v = np.flatnonzero((columns >= 0) & (columns < num_v))
            for a in np.flatnonzero((rows >= 0) & (rows < num_u)):
                for b in inside_v:
                    if solid[layer, rows[a], columns[b]]:
                        clear[a, b] = False


def first_solid(
    cells: BoolArray, eye: FloatArray, directions: FloatArray, reach: FloatArray | float = np.inf
) -> FloatArray:
    """Return the distance from `eye` (corner indices) along each unit vector (n, 3) to the first solid voxel, (n,).

    Distances and `reach` are in [voxels]. The distance is infinite if no solid voxel lies within `reach`. Solid voxels
    within `CLEAR_OF_CAMERA` of the eye block no ray.
    """
    found = np.empty(len(directions))
    reach = np.broadcast_to(np.asarray(reach, dtype=np.float64), len(directions))
    shape = np.array(cells.shape)
    _enter_solid(cells.ravel(), shape, eye, directions, reach, CLEAR_OF_CAMERA, found)
    return found


@kernel
def _enter_solid(cells, shape, eye, directions, reach, clear, found):
    """Write the result of `first_solid` into `found`; `cells` is flat."""
    crossed, faces = np.empty(shape.sum(), np.int64), np.empty(shape.sum() + 1)
    for n in range(len(directions)):
        found[n] = np.inf
        for k in range(cells_crossed(eye, directions[n], reach[n], shape, crossed, faces)):
            if cells[crossed[k]] and faces[k + 1] > clear:
                found[n] = max(faces[k], clear)
                break


def distance_to_ends(evidence: RayEvidence, shape: tuple[int, ...]) -> Float32Array:
    """Return each voxel centre's truncated signed distance in front of the surface, shape `shape`, [voxels].

    The value is the mean, over rays that cross the voxel within `REACH` of their ends, of the distance along the ray
    from the centre to the end; it is negative behind the end (Curless and Levoy 1996). Voxels without rays are NaN.
    """
    size = math.prod(shape)
    total, count = np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.int32)
    for off in np.arange(-REACH, REACH + _STEP, _STEP, dtype=np.float32):
        voxel, inside = _voxels_at(evidence.ends + off * evidence.directions, shape)
        along = ((evidence.ends[inside] - voxel - 0.5) * evidence.directions[inside]).sum(axis=1)
        number = np.ravel_multi_index(tuple(voxel.T), shape)
        total += np.bincount(number, along, size)
        count += np.bincount(number, minlength=size)
    with np.errstate(invalid="ignore"):
        total /= count
    return total.reshape(shape)


def without_front(cells: BoolArray, evidence: RayEvidence, distance: Float32Array) -> BoolArray:
    """Return the solid voxels `cells` except those whose centre lies in front of the surface at which rays end.

    Every voxel that holds a piece of the surface stops rays, so a body of all these voxels is too large by half a
    voxel. A voxel in front is kept if a ray that ends in it would otherwise meet no solid within `REACH` behind its
    end, as at a sheet thinner than a voxel. If no voxel would be kept, all are. `distance` is `distance_to_ends`.
    """
    with np.errstate(invalid="ignore"):
        kept = cells & ~(distance > 0.0)
    met = np.zeros(len(evidence.ends), dtype=bool)
    for off in np.arange(0.0, REACH + _STEP, _STEP, dtype=np.float32):
        met |= solid_at(kept, evidence.ends + off * evidence.directions)
    needed = tuple(_voxels_at(evidence.ends[~met], cells.shape)[0].T)
    kept[needed] = cells[needed]
    return kept if kept.any() else cells


def solid_at(cells: BoolArray, points: FloatArray | Float32Array) -> BoolArray:
    """Return True for points (n, 3), in corner indices, in solid voxels, shape (n,); False outside the lattice."""
    voxel, inside = _voxels_at(points, cells.shape)
    inside[inside] = cells[tuple(voxel.T)]
    return inside


def _voxels_at(points: FloatArray | Float32Array, shape: tuple[int, ...]) -> tuple[IntArray, BoolArray]:
    """Return the voxels (m, 3) of the points in the lattice, and a mask (n,) of these points among all (n, 3)."""
    voxel = np.floor(points).astype(np.int64)
    inside = ((voxel >= 0) & (voxel < shape)).all(axis=1)
    return voxel[inside], inside


@dataclass(frozen=True)
class FacetViews:
    """The cameras that see each group of boundary triangles; all triangles of a group share one answer."""

    group: IntArray  # Group of each triangle, an index into the arrays below, shape (f,)
    middle: FloatArray  # Mean centroid of each group, shape (g, 3), [world units]
    normal: FloatArray  # Unit mean normal of each group, shape (g, 3)
    seen: BoolArray  # True where a camera sees a group, shape (g, cameras)


def facet_views(
    cells: BoolArray,
    lattice: Lattice,
    matrices: FloatArray,
    centres: FloatArray,
    sizes: IntArray,
    centroids_world: FloatArray,
    normals_world: FloatArray,
) -> FacetViews:
    """Return which cameras see which boundary triangles.

    A camera sees a triangle if the triangle faces the camera, lies in its image, and no solid voxel is on the straight
    line between the two. Triangles in one voxel whose normals have the same main direction (one of six) share one
    answer, found at their mean centroid.

    `cells`, shape `lattice.cell_shape`, is True for solid voxels. `matrices` (cameras, 3, 4) map world coordinates to
    homogeneous pixels with positive depth in front. Camera `centres` (cameras, 3) and `centroids_world` (f, 3) are in
    [world units], image widths and heights `sizes` (cameras, 2) in [pixels]; `normals_world` (f, 3) are unit normals.
    """
    # The shift by 1e-3 chooses one of two voxels for a triangle on their common face.
    centroids, shape = lattice.world_to_index(centroids_world), np.array(lattice.cell_shape)
    voxel = np.clip(np.floor(centroids - 1e-3).astype(np.int64) + 1, 0, shape)
    axis = np.argmax(np.abs(normals_world), axis=1)
    side = 2 * axis + (normals_world[np.arange(len(axis)), axis] > 0.0)
    _, group, count = np.unique(
        np.ravel_multi_index((*voxel.T, side), (*(shape + 1), 6)), return_inverse=True, return_counts=True
    )
    mean = [np.bincount(group, column, len(count)) / count for column in (*centroids.T, *normals_world.T)]
    middle, normal = np.stack(mean[:3], axis=1), np.stack(mean[3:], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)  # not zero: the main components in a group have one sign
    start = middle + START_ABOVE_SURFACE[0] * normal
    inside = solid_at(cells, start)
    start[inside] = (middle + START_ABOVE_SURFACE[1] * normal)[inside]
    world, seen = lattice.index_to_world(middle), np.zeros((len(middle), len(centres)), dtype=np.bool_)
    (possible,) = np.nonzero(~solid_at(cells, start))
    for camera, (matrix, eye, size) in enumerate(zip(matrices, lattice.world_to_index(centres), sizes)):
        column, row, depth = matrix[:, :3] @ world[possible].T + matrix[:, 3:]
        held = (depth > 0) & (column >= 0) & (column <= size[0] * depth) & (row >= 0) & (row <= size[1] * depth)
        held &= ((eye - middle[possible]) * normal[possible]).sum(axis=1) > 0.0
        chosen = possible[held]
        towards = start[chosen] - eye
        length = np.linalg.norm(towards, axis=1)
        met = first_solid(cells, eye, towards / np.maximum(length, 1e-12)[:, None], length)
        seen[chosen, camera] = np.isinf(met)
    return FacetViews(group, world, normal, seen)


def seen_facets(
    cells: BoolArray, views: Views, lattice: Lattice, centroids_world: FloatArray, normals_world: FloatArray
) -> BoolArray:
    """Return True for boundary triangles that some camera of `views` sees, (f,); arguments as in `facet_views`."""
    cameras = views.matrices(), views.camera_to_world[:, :, 3], views.size
    found = facet_views(cells, lattice, *cameras, centroids_world, normals_world)
    return found.seen.any(axis=1)[found.group]
