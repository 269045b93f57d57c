"""Which training cameras have a free line of sight to boundary triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import CLEAR_OF_CAMERA
from thermoxels_ns.mesh.solid.morphology import bounding_box, halved, repeated

START_ABOVE_SURFACE = (1.0, 0.5)
"""A line of sight starts this far out along the normal, [voxels]: past the steps of a staircase, or, if something solid
is there, half as far, as in a gap of one voxel."""

_LARGEST_BLOCK = 5  # Empty blocks of up to 2^5 voxels along an edge are crossed in one step
_NUDGE = 1e-4  # How far a line steps into the next block, [voxels]


def seen_facets(
    cells: BoolArray, views: Views, lattice: Lattice, centroids_world: FloatArray, normals_world: FloatArray
) -> BoolArray:
    """Tell which boundary triangles at least one training camera sees, shape (f,); arguments as in `facet_views`."""
    order = _spread(views.camera_to_world[:, :, 3])
    centres = views.camera_to_world[order, :, 3]
    cameras = views.matrices()[order], centres, views.size[order]
    found = facet_views(cells, lattice, *cameras, centroids_world, normals_world, enough=1)
    return found.seen.any(axis=1)[found.group]


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
    sizes: npt.NDArray[np.int64],
    centroids_world: FloatArray,
    normals_world: FloatArray,
    enough: int | None = None,
) -> FacetViews:
    """Tell which cameras see boundary triangles.

    A camera sees a triangle that faces it, lies in its image and has no solid voxel on the straight line between
    them. Triangles that lie in the same voxel and face the same of the six sides share one answer, taken at their mean.

    `cells` (`lattice.cell_shape`) are the solid voxels; `matrices` (cameras, 3, 4) lead from the world to homogeneous
    pixels, depth positive in front; `centres` (cameras, 3) and `centroids_world` (f, 3) are in [world units], `sizes`
    (cameras, 2) in [pixels], `normals_world` (f, 3) unit vectors. After `enough` cameras no others are tried.
    """
    # Triangles of one voxel and main direction. The shift decides for one of two voxels where a triangle lies on their
    # common face.
    centroids, shape = lattice.world_to_index(centroids_world), lattice.cell_shape
    voxel = np.clip(np.floor(centroids - 1e-3).astype(np.int64) + 1, 0, np.array(shape))
    axis = np.argmax(np.abs(normals_world), axis=1)
    side = 2 * axis + (normals_world[np.arange(len(axis)), axis] > 0.0)
    key = np.ravel_multi_index((*voxel.T, side), (*(n + 1 for n in shape), 6))
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    mean = [np.bincount(group, column, len(count)) / count for column in (*centroids.T, *normals_world.T)]
    middle, normal = np.stack(mean[:3], axis=1), np.stack(mean[3:], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)  # not zero: the main components of a group have one sign
    space = _EmptySpace(cells)
    start = middle + START_ABOVE_SURFACE[0] * normal
    inside = space.solid_at(start)
    start[inside] = (middle + START_ABOVE_SURFACE[1] * normal)[inside]
    index_centres = lattice.world_to_index(centres)
    index_to_world = np.diag([lattice.voxel_size] * 3 + [1.0])
    index_to_world[:3, 3] = lattice.index_to_world(np.zeros(3))
    seen = np.zeros((len(middle), len(centres)), dtype=np.bool_)
    _find_cameras(
        space.block,
        space.lowest,
        middle,
        normal,
        start,
        ~space.solid_at(start) & ~space.enclosed_at(start, index_centres),
        index_centres,
        np.ascontiguousarray(matrices @ index_to_world),
        np.asarray(sizes, dtype=np.float64),
        len(centres) if enough is None else enough,
        seen,
    )
    return FacetViews(group, lattice.index_to_world(middle), normal, seen)


def _spread(centres: FloatArray) -> list[int]:
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


class _EmptySpace:
    """Solid voxels, arranged so that a line crosses empty space in large steps."""

    def __init__(self, cells: BoolArray) -> None:
        """Find, around each voxel, the largest aligned block of 2^k voxels along an edge that is empty."""
        box = bounding_box(cells) if cells.any() else (slice(0, 1),) * 3
        self.lowest = np.array([part.start for part in box], dtype=np.float64)
        self.size = np.array([part.stop - part.start for part in box])
        # Lines end at the bounding box of the solid: beyond it they are free.
        self.cells = np.ascontiguousarray(cells[box])
        self.block = np.where(self.cells, -1, 0).astype(np.int8)
        occupied = self.cells
        for k in range(1, _LARGEST_BLOCK + 1):
            occupied = halved(occupied, np.logical_or)
            if occupied.all():
                break
            nx, ny, nz = self.cells.shape
            self.block[repeated(~occupied, 1 << k)[:nx, :ny, :nz]] = k

    def solid_at(self, points: FloatArray) -> BoolArray:
        """Whether points, in corner indices, are in solid voxels, shape (points,)."""
        return self._at(points, self.cells)

    def _at(self, points: FloatArray, flags: BoolArray) -> BoolArray:
        """The flag of the voxel that each point is in, False beyond the bounding box."""
        index = np.floor(points - self.lowest).astype(np.int64)
        inside = np.all((index >= 0) & (index < self.size), axis=1)
        found = np.zeros(len(points), dtype=bool)
        found[inside] = flags[tuple(index[inside].T)]
        return found

    def enclosed_at(self, points: FloatArray, cameras: FloatArray) -> BoolArray:
        """Whether points lie in empty space that solid voxels cut off from the outside and from all cameras.

        No line of sight leaves such a cavity, so it needs not be followed. Voxels that touch by a corner count as one
        space, because a line may pass there.
        """
        label = np.zeros(self.cells.shape, dtype=np.int32)
        ndimage.label(~self.cells, structure=np.ones((3, 3, 3), dtype=bool), output=label)  # type: ignore[arg-type]
        borders = [np.take(label, (0, -1), axis).ravel() for axis in range(3)]
        # Lines end at CLEAR_OF_CAMERA from a camera's centre, in one of the voxels around it.
        reach = int(np.ceil(CLEAR_OF_CAMERA)) + 2
        for camera in np.floor(cameras - self.lowest).astype(np.int64):
            low, high = np.maximum(camera - reach, 0), np.minimum(camera + reach + 1, self.size)
            if np.all(low < high):
                borders.append(label[tuple(slice(a, b) for a, b in zip(low, high))].ravel())
        is_open = np.zeros(int(label.max()) + 1, dtype=bool)
        for border in borders:
            is_open[border] = True
        return self._at(points, ~is_open[label])


@kernel
def _is_free(block, origin, x1, y1, z1):
    """Whether the line from a point to (x1, y1, z1) crosses no solid voxel; block is -1 in solid voxels."""
    x0, y0, z0 = origin[0], origin[1], origin[2]
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    scale = max(distance, _NUDGE)
    dx, dy, dz = dx / scale, dy / scale, dz / scale
    # An axis along which the line does not move is never the one that it leaves a block by.
    ix = 1.0 / (dx if abs(dx) >= 1e-12 else 1e-12)
    iy = 1.0 / (dy if abs(dy) >= 1e-12 else 1e-12)
    iz = 1.0 / (dz if abs(dz) >= 1e-12 else 1e-12)
    ax, ay, az = int(ix > 0.0), int(iy > 0.0), int(iz > 0.0)
    nx, ny, nz = block.shape
    enter = max(((1 - ax) * nx - x0) * ix, ((1 - ay) * ny - y0) * iy, ((1 - az) * nz - z0) * iz)
    last = min((ax * nx - x0) * ix, (ay * ny - y0) * iy, (az * nz - z0) * iz, distance - CLEAR_OF_CAMERA)
    travelled = max(enter, 0.0) + _NUDGE
    while travelled < last:
        i = min(max(int(x0 + travelled * dx), 0), nx - 1)
        j = min(max(int(y0 + travelled * dy), 0), ny - 1)
        k = min(max(int(z0 + travelled * dz), 0), nz - 1)
        power = block[i, j, k]
        if power < 0:
            return False
        leave = min(
            ((((i >> power) + ax) << power) - x0) * ix,
            ((((j >> power) + ay) << power) - y0) * iy,
            ((((k >> power) + az) << power) - z0) * iz,
        )
        # At least a nudge, so that rounding on a block's border does not hold the line up.
        travelled = max(leave, travelled) + _NUDGE
    return True


@kernel
def _find_cameras(block, lowest, middle, normal, start, open_start, centres, matrices, sizes, enough, seen):
    """Mark the cameras that each point faces, that have it in the image, and with a free line from the point's start.

    All in corner indices; `seen` is filled, shape (points, cameras), at most `enough` of each row.
    """
    origin = np.empty(3)
    likely = 0
    for p in range(len(middle)):
        if not open_start[p]:
            continue
        for axis in range(3):
            origin[axis] = start[p, axis] - lowest[axis]
        x, y, z = middle[p, 0], middle[p, 1], middle[p, 2]
        first, count = likely, 0
        for turn in range(len(centres)):
            # The camera that saw the point before often sees this one.
            camera = first if turn == 0 else turn - 1 if turn <= first else turn
            cx, cy, cz = centres[camera, 0], centres[camera, 1], centres[camera, 2]
            if normal[p, 0] * (cx - x) + normal[p, 1] * (cy - y) + normal[p, 2] * (cz - z) <= 0.0:
                continue
            m = matrices[camera]
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if depth <= 0.0:
                continue
            column = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
            row = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
            if not (0.0 <= column <= sizes[camera, 0] and 0.0 <= row <= sizes[camera, 1]):
                continue
            if _is_free(block, origin, cx - lowest[0], cy - lowest[1], cz - lowest[2]):
                seen[p, camera] = True
                likely = camera
                count += 1
                if count == enough:
                    break
