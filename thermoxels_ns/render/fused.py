"""Rendering by compiled kernels on the CPU, with row-sparse gradients."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from thermoxels_ns.core.arrays import BUFFERS
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.threads import num_threads, run_ranges, run_tasks
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render import kernels, kernels_backward, kernels_rows, kernels_shading
from thermoxels_ns.render.kernels import Rays, RecordedSamples, Records, SampleGradients, Settings, Sums, Volume
from thermoxels_ns.render.kernels_backward import RayGradients
from thermoxels_ns.render.kernels_rows import Blocks, Order, RowGradients
from thermoxels_ns.render.ray_render import RayRender, RayRequest, RenderOptions, near_and_far

ACTIVATIONS = {"relu": kernels.RELU, "softplus": kernels.SOFTPLUS, "exp": kernels.EXP}
SMALLEST_VARIATION = 1e-10  # Added under the root of the total variation; the reference's value
MOST_HARMONICS = 9
VOXELS_AT_ONCE = 1 << 14  # Voxels whose total variation is one task
FEWEST_SAMPLES = 24  # Samples per ray, averaged over a range of rays, that the first batch on a lattice has memory for
SPARE = 1.25
"""A batch with too little memory is marched again with this many times the samples per ray counted until it ran out."""
MOST_GROUPS = 1 << 12  # Groups of voxels that samples are put in order by
RANGES_PER_THREAD = 4
VARIATION_SHARE = 0.02  # Work of one channel's variation in a voxel, in samples
_room: dict[int, int] = {}
"""Samples per ray that batches on the last lattice had memory for; the key is the number of rows."""
NAMES = ("density", "sh", "temperature")


def samples_without_gaps(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> RecordedSamples:
    """March rays and record their samples without gaps and without colour, for statistics; no gradients.

    Raises:
        ThermoxelsError: A density on the way is NaN.
    """
    recorded, spans = _recorded_samples(grid, None, request, options)
    records = recorded.records
    listed = [np.concatenate([field[:0], *(field[a:b] for a, b in spans)]) for field in records[2:]]
    return replace(recorded, records=Records(np.cumsum(records.used) - records.used, records.used, *listed))


def _recorded_samples(
    grid: VoxelGrid, sh: Tensor | None, request: RayRequest, options: RenderOptions
) -> tuple[RecordedSamples, list[tuple[int, int]]]:
    """March rays and record their samples; also give the first and one behind the last record of each range of rays."""
    density = grid.density.detach().numpy()
    voxels, dtype = grid.voxels, density.dtype
    lattice = voxels.lattice
    volume = Volume(
        np.asarray(lattice.lo),
        np.asarray(lattice.hi),
        lattice.voxel_size,
        np.asarray(lattice.cell_shape, dtype=np.int64),
        voxels.block_slot,
        voxels.voxel_number,
        voxels.voxel_rows,
        density,
        np.zeros((0, 0), dtype) if sh is None else sh.detach().numpy(),
        grid.temperature.detach().numpy(),
        ACTIVATIONS[grid.activation],
    )
    near, far = near_and_far(request)
    count = len(request.origins)
    wants = torch.full((count,), 3, dtype=torch.uint8)
    if request.rgb_rays is not None:
        wants &= 2 + request.rgb_rays.to(torch.uint8)
    if request.thermal_rays is not None:
        wants &= 1 + 2 * request.thermal_rays.to(torch.uint8)
    rays = Rays(_array(request.origins), _array(request.directions), _array(near), _array(far), wants.numpy())
    settings = Settings(
        lattice.voxel_size / options.steps_per_voxel,
        options.smallest_weight,
        options.early_stop,
        options.distortion_scale or 0.0,
        int(options.sparsity),
        int(options.thermal_moves_density),
        MOST_HARMONICS if options.sh_degree is None else (options.sh_degree + 1) ** 2,
    )
    sums = Sums(
        np.empty((count if volume.sh.shape[1] else 0, 3), dtype=dtype),
        np.empty((count, 1), dtype=dtype),
        np.empty(count, dtype=dtype),
        np.empty(count, dtype=dtype),
        np.empty(count, dtype=dtype),
        np.empty(count if options.distortion_scale else 0, dtype=dtype),
        np.empty(count if options.sparsity else 0, dtype=dtype),
    )
    records, spans = _record(rays, volume, settings, sums)
    return RecordedSamples(rays, volume, settings, records, sums), spans


def _record(rays: Rays, volume: Volume, settings: Settings, sums: Sums) -> tuple[Records, list[tuple[int, int]]]:
    """Fill `sums` and record the samples; where these are more than there is memory for, with more of it again."""
    count = len(rays.origins)
    rows = len(volume.density)
    while True:
        room = _room.get(rows, FEWEST_SAMPLES)
        total, dtype = (room + kernels.AHEAD) * count, volume.density.dtype
        coloured = total if volume.sh.shape[1] else 0
        shapes: list[Any] = [total, total, (total, 3), *[total] * 3, (coloured, 3), total]
        kinds = [np.int32] * 2 + [dtype] * 6
        fields = (BUFFERS.empty(shape, kind) for shape, kind in zip(shapes, kinds))
        records = Records(np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64), *fields)

        def work(first: int, last: int, room: int = room, records: Records = records) -> tuple[int, int, int]:
            begin, end = ((room + kernels.AHEAD) * ray for ray in (first, last))
            wrong, behind = kernels.march_rays(first, last, rays, volume, settings, records, sums, begin, end)
            if wrong == 0:
                kernels_shading.shade(first, last, rays, volume, settings, records, sums)
            return begin, wrong, behind

        found: Any = run_ranges(work, count)
        wrong = [number for _, number, _ in found]
        if min(wrong, default=0) >= 0:
            break
        short = [per_ray for _, number, per_ray in found if number < 0]
        _room.clear()
        _room[rows] = max(room + 1, int(SPARE * max(short)))
        del records, work  # what was too small is given back before more is taken
        BUFFERS.release()
    if sum(wrong):
        remedy = "Lower the density learning rate and resume from the last checkpoint."
        raise ThermoxelsError("density", expected="numbers >= 0", got=f"NaN in {sum(wrong)} places", remedy=remedy)
    return records, [(begin, end) for begin, _, end in found]


def render(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> RayRender:
    """Render rays through a grid on the CPU; differentiable once with respect to its parameters.

    Raises:
        ThermoxelsError: A density on the way is NaN.
    """
    out = _Render.apply(grid.density, grid.sh, grid.temperature, grid, request, options)
    assert isinstance(out, tuple)
    rgb, thermal, transmittance, accumulation, depth, distortion, sparsity, *variation = out
    return RayRender(
        rgb if grid.sh is not None else None,
        thermal,
        transmittance,
        accumulation,
        depth,
        distortion if options.distortion_scale else None,
        sparsity if options.sparsity else None,
        dict(zip(options.variation, variation)),
    )


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, density, sh, temperature, grid: VoxelGrid, request: RayRequest, options: RenderOptions):
        # `density`, `sh` and `temperature` are the grid's: autograd differentiates only by what it is handed.
        recorded, _ = _recorded_samples(grid, grid.sh, request, options)
        parameters, rows = grid.row_parameters(), grid.voxels.voxel_rows
        found = [
            _total_variation(values.detach().numpy(), rows, first, last, _channels(options, name, values))
            for name, (first, last) in options.variation.items()
            if (values := parameters.get(name)) is not None
        ]
        ctx.recorded, ctx.options = recorded, options
        ctx.set_materialize_grads(False)
        sums = [torch.from_numpy(values) for values in recorded.sums]
        ctx.mark_non_differentiable(sums[4])
        return (*sums, *(torch.tensor(value, dtype=density.dtype) for value in found))

    @staticmethod
    def backward(ctx, *grad_outputs: Any):
        if ctx.recorded is None:
            raise RuntimeError("a fused render can be differentiated once: its records hold the gradients afterwards")
        recorded, options = ctx.recorded, ctx.options
        ctx.recorded = None
        rgb, thermal, transmittance, accumulation, _, distortion, sparsity, *variation = grad_outputs
        sums, records, volume = recorded.sums, recorded.records, recorded.volume
        left = _gradient(transmittance, sums.transmittance)
        if accumulation is not None:
            left = left - _gradient(accumulation, sums.transmittance)
        grads = RayGradients(
            _gradient(rgb, sums.rgb),
            _gradient(thermal, sums.thermal),
            left,
            _gradient(distortion, sums.distortion),
            _gradient(sparsity, sums.sparsity),
        )
        samples = SampleGradients(
            *(records.offset, records.used, records.number, records.fraction),
            *(records.density, records.transmittance, records.rgb, BUFFERS.empty(len(records.number), np.uint8)),
        )
        if any(gradient is not None for gradient in grad_outputs[:7]):
            inputs = recorded.rays, volume, recorded.settings, records, grads, samples
            run_ranges(lambda a, b: kernels_backward.find_sample_gradients(a, b, *inputs), len(records.used))
        else:
            records.used.fill(0)
        return (*row_gradients(recorded, samples, _blocks(options, variation, volume)), None, None, None)


def _channels(options: RenderOptions, name: str, values: Tensor | np.ndarray) -> int:
    """Channels of which the total variation of a parameter is the mean."""
    asked = options.colour_channels if name == "sh" else None
    return values.shape[1] if asked is None else asked


def _total_variation(values: np.ndarray, voxel_rows: np.ndarray, first: int, last: int, channels: int) -> float:
    """Mean of the total variation over a block; its parts do not depend on the number of threads."""
    bounds = [*range(first, last, VOXELS_AT_ONCE), last]
    parts: Any = run_tasks(
        [
            lambda a=a, b=b: kernels_rows.total_variation(values, voxel_rows, a, b, SMALLEST_VARIATION)
            for a, b in itertools.pairwise(bounds)
        ]
    )
    missing = (channels - values.shape[1]) * math.sqrt(SMALLEST_VARIATION)
    return sum(parts) / (channels * (last - first)) + missing / channels


def _blocks(options: RenderOptions, pushes: Sequence[Tensor | None], volume: Volume) -> Blocks:
    """The total variation that has a gradient."""
    parameters = (volume.density, volume.sh, volume.temperature)
    channels = [_channels(options, name, values) for name, values in zip(NAMES, parameters)]
    blocks = Blocks(
        np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3), np.array(channels, np.int64), SMALLEST_VARIATION
    )
    for (name, (first, last)), push in zip(options.variation.items(), pushes):
        if push is not None:
            kind = NAMES.index(name)
            blocks.first[kind], blocks.last[kind], blocks.push[kind] = first, last, float(push)
    return blocks


def _array(values: Tensor) -> np.ndarray:
    return values.detach().contiguous().numpy()


def _gradient(gradient: Tensor | None, like: np.ndarray) -> np.ndarray:
    return np.zeros_like(like) if gradient is None else _array(gradient.to(torch.from_numpy(like).dtype))


def row_gradients(recorded: RecordedSamples, samples: SampleGradients, blocks: Blocks) -> list[Tensor | None]:
    """Gradients of density, colour and temperature as row-sparse tensors; None for one that no row has.

    Args:
        recorded: Rays, volume and settings.
        samples: Gradients of the samples.
        blocks: Total variation to add.
    """
    volume = recorded.volume
    parameters = (volume.density, volume.sh, volume.temperature)
    order = _ordered(samples, len(volume.voxel_rows))
    bounds = _row_ranges(volume.voxel_rows, len(volume.density), order, blocks, [p.shape[1] for p in parameters])
    ranges = list(itertools.pairwise(bounds))
    uses = BUFFERS.empty(len(volume.density), np.uint8)
    counts: Any = run_tasks(
        [lambda a=a, b=b: kernels_rows.use_rows(a, b, volume, samples, order, blocks, uses) for a, b in ranges]
    )
    places = np.concatenate((np.zeros((1, 3), np.int64), np.cumsum(np.asarray(counts).reshape(-1, 3), axis=0)))
    lists = [BUFFERS.empty(int(total), np.int64) for total in places[-1]]
    values = [
        BUFFERS.empty((int(total), parameter.shape[1]), parameter.dtype)
        for total, parameter in zip(places[-1], parameters)
    ]
    place = BUFFERS.empty((len(uses), 3), np.int32)
    active = min(3 * recorded.settings.sh_active, volume.sh.shape[1])
    narrow = active < volume.sh.shape[1]
    sums = BUFFERS.empty((len(values[1]), active), volume.sh.dtype) if narrow else values[1]
    rows = RowGradients(uses, place, lists[0], values[0], lists[1], values[1], sums, lists[2], values[2])

    def add(first: int, last: int, start: np.ndarray, stop: np.ndarray) -> None:
        kernels_rows.list_rows(first, last, int(start[0]), int(start[1]), int(start[2]), rows)
        kernels_rows.add_samples(first, last, recorded.rays, volume, recorded.settings, samples, order, rows)
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


def _ordered(samples: SampleGradients, voxels: int) -> Order:
    """The samples that have a gradient in the order of their voxels."""
    total = int(samples.used.sum())
    shift = max(0, (voxels - 1).bit_length() - MOST_GROUPS.bit_length() + 1)
    groups = (voxels >> shift) + 1
    order = Order(shift, np.zeros(groups + 1, np.int64), BUFFERS.empty(total, np.int32), BUFFERS.empty(total, np.int32))
    kernels_rows.order_samples(samples, order)
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
