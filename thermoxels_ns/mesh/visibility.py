"""Which boundary triangles some training camera has a free line of sight to."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.checks import check_finite, check_shape
from thermoxels_ns.errors import MeshError
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.snapshot import Views

START_ABOVE_SURFACE = (1.0, 0.5)
"""A line of sight starts this far out along the normal, [voxels]: past the steps of a staircase, or, if something solid
is there, half as far, as in a gap of one voxel."""
CLEAR_OF_CAMERA = 1.5
"""Solid voxels this close to a camera's centre do not block it, [voxels]: floaters stick to cameras."""

_LARGEST_BLOCK = 5
"""Empty blocks of up to 2^5 voxels along an edge are crossed in one step."""
_NUDGE = 1e-4
"""How far a line steps into the next block, [voxels]."""
_REMEDY = "Pass one centroid and one outward unit normal per boundary triangle."


def seen_facets(
    cells: npt.NDArray[np.bool_],
    views: Views,
    lattice: Lattice,
    centroids_world: npt.NDArray[np.float64],
    normals_world: npt.NDArray[np.float64],
) -> npt.NDArray[np.bool_]:
    """Tell which boundary triangles at least one training camera sees.

    A camera sees a triangle that faces it, lies in its image and has no solid voxel on the straight line between
    them. Triangles that lie in the same voxel and face the same of the six sides share one answer, taken at their mean.

    Args:
        cells: True where a voxel is solid, shape `lattice.cell_shape`.
        views: The training cameras.
        lattice: Where the voxels are.
        centroids_world: Middle of each triangle, shape (f, 3), [world units].
        normals_world: Outward unit normals of the true surface, shape (f, 3), in world axes.

    Returns:
        True where seen, shape (f,).

    Raises:
        MeshError: Shapes that do not fit, or numbers that are not finite.
    """
    check_shape("cells", cells, lattice.cell_shape, "Pass the voxels of this lattice.", MeshError)
    check_shape("centroids_world", centroids_world, (None, 3), _REMEDY, MeshError)
    check_shape("normals_world", normals_world, (len(centroids_world), 3), _REMEDY, MeshError)
    centroids = check_finite("centroids_world", lattice.world_to_index(centroids_world), _REMEDY, MeshError)
    normals = check_finite("normals_world", np.asarray(normals_world, dtype=np.float64), _REMEDY, MeshError)

    group, middle, normal = _grouped(centroids, normals, lattice.cell_shape)
    space = _EmptySpace(cells)
    start = middle + START_ABOVE_SURFACE[0] * normal
    inside = space.solid_at(start)
    start[inside] = (middle + START_ABOVE_SURFACE[1] * normal)[inside]

    centres = lattice.world_to_index(views.camera_to_world[:, :, 3])
    seen = np.zeros(len(middle), dtype=bool)
    hidden = np.flatnonzero(~space.solid_at(start))
    for camera in _spread(centres):
        towards = centres[camera] - middle[hidden]
        facing = hidden[np.einsum("ij,ij->i", normal[hidden], towards) > 0.0]
        inside = facing[_in_image(views, camera, middle[facing] - centres[camera])]
        seen[inside[space.free_lines(start[inside], centres[camera])]] = True
        hidden = hidden[~seen[hidden]]
    return seen[group]


