"""Which part of the reconstruction is taken: where cameras look, a box, what lies near a point, or all of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import CLEAR_OF_CAMERA, MOST_CAMERAS

RegionKind = Literal["auto", "all"]
Box = tuple[float, float, float, float, float, float]
Ball = tuple[float, float, float, float]

_EXAMPLES = {"region_box": "-2 -2 0 2 2 3", "region_near": "0 0 1 2.5"}

LEAST_SHARE = 0.15
"""Space belongs to the region if photographs show it at least this well, as a share of how well they show what they
were taken of. Chosen on drawn scenes in a lattice three times their size: of nine with surroundings, all of the scene
stays (of two fronts photographed along a street, 99.8 %) and two thirds of the surroundings go; rooms photographed from
inside keep 98 % of what two photographs see."""
CENTRAL_PART, CENTRAL_RAYS = 0.5, 5  # the middle of an image, as a share of its sides, and rays along each of them
NEAREST_SHARE = 0.25
"""A camera was pointed at what this share of these rays end on first; the others may pass by an object."""
FEWEST_CAMERAS = 0.1
"""Share of the cameras that may look at places which are seen less well than what the others look at: overviews beside
many close-ups of a part, but not the few photographs that missed."""
MOST_BLOCKS = 500_000  # how well places are seen changes slowly: in larger lattices it is found in blocks of voxels


def where_cameras_look(cells: BoolArray, lattice: Lattice, views: Views) -> BoolArray:
    """Find the voxels, solid or not, that photographs show about as well as what they were taken of.

    A camera was pointed at what the rays through the middle of its image end on, d away (their median). It counts as
    one for all that its image holds up to there, and as (d / distance)^2 behind: so many pixels does an equal area
    get. Summed over the cameras this is how well a place is seen, whatever stands in front of it: a recess of a house
    stays with the house. The region is where the sum is `LEAST_SHARE` or more of the median over the cameras of what
    it is where they look; a ground that runs on ends about where the cameras stood.
    """
    count = len(views.focal)
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_CAMERAS)).round().astype(np.int64))
    eyes = lattice.world_to_index(views.camera_to_world[chosen, :, 3])
    far = np.array([_distance_looked_at(cells, views, camera, eye) for camera, eye in zip(chosen.tolist(), eyes)])
    looking = np.isfinite(far)
    if not looking.any():
        return np.ones_like(cells)
    chosen, eyes, far = chosen[looking], eyes[looking], far[looking]
    pixels = views.matrices()[chosen]
    pixels[:, :, 3] += pixels[:, :, :3] @ np.asarray(lattice.lo)
    pixels[:, :, :3] *= lattice.voxel_size

    def seen(at: FloatArray) -> FloatArray:
        """How well places (n, 3), in corner indices, are seen."""
        total = np.zeros(len(at))
        for matrix, eye, size, reach in zip(pixels, eyes, views.size[chosen], far):
            column, row, depth = matrix[:, :3] @ at.T + matrix[:, 3:]
            held = (depth > 0) & (column >= 0) & (column <= size[0] * depth) & (row >= 0) & (row <= size[1] * depth)
            total += held * np.minimum(1.0, reach**2 / np.maximum(((at - eye) ** 2).sum(axis=1), 1e-12))
        return total

    ahead = -views.camera_to_world[chosen, :, 2]
    least = LEAST_SHARE * float(np.quantile(seen(eyes + (1.0 - 1e-6) * far[:, None] * ahead), FEWEST_CAMERAS))
    block = 1
    while cells.size > MOST_BLOCKS * block**3:
        block *= 2
    coarse = tuple(-(-n // block) for n in cells.shape)
    middles = (np.stack(np.unravel_index(np.arange(np.prod(coarse)), coarse), axis=1) + 0.5) * block
    well = seen(middles).reshape(coarse).astype(np.float32)
    if block > 1:
        well = ndimage.zoom(well, block, order=1, mode="nearest", grid_mode=True)
    return well[tuple(slice(n) for n in cells.shape)] >= least


def _distance_looked_at(cells: BoolArray, views: Views, camera: int, eye: FloatArray) -> float:
    """Median distance at which rays through the middle of an image end, [voxels]; infinite if none does."""
    part = CENTRAL_PART * ((np.arange(CENTRAL_RAYS) + 0.5) / CENTRAL_RAYS - 0.5)
    across, along = np.meshgrid(*(part * views.size[camera, axis] / views.focal[camera, axis] for axis in (0, 1)))
    local = np.stack((across.ravel(), along.ravel(), np.full(CENTRAL_RAYS**2, -1.0)), axis=1)
    direction = local / np.linalg.norm(local, axis=1, keepdims=True) @ views.camera_to_world[camera, :, :3].T
    shape = np.array(cells.shape)
    distance = np.arange(CLEAR_OF_CAMERA, np.linalg.norm(eye - 0.5 * shape) + np.linalg.norm(shape), 0.5)
    voxel = np.floor(eye + distance[:, None, None] * direction).astype(np.int64)
    inside = np.all((voxel >= 0) & (voxel < shape), axis=2)
    solid = np.zeros(inside.shape, dtype=bool)
    solid[inside] = cells[tuple(voxel[inside].T)]
    ends = solid.any(axis=0)
    return float(np.quantile(distance[solid.argmax(axis=0)[ends]], NEAREST_SHARE)) if ends.any() else np.inf


def check_region(region: str, box: Box | None, near: Ball | None) -> None:
    """Refuse (`MeshError`) a region that is none, whatever the scene."""
    if region not in get_args(RegionKind):
        raise MeshError("region", expected="auto or all", got=repr(region), remedy="Pass --region auto.")
    if (region != "auto") + (box is not None) + (near is not None) > 1:
        got = " and ".join(name for name, given in _options(region, box, near) if given)
        raise MeshError("region", expected="one of them", got=got, remedy="Leave all but one of these options out.")
    for name, values, good in (
        ("region_box", box, box is None or all(low < high for low, high in zip(box[:3], box[3:]))),
        ("region_near", near, near is None or near[3] > 0.0),
    ):
        if values is not None and not (good and np.isfinite(values).all()):
            finite = "finite numbers xmin ymin zmin xmax ymax zmax, each minimum below its maximum"
            expected = finite if name == "region_box" else "finite numbers x y z radius, the radius above 0"
            remedy = f"Pass --{name.replace('_', '-')} {_EXAMPLES[name]}, for example, in the units of the input poses."
            raise MeshError(name, expected=expected, got=_typed(values), remedy=remedy)


def _options(region: str, box: Box | None, near: Ball | None) -> tuple[tuple[str, bool], ...]:
    return (
        (f"--region {region}", region != "auto"),
        ("--region-box", box is not None),
        ("--region-near", near is not None),
    )


def asked_region(
    cells: BoolArray, lattice: Lattice, box: Box | None, near: Ball | None, world_to_input: FloatArray
) -> BoolArray:
    """Find the voxels whose centres lie in a box, or near a point, given in the coordinates of the input poses.

    Raises:
        MeshError: None of `cells` does.
    """
    axes = [lattice.index_to_world(np.outer(np.arange(n) + 0.5, np.ones(3)))[:, a] for a, n in enumerate(cells.shape)]
    x, y, z = (
        row[0] * axes[0][:, None, None] + row[1] * axes[1][:, None] + row[2] * axes[2] + row[3]
        for row in world_to_input
    )
    if box is not None:
        within = np.ones_like(cells)
        for value, low, high in zip((x, y, z), box[:3], box[3:]):
            within &= (value >= low) & (value <= high)
    else:
        assert near is not None
        within = (x - near[0]) ** 2 + (y - near[1]) ** 2 + (z - near[2]) ** 2 <= near[3] ** 2
    if (cells & within).any():
        return within
    size = lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(world_to_input[:, :3]))))
    digits = max(0, 1 - math.floor(math.log10(size)))
    lower, upper = (
        np.array([side(value[cells]) + sign * size for value in (x, y, z)])
        for side, sign in ((np.min, -1), (np.max, 1))
    )
    name, got = ("region_box", box) if box is not None else ("region_near", near)
    everything = (*lower, *upper) if box is not None else (*0.5 * (lower + upper), 0.5 * np.linalg.norm(upper - lower))
    raise MeshError(
        name,
        expected=f"a place with some of the solid, which lies from {_typed(lower, digits)} to {_typed(upper, digits)}",
        got=f"{_typed(got)}, where there is none",
        remedy=f"Pass --{name.replace('_', '-')} {_typed(everything, digits)}, or less.",
    )


def _typed(values: Sequence[float] | FloatArray | None, digits: int | None = None) -> str:
    """Numbers as a command line takes them."""
    assert values is not None
    return " ".join(f"{value:g}" if digits is None else f"{value:.{digits}f}" for value in values)
