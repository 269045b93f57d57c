"""Which voxels the training cameras look at, and how many of them get there before something solid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.lattice import Lattice
from thermoxels_ns.snapshot import Views

BoolArray = npt.NDArray[np.bool_]

MOST_CAMERAS = 128
"""More cameras than this are thinned out evenly, in their order."""
SEEN_SHARE = 0.1
"""A voxel is seen if at least this share of the cameras whose image holds it, and at least one, has a free line to it:
a reconstruction has pinholes that single cameras look through."""
CLEAR_OF_CAMERA = 1.5
"""Solid voxels this close to a camera do not block it, [voxels]: floaters stick to cameras."""


@dataclass(frozen=True)
class Sight:
    """How cameras look at voxels."""

    in_image: npt.NDArray[np.uint8]
    """Number of cameras whose image holds the voxel's centre, shape `lattice.cell_shape`."""
    free: npt.NDArray[np.uint8]
    """Number of them with a free line to it; the voxel itself may be solid."""

    @property
    def seen(self) -> BoolArray:
        """Voxels that enough cameras see, see `SEEN_SHARE`."""
        return (self.free > 0) & (self.free >= np.float32(SEEN_SHARE) * self.in_image)

    @property
    def hidden(self) -> BoolArray:
        """Voxels that some image would hold, but that are not seen because something stands in front of them."""
        return (self.in_image > 0) & ~self.seen


def look(cells: BoolArray, lattice: Lattice, views: Views) -> Sight:
    """Count the cameras that see each voxel.

    Around each camera stand six pyramids, one per side of the lattice. In each of them, rays that lie one voxel apart
    at its far end go from layer to layer; a layer of voxels meets a regular grid of rays, so the ray of a voxel is a
    product of two look-ups along the axes. The cost is that of a few passes over the lattice per camera.

    Args:
        cells: True where a voxel blocks the view, shape `lattice.cell_shape`.
        lattice: Where the voxels are.
        views: The cameras.

    Returns:
        The counts, of at most `MOST_CAMERAS` cameras.
    """
    chosen = np.arange(len(views.focal))
    if len(chosen) > MOST_CAMERAS:
        chosen = np.linspace(0, len(chosen) - 1, MOST_CAMERAS).round().astype(np.int64)
    in_image = np.zeros(cells.shape, dtype=np.uint8)
    free = np.zeros(cells.shape, dtype=np.uint8)
    for order in ((0, 1, 2), (1, 0, 2), (2, 0, 1)):
        # Layers across the first of these axes are contiguous.
        layers = np.ascontiguousarray(cells.transpose(order))
        counts = np.zeros((2, *layers.shape), dtype=np.uint8)
        for number in chosen:
            camera = _Camera.of(views, int(number), lattice)
            for sign in (1, -1):
                _look_along(layers, counts, camera, order, sign)
        back = np.argsort(order)
        in_image += counts[0].transpose(back)
        free += counts[1].transpose(back)
    return Sight(in_image, free)


@dataclass(frozen=True)
class _Camera:
    """A pinhole in fractional corner indices."""

    eye: npt.NDArray[np.float64]
    axes: npt.NDArray[np.float64]
    focal: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]
    size: npt.NDArray[np.int64]

    @classmethod
    def of(cls, views: Views, number: int, lattice: Lattice) -> _Camera:
        pose = views.camera_to_world[number]
        eye = lattice.world_to_index(pose[:, 3])
        return cls(eye, pose[:, :3], views.focal[number], views.centre[number], views.size[number])

    def holds(self, direction: npt.NDArray[np.float64]) -> BoolArray:
        """Whether the image holds directions (..., 3)."""
        local = direction @ self.axes
        depth = -local[..., 2]
        ahead = depth > 1e-9
        scale = 1.0 / np.where(ahead, depth, 1.0)
        x = self.centre[0] + self.focal[0] * local[..., 0] * scale
        y = self.centre[1] - self.focal[1] * local[..., 1] * scale
        return ahead & (x >= 0) & (x <= self.size[0]) & (y >= 0) & (y <= self.size[1])


def _look_along(
    layers: BoolArray, counts: npt.NDArray[np.uint8], camera: _Camera, order: tuple[int, int, int], sign: int
) -> None:
    """Add what one camera sees in the pyramid around one half of an axis, layer after layer away from it."""
    eye = camera.eye[list(order)]
    distance = sign * (np.arange(len(layers)) + 0.5 - eye[0])
    ahead = np.flatnonzero(distance > 0.0)[::sign]
    if len(ahead) == 0:
        return
    near, far = distance[ahead[0]], distance[ahead[-1]]
    rays = []
    for across, centre, voxels in zip(order[1:], eye[1:], layers.shape[1:]):
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
    held = camera.holds(direction)
    if not held.any():
        return
    open_rays = held.copy()
    for layer, away in _with_distance(ahead, distance):
        (voxels_u, ray_u), (voxels_v, ray_v) = u.of_voxels(away), v.of_voxels(away)
        counts[0, layer, voxels_u, voxels_v] += held[ray_u][:, ray_v]
        counts[1, layer, voxels_u, voxels_v] += open_rays[ray_u][:, ray_v]
        if away > CLEAR_OF_CAMERA and layers[layer].any():
            (rays_u, voxel_u), (rays_v, voxel_v) = u.at_voxels(away), v.at_voxels(away)
            open_rays[rays_u, rays_v] &= ~layers[layer][voxel_u][:, voxel_v]


def _with_distance(ahead: npt.NDArray[np.int64], distance: npt.NDArray[np.float64]) -> Iterator[tuple[int, float]]:
    return zip(ahead.tolist(), distance[ahead].tolist())


@dataclass(frozen=True)
class _Rays:
    """Evenly spaced slopes of rays along one axis of the layers."""

    low: float
    step: float
    count: int
    eye: float
    voxels: int
    owns_diagonal: bool
    """Whether slopes of exactly 1 belong to this pyramid; else they belong to its neighbour."""

    @property
    def slopes(self) -> npt.NDArray[np.float64]:
        return self.low + (np.arange(self.count) + 0.5) * self.step

    def of_voxels(self, away: float) -> tuple[slice, npt.NDArray[np.int64]]:
        """The voxels of the layer that lie within the pyramid, and the ray nearest to each of them."""
        slope = (np.arange(self.voxels) + 0.5 - self.eye) / away
        number = np.clip(np.floor((slope - self.low) / self.step), -1, self.count).astype(np.int64)
        if self.owns_diagonal:
            number[slope == 1.0] = self.count - 1
        else:
            number[slope == -1.0] = -1
        return _inside(number, self.count)

    def at_voxels(self, away: float) -> tuple[slice, npt.NDArray[np.int64]]:
        """The rays that lie within the layer, and the voxel that each of them meets."""
        return _inside(np.floor(self.eye + self.slopes * away).astype(np.int64), self.voxels)


def _inside(number: npt.NDArray[np.int64], count: int) -> tuple[slice, npt.NDArray[np.int64]]:
    """The run of ascending numbers that lie in 0..count - 1."""
    start, stop = np.searchsorted(number, [0, count])
    return slice(int(start), int(stop)), number[start:stop]