def _grouped(
    centroids: npt.NDArray[np.float64], normals: npt.NDArray[np.float64], shape: tuple[int, int, int]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Group triangles by voxel and main direction.

    Returns:
        The group of each triangle, and mean centroid and unit mean normal of each group.
    """
    # The shift decides for one of two voxels where a triangle lies on their common face.
    voxel = np.clip(np.floor(centroids - 1e-3).astype(np.int64) + 1, 0, np.array(shape))
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (normals[np.arange(len(normals)), axis] > 0.0)
    key = np.ravel_multi_index((*voxel.T, side), (*(n + 1 for n in shape), 6))
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    mean = [np.bincount(group, column, len(count)) / count for column in (*centroids.T, *normals.T)]
    normal = np.stack(mean[3:], axis=1)
    # The main components of a group have one sign, so the mean is not zero.
    return group, np.stack(mean[:3], axis=1), normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _spread(centres: npt.NDArray[np.float64]) -> list[int]:
    """Order cameras so that each is as far as can be from those before it: the first few see most of a scene."""
    if len(centres) == 0:
        return []
    order = [0]
    distance = np.linalg.norm(centres - centres[0], axis=1)
    distance[0] = -1.0
    for _ in range(len(centres) - 1):
        order.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(centres - centres[order[-1]], axis=1))
        distance[order] = -1.0
    return order


def _in_image(views: Views, camera: int, offsets: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Whether points, given relative to a camera's centre in any unit, lie in its image, shape (points,)."""
    x, y, z = (offsets @ views.camera_to_world[camera, :, :3]).T
    front = z < 0.0
    depth = np.where(front, -z, 1.0)
    column = views.centre[camera, 0] + views.focal[camera, 0] * x / depth
    row = views.centre[camera, 1] - views.focal[camera, 1] * y / depth
    width, height = views.size[camera]
    return front & (column >= 0.0) & (column <= width) & (row >= 0.0) & (row <= height)


class _EmptySpace:
    """Solid voxels, arranged so that a line crosses empty space in large steps."""

    def __init__(self, cells: npt.NDArray[np.bool_]) -> None:
        """Find, around each voxel, the largest aligned block of 2^k voxels along an edge that is empty."""
        solid = np.nonzero(cells)
        bounds = [(int(s.min()), int(s.max()) + 1) for s in solid] if len(solid[0]) else [(0, 1)] * 3
        self.lowest = np.array([low for low, _ in bounds], dtype=np.float64)
        self.size = np.array([high - low for low, high in bounds])
        # Lines end at the bounding box of the solid: beyond it they are free.
        self.cells = np.ascontiguousarray(cells[tuple(slice(low, high) for low, high in bounds)])
        self.block = np.where(self.cells, -1, 0).astype(np.int8)
        occupied = self.cells
        for k in range(1, _LARGEST_BLOCK + 1):
            occupied = _any_of_pairs(occupied)
            empty = ~occupied
            if not empty.any():
                break
            for along in range(3):
                empty = np.repeat(empty, 1 << k, axis=along)
            nx, ny, nz = self.cells.shape
            self.block[empty[:nx, :ny, :nz]] = k

    def solid_at(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Whether points, in corner indices, are in solid voxels, shape (points,)."""
        index = np.floor(points - self.lowest).astype(np.int64)
        inside = np.all((index >= 0) & (index < self.size), axis=1)
        solid = np.zeros(len(points), dtype=bool)
        solid[inside] = self.cells[tuple(index[inside].T)]
        return solid

    def free_lines(self, start: npt.NDArray[np.float64], end: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Whether the lines from points to a camera's centre, all in corner indices, are free, shape (points,).

        The line is followed from block to block, through every voxel that it crosses by more than 0.0001 voxels.
        """
        # One row per axis: numpy is much faster along rows than along columns of three.
        origin = np.ascontiguousarray((start - self.lowest).T)
        direction = (end - self.lowest)[:, None] - origin
        distance = np.sqrt(_sum_of_rows(direction**2))
        direction /= np.maximum(distance, _NUDGE)
        # An axis along which the line does not move is never the one that it leaves a block by.
        inverse = 1.0 / np.where(np.abs(direction) < 1e-12, 1e-12, direction)
        ahead = (inverse > 0.0).astype(np.int64)
        size = self.size[:, None]
        travelled = np.maximum(_largest_of_rows(((1 - ahead) * size - origin) * inverse), 0.0) + _NUDGE
        last = np.minimum(_smallest_of_rows((ahead * size - origin) * inverse), distance - CLEAR_OF_CAMERA)

        free = np.ones(len(start), dtype=bool)
        line = np.arange(len(start))
        going = travelled < last
        while going.any():
            if not going.all():
                keep = np.flatnonzero(going)
                line, travelled, last = line[keep], travelled[keep], last[keep]
                origin, direction, inverse, ahead = (a.take(keep, 1) for a in (origin, direction, inverse, ahead))
            voxel = (origin + travelled * direction).astype(np.int64)
            np.clip(voxel, 0, size - 1, out=voxel)
            block = self.block.take((voxel[0] * self.size[1] + voxel[1]) * self.size[2] + voxel[2])
            blocked = block < 0
            free[line[blocked]] = False
            power = np.maximum(block, 0).astype(np.int64)
            leave = _smallest_of_rows(((((voxel >> power) + ahead) << power) - origin) * inverse)
            # At least a nudge, so that rounding on a block's border does not hold the line up.
            travelled = np.maximum(leave, travelled) + _NUDGE
            going = (travelled < last) & ~blocked
        return free


def _sum_of_rows(rows: npt.NDArray) -> npt.NDArray:
    return rows[0] + rows[1] + rows[2]


def _largest_of_rows(rows: npt.NDArray) -> npt.NDArray:
    return np.maximum(np.maximum(rows[0], rows[1]), rows[2])


def _smallest_of_rows(rows: npt.NDArray) -> npt.NDArray:
    return np.minimum(np.minimum(rows[0], rows[1]), rows[2])


def _any_of_pairs(cells: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Whether any voxel is solid in each aligned block of 2 x 2 x 2, the last ones cut off by the border."""
    for along in range(3):
        odd = cells.shape[along] % 2
        if odd:
            width = [(0, 0)] * 3
            width[along] = (0, 1)
            cells = np.pad(cells, width)
        first = [slice(None)] * 3
        second = [slice(None)] * 3
        first[along], second[along] = slice(0, None, 2), slice(1, None, 2)
        cells = cells[tuple(first)] | cells[tuple(second)]
    return cells
