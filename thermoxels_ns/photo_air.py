"""Which voxels are air, and where surfaces are, because photographs agree about how far away they are.

Before walls of little texture a training can close fog that no picture gives away: light that fog has stopped says
nothing of what lies behind. Depths that neighbouring photographs agree about do (see `plane_sweep`): what many
photographs look through needs no density, and a start from photographs can begin dense where they end.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.depth_kernels import count_sights, mean_distances
from thermoxels_ns.field.refine import RowChange, prune
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.photo_consistency import DensityStart
from thermoxels_ns.photo_reading import read_photographs
from thermoxels_ns.plane_sweep import Depths, depths_of
from thermoxels_ns.threads import run_ranges

if TYPE_CHECKING:
    from thermoxels_ns.model import ThermoxelsModel

BoolArray = npt.NDArray[np.bool_]

FINEST = 128
"""Voxels along the longest side of the lattice on which air is looked for; finer ones take it over."""
LONGEST_SIDE = 160
"""Pixels along the longer side of the photographs that are compared."""
MOST_PHOTOGRAPHS = 64
"""Photographs compared; of more, that many are taken at equal distances in the list."""
FEWEST_SIGHTS = 4
"""Photographs that must look through a voxel of air."""
SIGHTS_PER_END = 4
"""Photographs that must look through it for each whose line of sight ends there."""
MARGIN_VOXELS = 0.5
"""Voxels before a depth that are not judged by it."""
MARGIN_ERRORS = 0.5
"""The same, in planes of the sweep: most depths are found to less than half of one."""
REACH_VOXELS = 4.0
"""Voxels before and behind a surface over which photographs' distances from it are averaged."""
MOST_GAIN, LEAST_GAIN = 5.0, -4.0
"""Logarithm of the factor on the start density at a surface, and away from it."""
GAIN_PER_VOXEL = 6.0
"""How much it falls per voxel from half a voxel on."""
LEAST_SHARE = 0.01
"""Share of the pixels whose depth must be known; less is chance."""


