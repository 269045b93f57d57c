"""Lines of sight from training cameras to boundary triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import first_solid, solid_at

START_ABOVE_SURFACE = (1.0, 0.5)
"""Distances along the normal from a triangle to the start of its line of sight, [voxels]. The first leads past the
steps of voxel faces; the second is used if the first leads into a solid voxel, as in a gap of one voxel."""


@dataclass(frozen=True)
class FacetViews:
    """Which cameras see which boundary triangles; triangles are in groups, and one answer holds for a whole group."""

    group: IntArray  # Index in the arrays below of each triangle's group, shape (f,)
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
    """Return True for boundary triangles that a camera of `views` sees, (f,); other arguments as in `facet_views`."""
    cameras = views.matrices(), views.camera_to_world[:, :, 3], views.size
    found = facet_views(cells, lattice, *cameras, centroids_world, normals_world)
    return found.seen.any(axis=1)[found.group]
