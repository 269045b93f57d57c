"""Backend fused: rendering by compiled kernels on the CPU; its gradients are row-sparse tensors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.threads import num_threads, run_ranges, run_tasks
from thermoxels_ns.field.interpolation import TrilinearPoints
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render import kernels, kernels_backward
from thermoxels_ns.render.kernels import Rays, Records, SampleGradients, Settings, Sums, Volume
from thermoxels_ns.render.kernels_backward import Blocks, Order, RayGradients, RowGradients
from thermoxels_ns.render.ray_render import GridSamples, RayRender, RayRequest, RenderOptions
from thermoxels_ns.render.reference import SMALLEST_VARIATION

ACTIVATIONS = {"relu": kernels.RELU, "exp": kernels.EXP}
VOXELS_AT_ONCE = 1 << 14  # Voxels whose total variation one task sums
FEWEST_SAMPLES = 24  # Mean number of samples per ray for which the first batch allocates memory
MOST_GROUPS = 1 << 12  # Most groups of voxels by which samples are sorted (one group more may occur)
RANGES_PER_THREAD = 4  # Ranges of rows per thread over which gradients are summed
VARIATION_SHARE = 0.02  # Work for the variation of one channel in one voxel, relative to the work for one sample
_room: dict[int, int] = {}
"""Mean number of samples per ray for which the last batch allocated memory, by the number of rows of its grid."""
NAMES = ("density", "sh", "temperature")


@dataclass(frozen=True)
class RecordedSamples:
    """The forward pass of a batch of rays: its inputs, the records of its samples, and the sums per ray."""

    rays: Rays
    volume: Volume
    settings: Settings
    records: Records
    sums: Sums
    spans: list[tuple[int, int]]  # For each range of rays, its first record and its last record plus 1


def samples(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> GridSamples:
    """Return the samples of rays in kept voxels with their weights; neither colour nor temperature is read. Raises
    `ThermoxelsError` if the density of a sample is NaN."""
    nothing = torch.zeros(len(request.origins), dtype=torch.bool)
    recorded = _recorded_samples(grid, None, replace(request, rgb_rays=nothing, thermal_rays=nothing), options)
    records = recorded.records
    number, fraction, weight, left = (
        torch.from_numpy(np.concatenate([values[:0], *(values[a:b] for a, b in recorded.spans)]))
        for values in (records.number, records.fraction, records.weight, records.transmittance)
    )
    ray = torch.repeat_interleave(torch.from_numpy(records.used))
    at = TrilinearPoints(grid.voxels, number.long(), fraction)
    return GridSamples(ray, at, weight, 1.0 - left - weight, torch.from_numpy(recorded.sums.transmittance))


def _recorded_samples(
    grid: VoxelGrid, sh: Tensor | None, request: RayRequest, options: RenderOptions
) -> RecordedSamples:
    """Return the forward pass of rays through a grid; `sh` is the grid's colour, or None to leave colour out."""
    density = grid.density.detach().numpy()
    voxels, dtype, lattice = grid.voxels, density.dtype, grid.lattice
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
    count = len(request.origins)
    wants = torch.zeros(count, dtype=torch.uint8)
    for bit, rays_that_want in ((1, request.rgb_rays), (2, request.thermal_rays)):
        wants += bit if rays_that_want is None else bit * rays_that_want.to(torch.uint8)
    near, far = request.near_and_far()
    rays = Rays(_array(request.origins), _array(request.directions), _array(near), _array(far), wants.numpy())
    settings = Settings(
        lattice.voxel_size / options.steps_per_voxel,
        options.smallest_weight,
        options.early_stop,
        options.distortion_scale or 0.0,
        int(options.thermal_moves_density),
    )
    sizes = [
        (count if volume.sh.shape[1] else 0, 3),
        (count, 1),
        *[count] * 3,
        count if options.distortion_scale else 0,
    ]
    sums = Sums(*[np.empty(size, dtype) for size in sizes])
    return RecordedSamples(rays, volume, settings, *_record(rays, volume, settings, sums))


