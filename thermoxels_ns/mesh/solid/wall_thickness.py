"""Walls of a given thickness behind surfaces that cameras see from one side."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import Sight, look
from thermoxels_ns.mesh.solid.morphology import grow

BoolArray = npt.NDArray[np.bool_]


THINNEST_GROWN = 1.5
"""A wall thinner than this has the middle of no voxel behind the seen one, so none is added, [voxels]."""


def wall_behind(cells: BoolArray, lattice: Lattice, views: Views, thickness: float) -> BoolArray:
    """Find the voxels that make the seen surface as thick as a wall.

    Seen surface are the solid voxels that enough cameras have a free line to (see `free_space`). An
    empty voxel joins if it lies within the thickness of them, counted from their outer faces, on the straight way
    through space that is solid or not seen. Voxels that cameras look through never join, so a plate that is seen from
    both sides does not grow.

    Args:
        cells: Solid voxels, shape `lattice.cell_shape`.
        lattice: Where they are.
        views: The training cameras.
        thickness: Thickness of the wall, the seen voxel included, above 0, [voxels].

    Returns:
        The voxels to add, shape `lattice.cell_shape`; none of them is in `cells`.
    """
    sight = look(cells, lattice, views)
    return _grown(cells, sight, thickness)


def _grown(cells: BoolArray, sight: Sight, thickness: float) -> BoolArray:
    added = np.zeros_like(cells)
    # The middle of a surface voxel lies half a voxel below its face, that of the last one half a voxel before the end.
    reach = thickness - 0.5
    seen = sight.seen
    surface = np.argwhere(cells & seen & grow(seen & ~cells, 1))
    if thickness < THINNEST_GROWN or len(surface) == 0:
        return added
    closed = ~seen | cells
    near = grow(_at(surface, cells.shape), int(reach)) & closed & ~cells
    candidates = np.argwhere(near)
    distance, nearest = KDTree(surface).query(candidates, distance_upper_bound=reach + 1e-6)
    found = np.isfinite(distance)
    candidates, start = candidates[found], surface[np.asarray(nearest)[found]]
    free = np.ones(len(candidates), dtype=bool)
    steps = int(np.ceil(2.0 * reach))
    for step in range(1, steps):
        share = step / steps
        between = np.rint(start + share * (candidates - start)).astype(np.int64)
        free &= closed[tuple(between.T)]
    added[tuple(candidates[free].T)] = True
    return added


def _at(index: npt.NDArray[np.int64], shape: tuple[int, ...]) -> BoolArray:
    cells = np.zeros(shape, dtype=bool)
    cells[tuple(index.T)] = True
    return cells
