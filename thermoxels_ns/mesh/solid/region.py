"""Which part of the reconstruction is taken: where cameras look, a box, what lies near a point, or all of it."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import MOST_CAMERAS, first_solid

RegionKind = Literal["auto", "all"]
Box = tuple[float, float, float, float, float, float]
Ball = tuple[float, float, float, float]

LEAST_SHARE = 0.15
"""Space belongs to the region if photographs show it at least this well, as a share of how well they show what they
were taken of. Chosen on nine drawn scenes with a street or a room around: all of the scene stays and half of what is
around goes; of drawn rooms seen from inside 99.7 % of what two photographs see stays."""
CENTRAL_PART, CENTRAL_RAYS = 0.5, 5  # the middle of an image, as a share of its sides, and rays along each of them
NEAREST_SHARE = 0.25  # a camera was pointed at what this share of these rays end on first
FEWEST_CAMERAS = 0.1  # share of the cameras that may look at places which are seen less well
MOST_BLOCKS = 500_000  # how well places are seen changes slowly: in larger lattices it is found in blocks of voxels


def where_cameras_look(cells: BoolArray, lattice: Lattice, views: Views) -> BoolArray:
    """Find the voxels, solid or not, that photographs show about as well as what they were taken of.

    A camera was pointed at what the rays through the middle of its image end on, d away. It counts as one for all that
    its image holds up to there, and as (d / distance)^2 behind: so many pixels does an equal area get. The region is
    where the sum over the cameras, whatever stands in front, is `LEAST_SHARE` or more of what it is where nearly all
    cameras look. A ground that runs on then ends about where the cameras stood.
    """
    eyes, far = lattice.world_to_index(views.camera_to_world[:, :, 3]), {}
    count = len(views.focal)
    part = CENTRAL_PART * ((np.arange(CENTRAL_RAYS) + 0.5) / CENTRAL_RAYS - 0.5)
    for camera in np.unique(np.linspace(0, count - 1, min(count, MOST_CAMERAS)).round().astype(np.int64)).tolist():
        across, along = np.meshgrid(*np.outer(views.size[camera] / views.focal[camera], part))
        local = np.stack((across.ravel(), along.ravel(), np.full(CENTRAL_RAYS**2, -1.0)), axis=1)
        direction = local / np.linalg.norm(local, axis=1, keepdims=True) @ views.camera_to_world[camera, :, :3].T
        met = first_solid(cells, eyes[camera], direction)
        if np.isfinite(met).any():
            far[camera] = float(np.quantile(met[np.isfinite(met)], NEAREST_SHARE))
    if not far:
        return np.ones_like(cells)
    matrices = views.matrices()
    matrices[:, :, 3] += matrices[:, :, :3] @ np.asarray(lattice.lo)
    matrices[:, :, :3] *= lattice.voxel_size

    def seen(at: FloatArray) -> FloatArray:
        """How well places (n, 3), in corner indices, are seen."""
        total = np.zeros(len(at))
        for camera, distance in far.items():
            column, row, depth = matrices[camera, :, :3] @ at.T + matrices[camera, :, 3:]
            width, height = views.size[camera]
            held = (depth > 0) & (column >= 0) & (column <= width * depth) & (row >= 0) & (row <= height * depth)
            total += held * np.minimum(1.0, distance**2 / np.maximum(((at - eyes[camera]) ** 2).sum(axis=1), 1e-12))
        return total

    looked_at = [eyes[c] - (1.0 - 1e-6) * distance * views.camera_to_world[c, :, 2] for c, distance in far.items()]
    least = LEAST_SHARE * float(np.quantile(seen(np.array(looked_at)), FEWEST_CAMERAS))
    block = 1
    while cells.size > MOST_BLOCKS * block**3:
        block *= 2
    shape = tuple(-(-n // block) for n in cells.shape)
    middles = (np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=1) + 0.5) * block
    well: npt.NDArray[np.float32] = seen(middles).reshape(shape).astype(np.float32)
    if block > 1:
        well = np.asarray(ndimage.zoom(well, block, order=1, mode="nearest", grid_mode=True))
    return well[tuple(slice(n) for n in cells.shape)] >= least


def check_region(region: str, box: Box | None, near: Ball | None) -> None:
    """Refuse (`MeshError`) a region that is none, whatever the scene."""
    if region not in get_args(RegionKind):
        raise MeshError("region", expected="auto or all", got=repr(region), remedy="Pass --region auto.")
    asked = {f"--region {region}": region != "auto", "--region-box": box is not None, "--region-near": near is not None}
    if sum(asked.values()) > 1:
        got = " and ".join(name for name, given in asked.items() if given)
        raise MeshError("region", expected="one of them", got=got, remedy="Leave all but one of these options out.")
    box_is_good = box is None or (np.isfinite(box).all() and np.less(box[:3], box[3:]).all())
    if not box_is_good or not (near is None or (np.isfinite(near).all() and near[3] > 0.0)):
        name, values, example = (
            ("region_near", near, "0 0 1 2.5") if box_is_good else ("region_box", box, "0 0 0 4 3 2")
        )
        low = (
            "x y z radius, the radius above 0" if box_is_good else "xmin ymin zmin xmax ymax zmax, minima below maxima"
        )
        remedy = f"Pass --{name.replace('_', '-')} {example}, for example, in units of the input poses."
        raise MeshError(name, expected=f"finite numbers {low}", got=_typed(values or ()), remedy=remedy)


def asked_region(
    cells: BoolArray, lattice: Lattice, box: Box | None, near: Ball | None, world_to_input: FloatArray
) -> BoolArray:
    """Find the voxels whose centres lie in a box or near a point, in the coordinates that `world_to_input` leads to.

    Raises:
        MeshError: None of `cells` is among them.
    """
    # Each coordinate of the input is a sum of what the three indices of a voxel give.
    middles = [
        lattice.lo[axis] + (np.arange(count) + 0.5) * lattice.voxel_size for axis, count in enumerate(cells.shape)
    ]
    along_x, along_y, along_z = np.ix_(*middles)
    places = [row[0] * along_x + row[1] * along_y + row[2] * along_z + row[3] for row in world_to_input]
    if box is not None:
        found = [(place >= low) & (place <= high) for place, low, high in zip(places, box[:3], box[3:])]
        within = found[0] & found[1] & found[2]
    else:
        assert near is not None
        away = [(place - middle) ** 2 for place, middle in zip(places, near[:3])]
        within = away[0] + away[1] + away[2] <= near[3] ** 2
    if (cells & within).any():
        return within
    size = lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(world_to_input[:, :3]))))
    digits = max(0, 1 - math.floor(math.log10(size)))
    ends = (place[cells] for place in places)
    lower, upper = (_typed(end, digits) for end in np.array([(end.min() - size, end.max() + size) for end in ends]).T)
    expected = f"some of the solid in it, which lies from {lower} to {upper}"
    got, remedy = f"none in {_typed(box or near or ())}", f"Pass --region-box {lower} {upper}, or less."
    raise MeshError("region_near" if box is None else "region_box", expected=expected, got=got, remedy=remedy)


def _typed(values: tuple[float, ...] | FloatArray, digits: int | None = None) -> str:
    """Numbers as a command line takes them."""
    return " ".join(f"{value:g}" if digits is None else f"{value:.{digits}f}" for value in values)