def _record(rays: Rays, volume: Volume, settings: Settings, sums: Sums) -> tuple[Records, Sums, list[tuple[int, int]]]:
    """Return the records of the samples, `sums`, which is filled in place, and `RecordedSamples.spans`. While the
    memory for records does not suffice, the pass is repeated with twice as much. Raises `ThermoxelsError` if the
    density of a sample is NaN."""
    count, rows, dtype = len(rays.origins), len(volume.density), volume.density.dtype
    while True:
        room = _room.get(rows, FEWEST_SAMPLES)
        total = (room + kernels.AHEAD) * count
        coloured = total if volume.sh.shape[1] else 0
        shapes: list[Any] = [total, total, (total, 3), *[total] * 3, (coloured, 3), total]
        kinds: list[Any] = [np.int32] * 2 + [dtype] * 6
        fields: Iterator[Any] = (np.empty(shape, kind) for shape, kind in zip(shapes, kinds))
        records = Records(np.zeros(count, np.int64), np.zeros(count, np.int64), *fields)

        def work(first: int, last: int, room: int = room, records: Records = records) -> tuple[int, int, int]:
            begin, end = ((room + kernels.AHEAD) * ray for ray in (first, last))
            wrong, behind = kernels.march_rays(first, last, rays, volume, settings, records, sums, begin, end)
            if wrong == 0:
                kernels.shade(first, last, rays, volume, settings, records, sums)
            return begin, behind, wrong

        found: Any = run_ranges(work, count)
        wrong = [number for _, _, number in found]
        if min(wrong, default=0) >= 0:
            break
        _room.clear()
        _room[rows] = 2 * room
        del records, work  # free the memory that was too small before more is taken
    if sum(wrong):
        remedy = "Lower the density learning rate and resume from the last checkpoint."
        raise ThermoxelsError("density", expected="numbers >= 0", got=f"NaN in {sum(wrong)} places", remedy=remedy)
    return records, sums, [(begin, end) for begin, end, _ in found]


def render(grid: VoxelGrid, request: RayRequest, options: RenderOptions) -> RayRender:
    """Return what rays see of a grid on the CPU. The result can be differentiated once, with respect to the grid's
    parameters. Raises `ThermoxelsError` if the density of a sample is NaN."""
    out = _Render.apply(grid.density, grid.sh, grid.temperature, grid, request, options)
    assert isinstance(out, tuple)
    rgb, thermal, transmittance, accumulation, depth, distortion, *variation = out
    return RayRender(
        rgb if grid.sh is not None else None,
        thermal,
        transmittance,
        accumulation,
        depth,
        distortion if options.distortion_scale else None,
        dict(zip(options.variation, variation)),
    )


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, density, sh, temperature, grid: VoxelGrid, request: RayRequest, options: RenderOptions):
        # `density`, `sh` and `temperature` are the grid's parameters: autograd differentiates by arguments only.
        recorded = _recorded_samples(grid, grid.sh, request, options)
        variation = [
            _total_variation(_parameters(recorded.volume)[name], recorded.volume.voxel_rows, *block) / divisor + missing
            for name, block, divisor, missing in _blocks(options, recorded.volume)
        ]
        ctx.recorded, ctx.options = recorded, options
        ctx.set_materialize_grads(False)
        sums = [torch.from_numpy(values) for values in recorded.sums]
        return (*sums, *(torch.tensor(value, dtype=density.dtype) for value in variation))

    @staticmethod
    def backward(ctx, *grad_outputs: Any):
        if ctx.recorded is None:
            raise RuntimeError("a fused render can be differentiated once: its records hold the gradients afterwards")
        recorded, ctx.recorded = ctx.recorded, None
        rgb, thermal, transmittance, accumulation, depth, distortion, *pushes = grad_outputs
        sums, records = recorded.sums, recorded.records
        left = _gradient(transmittance, sums.transmittance)
        if accumulation is not None:
            left = left - _gradient(accumulation, sums.transmittance)
        grads = RayGradients(
            _gradient(rgb, sums.rgb),
            _gradient(thermal, sums.thermal),
            left,
            _gradient(depth, sums.depth) * (sums.accumulation > 0.0) / np.maximum(sums.accumulation, 1e-30),
            _gradient(distortion, sums.distortion),
        )
        of_samples = SampleGradients(
            *(records.offset, records.used, records.number, records.fraction),
            *(records.density, records.transmittance, records.rgb, np.empty(len(records.number), np.uint8)),
        )
        if any(gradient is not None for gradient in grad_outputs[:6]):
            inputs = recorded.rays, recorded.volume, recorded.settings, records, grads, sums.depth, of_samples
            run_ranges(lambda a, b: kernels_backward.find_sample_gradients(a, b, *inputs), len(records.used))
        else:
            records.used.fill(0)
        blocks = Blocks(np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3), SMALLEST_VARIATION)
        for (name, block, divisor, _), push in zip(_blocks(ctx.options, recorded.volume), pushes):
            if push is not None:
                kind = NAMES.index(name)
                blocks.first[kind], blocks.last[kind], blocks.push[kind] = *block, float(push) / divisor
        return (*row_gradients(recorded.rays, recorded.volume, of_samples, blocks), None, None, None)


