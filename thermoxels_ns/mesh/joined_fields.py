"""One field made of the fields of overlapping blocks, so that one mesh without a seam can be cut out of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence, Views

_MOST_OFF = 0.02  # Largest distance between corners of two blocks that count as one corner, [voxels]


def joined(blocks: Sequence[GridSnapshot], shifts: FloatArray) -> tuple[GridSnapshot, IntArray]:
    """Return one field of the fields of `blocks`, and for each of its voxels the number of the block it is from.

    `shifts` (b, 3) move each block into the world of the result, [world units]. Where blocks overlap, a voxel or corner
    is taken from the block in whose lattice it lies deepest, so that a seam runs through the middle of the overlap. The
    number is -1, and the density 0, where no block is. Raises `MeshError` unless each block overlaps another and all
    voxels coincide.
    """
    first = blocks[0].lattice
    index = [first.world_to_index(np.add(one.lattice.lo, shift)) for one, shift in zip(blocks, shifts)]
    starts, sizes = np.rint(index).astype(np.int64), [one.lattice.voxel_size for one in blocks]
    off = max(np.abs(np.subtract(index, starts)).max(), 1e3 * (max(sizes) / min(sizes) - 1.0))
    if off > _MOST_OFF:
        expected, got = "blocks whose voxels coincide", f"voxels of {min(sizes):.4g} to {max(sizes):.4g}, apart"
        remedy = "Train the blocks of one thermoxels split with the same options."
        raise MeshError("blocks", expected=expected, got=got, remedy=remedy)
    ends = starts + [one.lattice.cell_shape for one in blocks]
    for number, (start, end) in enumerate(zip(starts, ends)):
        overlaps = (np.maximum(start, starts) < np.minimum(end, ends)).all(axis=1)
        if overlaps.sum() < 2:
            remedy = "Pass all blocks of one thermoxels split."
            raise MeshError("blocks", expected="blocks that overlap", got=f"block {number + 1} alone", remedy=remedy)
    starts -= starts.min(axis=0)
    nx, ny, nz = np.max([start + one.lattice.shape for start, one in zip(starts, blocks)], axis=0).tolist()
    x, y, z = first.index_to_world(np.rint(np.min(index, axis=0))).tolist()
    lattice = Lattice((x, y, z), first.voxel_size, (nx, ny, nz))
    of_corners, of_cells = (
        _owners(starts, [one.lattice.shape for one in blocks], lattice.shape),
        _owners(starts, [one.lattice.cell_shape for one in blocks], lattice.cell_shape),
    )

    def gathered(arrays: Sequence[npt.NDArray | None], owner: IntArray) -> npt.NDArray | None:
        """Return each block's own part of arrays over corners or voxels; None if a block has none."""
        known = [array for array in arrays if array is not None]
        if len(known) < len(arrays):
            return None
        whole = np.zeros((*owner.shape, *known[0].shape[3:]), known[0].dtype)
        for number, (start, array) in enumerate(zip(starts, known)):
            place = tuple(slice(low, low + count) for low, count in zip(start, array.shape))
            own = owner[place] == number
            whole[place][own] = array[own]
        return whole

    evidence, seen = None, [one.evidence for one in blocks]
    if all(one is not None for one in seen):
        rays = list[tuple[npt.NDArray, ...]]()
        for number, (start, one) in enumerate(zip(starts, seen)):
            assert one is not None
            ends = one.ends + start.astype(np.float32)
            cell = np.clip(np.floor(ends).astype(np.int64), 0, np.array(lattice.cell_shape) - 1)
            own = of_cells[tuple(cell.T)] == number
            rays.append((one.half_depth_density[own], ends[own], one.directions[own]))
        evidence = RayEvidence(*(np.concatenate(parts) for parts in zip(*rays)))
    density, observed = (gathered([getattr(o, n) for o in blocks], of_corners) for n in ("density", "observed_weight"))
    assert density is not None and observed is not None
    whole = GridSnapshot(
        lattice,
        density,
        gathered([one.temperature_c for one in blocks], of_corners),
        observed,
        gathered([one.centre_density().astype(np.float32) for one in blocks], of_cells),
        gathered([one.colour for one in blocks], of_corners),
        evidence,
        _joined_views([one.views for one in blocks], shifts),
    )
    return whole, of_cells


def _owners(starts: IntArray, shapes: Sequence[tuple[int, ...]], whole: tuple[int, ...]) -> IntArray:
    """Return the number of the block in which each place of the `whole` lies deepest, -1 outside all, shape `whole`.

    An end of a block where the whole ends, too, does not count.
    """
    owner, deepest = np.full(whole, -1, np.int64), np.full(whole, -1, np.int32)
    for number, (start, shape) in enumerate(zip(starts, shapes)):
        along = []
        for low, count, total in zip(start.tolist(), shape, whole):
            place = np.arange(total, dtype=np.int32)
            before = place - low + total * (low == 0)
            behind = low + count - 1 - place + total * (low + count == total)
            along.append(np.minimum(before, behind))
        x, y, z = np.ix_(*along)
        depth = np.minimum(np.minimum(x, y), z)
        deeper = depth > deepest
        owner[deeper], deepest[deeper] = number, depth[deeper]
    return owner


def _joined_views(views: Sequence[Views | None], shifts: FloatArray) -> Views | None:
    """Return all views in the world of the result, each once; None if those of a block are not known."""
    known = [one for one in views if one is not None]
    if len(known) < len(views):
        return None
    poses = [one.camera_to_world.copy() for one in known]
    for pose, shift in zip(poses, shifts):
        pose[:, :, 3] += shift
    parts = [
        np.concatenate(poses),
        *(np.concatenate([getattr(o, n) for o in known]) for n in ("focal", "centre", "size")),
    ]
    rows = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1).round(4)
    chosen = np.sort(np.unique(rows, axis=0, return_index=True)[1])
    return Views(*(part[chosen] for part in parts))