@dataclass(frozen=True, eq=False)
class SeenThrough:
    """Voxels that are air."""

    lattice: Lattice
    """The lattice that was looked at."""
    air: BoolArray
    """Shape of its voxels."""

    def within(self, lattice: Lattice) -> BoolArray:
        """The voxels of another lattice over the same box that are nothing but air.

        Args:
            lattice: Its resolution is a divisor or a multiple of that of `self.lattice`.
        """
        fine, other = self.lattice.cell_shape, lattice.cell_shape
        if other[0] > fine[0]:
            air = self.air
            for axis in range(3):
                air = np.repeat(air, other[axis] // fine[axis], axis=axis)
            return air
        x, y, z = other
        blocks = self.air.reshape(x, fine[0] // x, y, fine[1] // y, z, fine[2] // z)
        return blocks.all(axis=(1, 3, 5))


def air_from_depths(lattice: Lattice, depths: Depths) -> BoolArray:
    """Find the voxels that photographs look through.

    Args:
        lattice: The voxels.
        depths: Of the photographs.

    Returns:
        One boolean per voxel, shape of the lattice's voxels. True where at least `FEWEST_SIGHTS` photographs see
        something behind the voxel, and `SIGHTS_PER_END` times as many as those that see something in it.
    """
    total = int(np.prod(lattice.cell_shape))
    through, ends = (np.zeros(total, dtype=np.int32) for _ in range(2))
    photographs, lo, shape = depths.photographs, np.asarray(lattice.lo), np.asarray(lattice.cell_shape)

    def work(begin: int, end: int) -> None:
        count_sights(
            begin,
            end,
            lo,
            lattice.voxel_size,
            shape,
            photographs.matrices,
            photographs.sizes,
            photographs.firsts,
            depths.depth,
            depths.likely,
            np.float32(MARGIN_ERRORS) * depths.error,
            MARGIN_VOXELS * lattice.voxel_size,
            through,
            ends,
        )

    run_ranges(work, total, 4096)
    air = (through >= FEWEST_SIGHTS) & (through >= SIGHTS_PER_END * ends)
    return air.reshape(lattice.cell_shape)


def depths_said(model: ThermoxelsModel, datamanager: Any, left_out: Collection[int] = ()) -> Depths | None:
    """Ask the photographs for depths, and say what was found.

    Args:
        model: The model; its grid says where to look.
        datamanager: Has the photographs.
        left_out: Numbers of training photographs that are not asked.

    Returns:
        The depths; None where the photographs say too little, or are not to be asked.
    """
    if model.config.photo_depth == "off" or model.grid.sh is None or datamanager.config.streams == "thermal":
        return None
    began, lattice = time.perf_counter(), model.grid.lattice
    near = model.config.near_plane * model.unit
    photographs = read_photographs(datamanager.train_dataset, near, left_out, MOST_PHOTOGRAPHS, LONGEST_SIDE)
    if photographs is None:
        return None
    depths = depths_of(photographs, lattice.lo, lattice.hi)
    few = "" if depths.share >= LEAST_SHARE else ", too few to tell anything"
    CONSOLE.log(
        f"depths: {len(photographs)} photographs agree about {depths.share:.0%} of their pixels{few}; "
        f"{time.perf_counter() - began:.1f} s"
    )
    return None if few else depths


def find_air(model: ThermoxelsModel, datamanager: Any, left_out: Collection[int] = ()) -> SeenThrough | None:
    """Ask the photographs which voxels they look through; as `depths_said`."""
    depths = depths_said(model, datamanager, left_out)
    return None if depths is None else _seen_through(model, depths)


def start_from_depths(lattice: Lattice, depths: Depths, model: ThermoxelsModel) -> DensityStart:
    """Begin dense where photographs end.

    With s the mean distance of a corner before the depths of the photographs that see it, in voxels, the logarithm of
    the gain is ``clip(5 - 6 max(|s| - 0.5, 0), -4, 5)`` (s as in the signed distances of Curless and Levoy 1996).
    Corners that fewer than three photographs see keep the start density.

    Args:
        lattice: The lattice of the start.
        depths: Of the photographs.
        model: The model, for the air that it carves.
    """
    points, photographs = lattice.corner_positions().reshape(-1, 3), depths.photographs
    distance = np.empty(len(points))
    reach = REACH_VOXELS * lattice.voxel_size

    def work(begin: int, end: int) -> None:
        views = photographs.matrices, photographs.sizes, photographs.firsts
        mean_distances(begin, end, points, *views, depths.likely, reach, distance)

    run_ranges(work, len(points), 4096)
    off = np.maximum(np.abs(distance) / lattice.voxel_size - 0.5, 0.0)
    gain = np.where(np.isnan(off), 0.0, np.clip(MOST_GAIN - GAIN_PER_VOXEL * off, LEAST_GAIN, MOST_GAIN))
    air = _seen_through(model, depths)
    report = (
        f"depths end at {np.mean(gain > 0):.1%} of the corners, before which {air.air.mean():.0%} of the box is air"
    )
    return DensityStart(gain.reshape(lattice.shape).astype(np.float32), report, air)


def _seen_through(model: ThermoxelsModel, depths: Depths) -> SeenThrough:
    lattice = _finest(model)
    return SeenThrough(lattice, air_from_depths(lattice, depths))


def _finest(model: ThermoxelsModel) -> Lattice:
    """The lattice of the training on which air is looked for."""
    resolutions, lattice = model.config.resolutions, model.grid.lattice
    best = max((r for r in resolutions if r <= FINEST), default=resolutions[0])
    coarsest = Lattice.covering(lattice.lo, lattice.hi, resolutions[0])
    return coarsest if best == resolutions[0] else coarsest.refined(best // resolutions[0])


def carve_seen_through(model: ThermoxelsModel, found: SeenThrough | None) -> RowChange | None:
    """Drop the kept voxels of a model's grid that photographs look through, and say how many.

    Returns:
        How values of rows change; None where nothing changes.
    """
    if found is None:
        return None
    voxels = model.grid.voxels
    empty = found.within(voxels.lattice).reshape(-1)[voxels.cells]
    carved = int(empty.sum())
    if carved in (0, len(empty)):
        return None
    CONSOLE.log(f"depths: {carved:,} of {len(empty):,} voxels are air ({carved / len(empty):.1%})")
    return prune(model.grid, ~empty)