def _parameters(volume: Volume) -> dict[str, np.ndarray]:
    return dict(zip(NAMES, (volume.density, volume.sh, volume.temperature)))


def _blocks(options: RenderOptions, volume: Volume) -> Iterator[tuple[str, tuple[int, int], int, float]]:
    """Yield name, (first, last), divisor and summand of each block of voxels whose mean total variation is wanted. The
    mean is the sum over the block / divisor + summand; the summand is the part of channels that are not stored."""
    for name, (first, last) in options.variation.items():
        columns = _parameters(volume)[name].shape[1]
        channels = columns if name != "sh" or options.colour_channels is None else options.colour_channels
        missing = (channels - columns) / channels * math.sqrt(SMALLEST_VARIATION)
        yield name, (first, last), channels * (last - first), missing


def _total_variation(values: np.ndarray, voxel_rows: np.ndarray, first: int, last: int) -> float:
    """Return `kernels_backward.total_variation`, summed in parallel; no bit depends on the number of threads."""
    bounds = [*range(first, last, VOXELS_AT_ONCE), last]
    parts: Any = run_tasks(
        [
            lambda a=a, b=b: kernels_backward.total_variation(values, voxel_rows, a, b, SMALLEST_VARIATION)
            for a, b in itertools.pairwise(bounds)
        ]
    )
    return sum(parts)


def _array(values: Tensor) -> np.ndarray:
    return values.detach().contiguous().numpy()


def _gradient(gradient: Tensor | None, like: np.ndarray) -> np.ndarray:
    return np.zeros_like(like) if gradient is None else _array(gradient.to(torch.from_numpy(like).dtype))


def row_gradients(rays: Rays, volume: Volume, of_samples: SampleGradients, blocks: Blocks) -> list[Tensor | None]:
    """Return the gradients with respect to density, colour and temperature as three row-sparse tensors. They are the
    sums of the gradients of samples and of total variation; None in place of a tensor without rows."""
    parameters, num_rows = list(_parameters(volume).values()), len(volume.density)
    order = _ordered(of_samples, len(volume.voxel_rows))
    bounds = _row_ranges(volume.voxel_rows, num_rows, order, blocks, [p.shape[1] for p in parameters])
    ranges, uses = list(itertools.pairwise(bounds)), np.empty(num_rows, np.uint8)
    run_tasks(
        [lambda a=a, b=b: kernels_backward.use_rows(a, b, volume, of_samples, order, blocks, uses) for a, b in ranges]
    )
    counts = [[np.count_nonzero(uses[a:b] & (1 << kind)) for kind in range(3)] for a, b in ranges]
    places = np.concatenate((np.zeros((1, 3), np.int64), np.cumsum(counts, axis=0)))
    lists = [np.empty(total, np.int64) for total in places[-1]]
    values = [np.empty((total, p.shape[1]), p.dtype) for total, p in zip(places[-1], parameters)]
    rows = RowGradients(uses, np.empty((num_rows, 3), np.int32), *values)

    def add(first: int, last: int, start: list[int]) -> None:
        for kind in range(3):
            kernels_backward.list_rows(first, last, kind, start[kind], rows, lists[kind], values[kind])
        kernels_backward.add_samples(first, last, rays, volume, of_samples, order, rows)
        for kind, parameter in enumerate(parameters):
            if blocks.last[kind] > blocks.first[kind]:
                inputs = parameter, volume.voxel_rows, kind, blocks, rows.place, values[kind]
                kernels_backward.add_variation(first, last, *inputs)

    run_tasks([lambda a=a, b=b, at=at: add(a, b, at) for (a, b), at in zip(ranges, places.tolist())])
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
    """Return the samples with a gradient, sorted by groups of voxels; `voxels` is the number of kept voxels."""
    total = int(samples.used.sum())
    shift = max(0, (voxels - 1).bit_length() - MOST_GROUPS.bit_length() + 1)
    groups = (voxels >> shift) + 1
    order = Order(shift, np.zeros(groups + 1, np.int64), np.empty(total, np.int32), np.empty(total, np.int32))
    kernels_backward.order_samples(samples, order)
    return order


def _row_ranges(voxel_rows: np.ndarray, num_rows: int, order: Order, blocks: Blocks, channels: list[int]) -> list[int]:
    """Return the bounds, ascending from 0 to `num_rows`, of ranges of rows with about equal work for gradients.
    `channels` are the numbers of columns of density, colour and temperature."""
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
