"""Lines of sight among solid voxels: where rays meet the first one, and how many training cameras see each voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.core.voxel_walk import cells_crossed

MOST_CAMERAS = 128  # largest number of cameras that are counted; of more cameras, so many are chosen evenly
SEEN_SHARE = 0.1
"""A voxel is seen if at least this share of the cameras whose image holds the voxel, and at least one camera, has a
free line to the voxel: a reconstruction has pinholes that single cameras look through."""
CLEAR_OF_CAMERA = 1.5  # solid voxels this close to a camera do not block it, [voxels]: floaters stick to cameras


@dataclass(frozen=True)
class CameraCounts:
    """For each voxel, the number of cameras whose image holds it and how many of these have a free line to it."""

    in_image: npt.NDArray[np.uint8]
    """Number of cameras whose image holds the voxel's centre, shape `lattice.cell_shape`."""
    free: npt.NDArray[np.uint8]  # number of these cameras with a free line to the voxel, which may be solid itself

    @property
    def seen(self) -> BoolArray:
        """Return True for voxels that enough cameras see, by the rule of `SEEN_SHARE`."""
        return (self.free > 0) & (self.free >= np.float32(SEEN_SHARE) * self.in_image)

    @property
    def hidden(self) -> BoolArray:
        """Return True for voxels that lie in some camera's image but are not seen, as solid voxels block the view."""
        return (self.in_image > 0) & ~self.seen


def count_cameras(cells: BoolArray, lattice: Lattice, views: Views) -> CameraCounts:
    """Count for each voxel the cameras that see it, of at most `MOST_CAMERAS`; voxels True in `cells` block the view.

    The space around each camera is six pyramids, one per side of the lattice. In each, rays that are one voxel apart at
    the far end are followed from layer to layer. They meet a layer in a regular grid, so that the ray of a voxel takes
    one look-up per axis. The cost is two or three passes over the lattice per camera.
    """
    chosen = np.arange(len(views.focal))
    if len(chosen) > MOST_CAMERAS:
        chosen = np.linspace(0, len(chosen) - 1, MOST_CAMERAS).round().astype(np.int64)
    eyes = lattice.world_to_index(views.camera_to_world[:, :, 3])
    both = np.zeros(cells.shape, dtype=np.uint16)
    for order in ((0, 1, 2), (1, 0, 2), (2, 0, 1)):
        # The layers across the first axis of `order` are contiguous in memory.
        passes = np.where(np.ascontiguousarray(cells.transpose(order)), _HELD, _HELD + _FREE)
        blocks = cells.any(axis=order[1:])
        counts = np.zeros(passes.shape, dtype=np.uint16)
        for camera in chosen.tolist():
            for sign in (1, -1):
                _count_along(passes, blocks, counts, views, camera, eyes[camera, list(order)], order, sign)
        both += counts.transpose(np.argsort(order))
    return CameraCounts((both % _FREE).astype(np.uint8), (both // _FREE).astype(np.uint8))


_HELD, _FREE = np.uint16(1), np.uint16(256)
"""Units of the two counts, which share one number: `_HELD` for an image that holds a voxel, `_FREE` for a free line."""


def _count_along(
    passes: npt.NDArray[np.uint16],
    blocks: BoolArray,
    counts: npt.NDArray[np.uint16],
    views: Views,
    camera: int,
    eye: FloatArray,
    order: tuple[int, int, int],
    sign: int,
) -> None:
    """Add to `counts` what one camera sees in the pyramid around one half (`sign`) of the axis `order[0]`."""
    distance = sign * (np.arange(len(passes)) + 0.5 - eye[0])
    ahead = np.flatnonzero(distance > 0.0)[::sign]
    if len(ahead) == 0:
        return
    away = distance[ahead]
    near, far = away[0], away[-1]
    rays = []
    for across, centre, voxels in zip(order[1:], eye[1:], passes.shape[1:]):
        ends = np.array([-centre, voxels - centre])
        low, high = max(min(ends[0] / near, ends[0] / far), -1.0), min(max(ends[1] / near, ends[1] / far), 1.0)
        if low >= high:
            return
        count = int(np.ceil((high - low) * far))
        rays.append(_Rays(low, (high - low) / count, count, centre, voxels, owns_diagonal=across > order[0]))
    u, v = rays
    direction = np.empty((u.count, v.count, 3))
    direction[..., order[0]] = sign
    direction[..., order[1]] = u.slopes[:, None]
    direction[..., order[2]] = v.slopes
    held = views.shows(camera, direction)
    if not held.any():
        return
    now = np.where(held, _HELD + _FREE, np.uint16(0))
    ray_u, ray_v, voxel_u, voxel_v = u.of_voxels(away), v.of_voxels(away), u.at_voxels(away), v.at_voxels(away)
    in_the_way = blocks[ahead] & (away > CLEAR_OF_CAMERA)
    for step, layer in enumerate(ahead.tolist()):
        (voxels_u, from_u), (voxels_v, from_v) = ray_u[step], ray_v[step]
        counts[layer, voxels_u, voxels_v] += now.take(from_u, axis=0).take(from_v, axis=1)
        if in_the_way[step]:
            (rays_u, from_u), (rays_v, from_v) = voxel_u[step], voxel_v[step]
            now[rays_u, rays_v] &= passes[layer].take(from_u, axis=0).take(from_v, axis=1)


@dataclass(frozen=True)
class _Rays:
    """Rays of a pyramid, evenly spaced by their slopes along one axis of the layers."""

    low: float  # lowest slope
    step: float  # difference of the slopes of neighbours
    count: int  # number of rays
    eye: float  # position of the camera along the axis, [voxels]
    voxels: int  # number of voxels along the axis
    owns_diagonal: bool  # True: rays of slope exactly 1 or -1 belong to this pyramid; False: to its neighbour

    @property
    def slopes(self) -> FloatArray:
        return self.low + (np.arange(self.count) + 0.5) * self.step

    def of_voxels(self, away: FloatArray) -> list[tuple[slice, IntArray]]:
        """Return, per layer at distance `away`, the run of voxels in the pyramid and the number of each one's ray."""
        slope = (np.arange(self.voxels) + 0.5 - self.eye) / away[:, None]
        number = np.clip(np.floor((slope - self.low) / self.step), -1, self.count).astype(np.int64)
        if self.owns_diagonal:
            number[slope == 1.0] = self.count - 1
        else:
            number[slope == -1.0] = -1
        return _runs(number, self.count)

    def at_voxels(self, away: FloatArray) -> list[tuple[slice, IntArray]]:
        """Return, per layer at distance `away`, the run of rays in the layer and the number of each one's voxel."""
        return _runs(np.floor(self.eye + self.slopes * away[:, None]).astype(np.int64), self.voxels)


def _runs(number: IntArray, count: int) -> list[tuple[slice, IntArray]]:
    """Return for each row of ascending numbers the slice of entries from 0 to `count` - 1, and these entries."""
    starts, stops = ((number < end).sum(axis=1).tolist() for end in (0, count))
    return [(slice(a, b), row[a:b]) for row, a, b in zip(number, starts, stops)]


def first_solid(
    cells: BoolArray, eye: FloatArray, directions: FloatArray, reach: FloatArray | float = np.inf
) -> FloatArray:
    """Return the distances (n,), [voxels], from `eye` (corner indices) along unit vectors (n, 3) to solid voxels.

    A ray that meets none within `reach`, [voxels], gets infinity. Solid nearer than `CLEAR_OF_CAMERA` blocks no ray.
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
