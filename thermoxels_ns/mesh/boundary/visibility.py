"""Which training cameras have a free line of sight to boundary triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import first_solid

START_ABOVE_SURFACE = (1.0, 0.5)
"""A line of sight starts this far out along the normal, [voxels]: past the steps of a staircase, or, if something solid
is there, half as far, as in a gap of one voxel."""


@dataclass(frozen=True)
class FacetViews:
    """Which cameras see boundary triangles, for groups of triangles that share one answer."""

    group: IntArray  # Group of each triangle, shape (f,)
    middle: FloatArray  # Mean centroid of each group, shape (g, 3), [world units]
    normal: FloatArray  # Unit mean normal of each group, shape (g, 3)
    seen: BoolArray  # Whether each camera sees it, shape (g, cameras)


def facet_views(
    cells: BoolArray,
    lattice: Lattice,
    matrices: FloatArray,
    centres: FloatArray,
    sizes: IntArray,
    centroids_world: FloatArray,
    normals_world: FloatArray,
) -> FacetViews:
    """Tell which cameras see boundary triangles.

    A camera sees a triangle that faces it, lies in its image and has no solid voxel on the straight line between
    them. Triangles that lie in the same voxel and face the same of the six sides share one answer, taken at their mean.

    `cells` (`lattice.cell_shape`) are the solid voxels; `matrices` (cameras, 3, 4) lead from the world to homogeneous
    pixels, depth positive in front; `centres` (cameras, 3) and `centroids_world` (f, 3) are in [world units], `sizes`
    (cameras, 2) in [pixels], `normals_world` (f, 3) unit vectors.
    """
    # Triangles of one voxel and main direction. The shift decides for one of two voxels where a triangle lies on their
    # common face.
    centroids, shape = lattice.world_to_index(centroids_world), np.array(lattice.cell_shape)
    voxel = np.clip(np.floor(centroids - 1e-3).astype(np.int64) + 1, 0, shape)
    axis = np.argmax(np.abs(normals_world), axis=1)
    side = 2 * axis + (normals_world[np.arange(len(axis)), axis] > 0.0)
    _, group, count = np.unique(
        np.ravel_multi_index((*voxel.T, side), (*(shape + 1), 6)), return_inverse=True, return_counts=True
    )
    mean = [np.bincount(group, column, len(count)) / count for column in (*centroids.T, *normals_world.T)]
    middle, normal = np.stack(mean[:3], axis=1), np.stack(mean[3:], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)  # not zero: the main components of a group have one sign
    start = middle + START_ABOVE_SURFACE[0] * normal
    inside = _solid_at(cells, start)
    start[inside] = (middle + START_ABOVE_SURFACE[1] * normal)[inside]
    world, seen = lattice.index_to_world(middle), np.zeros((len(middle), len(centres)), dtype=np.bool_)
    (possible,) = np.nonzero(~_solid_at(cells, start))
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
    """Tell which boundary triangles at least one training camera sees, shape (f,); arguments as in `facet_views`."""
    cameras = views.matrices(), views.camera_to_world[:, :, 3], views.size
    found = facet_views(cells, lattice, *cameras, centroids_world, normals_world)
    return found.seen.any(axis=1)[found.group]


def _solid_at(cells: BoolArray, points: FloatArray) -> BoolArray:
    """Whether points, in corner indices, are in solid voxels, shape (points,); beyond the lattice none is."""
    index = np.floor(points).astype(np.int64)
    inside = np.all((index >= 0) & (index < cells.shape), axis=1)
    index[~inside] = 0
    return cells[tuple(index.T)] & inside
