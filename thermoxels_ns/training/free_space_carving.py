"""Space carving: drop voxels that feature rays cross on the way to their points, and those around cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.feature_rays import FeatureRays, FloatArray, IntArray
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.refine import RowChange, prune
from thermoxels_ns.field.voxel_grid import VoxelGrid

FEWEST_POINTS = 2  # Different points whose rays must cross a voxel: a single one may be wrong
MARGIN_VOXELS = 1.5  # Voxels before a point that are not judged by the rays to it
MARGIN_ERRORS = 3.0  # Standard errors of a ray's length that are not judged either
MOST_RAYS = 500_000
"""Rays that are looked at; of more, those to every second, third, ... point. They say the same many times over."""
CLEARANCE = 0.5  # Distance from a camera up to which nothing stands, relative to the nearest thing that it shows
FEWEST_RAYS = 20  # Feature rays of a camera that tell what it shows
_NEAREST = 1.0  # Percentile of their lengths that is the nearest: a few may be wrong
_STEPS_PER_VOXEL = 2.0
_SAMPLES_AT_ONCE = 1 << 20

View = tuple[Camera, FloatArray]  # A photograph's camera and pose (camera to world, OpenGL axes, (3, 4) or (4, 4))


def carve_free_space(grid: VoxelGrid, rays: FeatureRays) -> RowChange | None:
    """Drop the kept voxels of a grid that feature rays show to be air, and say how many.

    Returns:
        How values of rows change; None where nothing changes.
    """
    voxels = grid.voxels
    empty = empty_voxels(voxels.lattice, rays).reshape(-1)[voxels.cells]
    carved = int(empty.sum())
    if carved in (0, len(empty)):
        return None
    believed = len(np.unique(rays.point))
    doubted = f"; {len(rays.points) - believed:,} others do not lie where their neighbours do"
    CONSOLE.log(
        f"tracks: {carved:,} of {len(empty):,} voxels are air ({carved / len(empty):.1%}), crossed by the "
        f"{len(rays.origins):,} feature rays to {believed:,} points{doubted if believed < len(rays.points) else ''}"
    )
    return prune(grid, ~empty)


def clear_cameras(grid: VoxelGrid, rays: FeatureRays, views: Sequence[View]) -> RowChange | None:
    """Drop the kept voxels of a grid where a camera was held, see `around_cameras`, and say how many.

    Returns:
        How values of rows change; None where nothing changes.
    """
    voxels, lattice = grid.voxels, grid.voxels.lattice
    centres = np.stack(np.unravel_index(voxels.cells, lattice.cell_shape), axis=1) + 0.5
    empty = around_cameras(np.asarray(lattice.lo) + lattice.voxel_size * centres, rays, views)
    if not empty.any() or empty.all():
        return None
    CONSOLE.log(f"cameras: {empty.sum():,} of {len(empty):,} voxels are where one was held")
    return prune(grid, ~empty)


def around_cameras(points: FloatArray, rays: FeatureRays, views: Sequence[View]) -> npt.NDArray[np.bool_]:
    """Which points (n, 3) are much nearer to a camera than what it shows, and in view of fewer than two photographs.

    What no second photograph shows, no training ray contradicts, and a lump there hides what stands behind it from
    views that did not train; but where somebody held a camera is air.
    """
    origins, camera_of = np.unique(rays.origins, axis=0, return_inverse=True)
    lengths = np.linalg.norm(rays.points[rays.point] - rays.origins, axis=1)
    near = np.zeros(len(points), dtype=bool)
    for number, origin in enumerate(origins):
        own = lengths[camera_of.reshape(-1) == number]
        if len(own) >= FEWEST_RAYS:
            near |= np.linalg.norm(points - origin, axis=1) < CLEARANCE * np.percentile(own, _NEAREST)
    shown, (left,) = np.zeros(len(points), dtype=np.int64), np.nonzero(near)
    for camera, pose in views:
        shown[left] += camera.contains(camera.project_world(pose, points[left]))
        left = left[shown[left] < 2]
    return near & (shown < 2)


def empty_voxels(lattice: Lattice, rays: FeatureRays) -> npt.NDArray[np.bool_]:
    """Find the voxels that are air: one boolean per voxel, shape of the lattice's voxels.

    A voxel is air if the rays to at least `FEWEST_POINTS` points cross it and leave it `MARGIN_VOXELS` voxels and
    `MARGIN_ERRORS` standard errors before their points, and no point lies in it, with rays or without.
    """
    shape = np.asarray(lattice.cell_shape)
    step = max(1, -(-len(rays.origins) // MOST_RAYS))
    looked_at = rays if step == 1 else _every(step, rays)
    crossing = np.zeros(int(shape.prod()), dtype=np.int64)
    for point, voxel in _crossings(lattice, looked_at):
        pairs = np.unique(point * len(crossing) + voxel)  # each point counts once per voxel
        crossing += np.bincount(pairs % len(crossing), minlength=len(crossing))
    empty = (crossing >= FEWEST_POINTS).reshape(lattice.cell_shape)
    return empty & (_points_in(lattice, rays.points) == 0)


def _every(step: int, rays: FeatureRays) -> FeatureRays:
    """The rays to every `step`-th point."""
    kept = rays.point % step == 0
    return FeatureRays(rays.origins[kept], rays.point[kept] // step, rays.points[::step], rays.uncertainty[kept])


def _points_in(lattice: Lattice, points: FloatArray) -> IntArray:
    """Number of points in each voxel."""
    place = np.floor(lattice.world_to_index(points))
    place = place[((place >= 0) & (place < lattice.cell_shape)).all(axis=1)].astype(np.int64)
    count = np.zeros(lattice.cell_shape, dtype=np.int64)
    np.add.at(count, tuple(place.T), 1)
    return count


def _crossings(lattice: Lattice, rays: FeatureRays) -> Iterator[tuple[IntArray, IntArray]]:
    """Points and flat voxels that rays to them cross, all rays of a point in one piece."""
    shape = np.asarray(lattice.cell_shape)
    origin = lattice.world_to_index(rays.origins)
    along = lattice.world_to_index(rays.points)[rays.point] - origin
    length = np.linalg.norm(along, axis=1)
    direction = along / np.maximum(length, 1e-12)[:, None]
    last = length - MARGIN_VOXELS - MARGIN_ERRORS * rays.uncertainty / lattice.voxel_size
    first, end = _inside(origin, direction, shape)
    steps = np.maximum(np.ceil((np.minimum(end, last) - first) * _STEPS_PER_VOXEL), 0.0).astype(np.int64)
    for piece in _pieces(rays.point, steps):
        ray = np.repeat(np.arange(piece.start, piece.stop), steps[piece])
        number = np.arange(len(ray)) - np.repeat(np.cumsum(steps[piece]) - steps[piece], steps[piece])
        at = first[ray] + (number + 0.5) / _STEPS_PER_VOXEL
        place = origin[ray] + at[:, None] * direction[ray]
        voxel = np.floor(place).astype(np.int64)
        with np.errstate(divide="ignore", invalid="ignore"):
            left = (voxel + (direction[ray] > 0) - place) / direction[ray]
        leaves = at + np.where(direction[ray] == 0.0, np.inf, left).min(axis=1)
        crossed = ((voxel >= 0) & (voxel < shape)).all(axis=1) & (leaves <= last[ray])
        voxel = voxel[crossed]
        yield rays.point[ray[crossed]], (voxel[:, 0] * shape[1] + voxel[:, 1]) * shape[2] + voxel[:, 2]


def _inside(origin: FloatArray, direction: FloatArray, shape: IntArray) -> tuple[FloatArray, FloatArray]:
    """Where rays from `origin` enter the box [0, shape] (at 0 if they begin in it) and leave it, in voxels."""
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.sort(np.stack([-origin / direction, (shape - origin) / direction]), axis=0)
    # A ray along a face of the box: 0 / 0.
    near = np.where(np.isnan(sides[0]), -np.inf, sides[0]).max(axis=1)
    far = np.where(np.isnan(sides[1]), np.inf, sides[1]).min(axis=1)
    return np.maximum(near, 0.0), far


def _pieces(point: IntArray, steps: IntArray) -> Iterator[slice]:
    """Cut rays, sorted by point, between points, into pieces of not many more than `_SAMPLES_AT_ONCE` samples."""
    ends = np.flatnonzero(np.diff(point, append=-1)) + 1
    done = np.cumsum(steps)[ends - 1] if len(ends) else np.zeros(0, dtype=np.int64)
    cuts = np.flatnonzero(np.diff(done // _SAMPLES_AT_ONCE, append=-1))
    first = 0
    for last in ends[cuts]:
        yield slice(first, int(last))
        first = int(last)
