"""Gradients of samples and of total variation as row-sparse tensors."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from thermoxels_ns.core.buffer_pool import BUFFERS
from thermoxels_ns.core.threads import num_threads, run_tasks
from thermoxels_ns.render import kernels_rows
from thermoxels_ns.render.kernels import Marched
from thermoxels_ns.render.kernels_rows import Blocks, Order, RowGradients

MOST_GROUPS = 1 << 12
"""Groups of voxels that samples are put in order by."""
RANGES_PER_THREAD = 4
VARIATION_SHARE = 0.02
"""Work of one channel's variation in a voxel, in samples."""


def row_gradients(marched: Marched, blocks: Blocks) -> list[Tensor | None]:
    """Gradients of density, colour and temperature as row-sparse tensors; None for one that no row has.

    Args:
        marched: Samples with their gradients, see `kernels_backward`.
        blocks: Total variation to add.
    """
    volume, records = marched.volume, marched.records
    parameters = (volume.density, volume.sh, volume.temperature)
    order = _ordered(marched)
    bounds = _row_ranges(volume.voxel_rows, len(volume.density), order, blocks, [p.shape[1] for p in parameters])
    ranges = list(itertools.pairwise(bounds))
    uses = BUFFERS.empty(len(volume.density), np.uint8)
    counts: Any = run_tasks(
        [lambda a=a, b=b: kernels_rows.use_rows(a, b, volume, records, order, blocks, uses) for a, b in ranges]
    )
    places = np.concatenate((np.zeros((1, 3), np.int64), np.cumsum(np.asarray(counts).reshape(-1, 3), axis=0)))
    lists = [BUFFERS.empty(int(total), np.int64) for total in places[-1]]
    values = [
        BUFFERS.empty((int(total), parameter.shape[1]), parameter.dtype)
        for total, parameter in zip(places[-1], parameters)
    ]
    place = BUFFERS.empty((len(uses), 3), np.int32)
    active = min(3 * marched.settings.sh_active, volume.sh.shape[1])
    narrow = active < volume.sh.shape[1]
    sums = BUFFERS.empty((len(values[1]), active), volume.sh.dtype) if narrow else values[1]
    rows = RowGradients(uses, place, lists[0], values[0], lists[1], values[1], sums, lists[2], values[2])

    def add(first: int, last: int, start: np.ndarray, stop: np.ndarray) -> None:
        kernels_rows.list_rows(first, last, int(start[0]), int(start[1]), int(start[2]), rows)
        kernels_rows.add_samples(first, last, marched.rays, volume, marched.settings, records, order, rows)
        kernels_rows.spread_harmonics(int(start[1]), int(stop[1] if narrow else start[1]), rows)
        for kind, parameter in enumerate(parameters):
            if blocks.last[kind] > blocks.first[kind]:
                kernels_rows.add_variation(first, last, parameter, volume.voxel_rows, kind, blocks, place, values[kind])

    steps = zip(ranges, itertools.pairwise(places))
    run_tasks([lambda a=a, b=b, start=start, stop=stop: add(a, b, start, stop) for (a, b), (start, stop) in steps])
    return [
        torch.sparse_coo_tensor(
            torch.from_numpy(touched)[None],
            torch.from_numpy(gradient),
            parameter.shape,
            is_coalesced=True,
            check_invariants=False,
        )
        if len(touched)
        else None
        for touched, gradient, parameter in zip(lists, values, parameters)
    ]


def _ordered(marched: Marched) -> Order:
    """The samples that have a gradient in the order of their voxels."""
    voxels, total = len(marched.volume.voxel_rows), int(marched.records.used.sum())
    shift = max(0, (voxels - 1).bit_length() - MOST_GROUPS.bit_length() + 1)
    groups = (voxels >> shift) + 1
    order = Order(shift, np.zeros(groups + 1, np.int64), BUFFERS.empty(total, np.int32), BUFFERS.empty(total, np.int32))
    kernels_rows.order_records(marched.records, order)
    return order


def _row_ranges(voxel_rows: np.ndarray, num_rows: int, order: Order, blocks: Blocks, channels: list[int]) -> list[int]:
    """Bounds of row ranges with about equally much work."""
    ranges = num_threads() * RANGES_PER_THREAD
    if num_threads() == 1 or len(voxel_rows) == 0:
        return [0, num_rows]
    starts = np.minimum(np.arange(len(order.group)) << order.shift, len(voxel_rows))
    work = order.group.astype(np.float64)
    for first, last, count in zip(blocks.first, blocks.last, channels):
        work += VARIATION_SHARE * count * (np.clip(starts, first, max(first, last)) - first)
    cuts = np.searchsorted(work, work[-1] * np.arange(1, ranges) / ranges)
    rows = [int(voxel_rows[start, 0]) for start in starts[cuts] if start < len(voxel_rows)]
    return sorted({0, *rows, num_rows})
