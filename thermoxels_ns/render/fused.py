"""Rendering by compiled kernels on the CPU, with row-sparse gradients."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from thermoxels_ns.core.buffer_pool import BUFFERS
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.threads import run_ranges, run_tasks
from thermoxels_ns.field.kept_voxels import KeptVoxels
from thermoxels_ns.render import kernels, kernels_backward, kernels_rows, kernels_shading
from thermoxels_ns.render.kernels import Marched, Rays, Records, Settings, Sums, Volume
from thermoxels_ns.render.kernels_backward import RayGradients
from thermoxels_ns.render.kernels_rows import Blocks
from thermoxels_ns.render.ray_render import RayRender, RayRequest, RenderOptions, near_and_far
from thermoxels_ns.render.row_gradients import row_gradients

ACTIVATIONS = {"relu": kernels.RELU, "softplus": kernels.SOFTPLUS, "exp": kernels.EXP}
SMALLEST_VARIATION = 1e-10
"""Added under the root of the total variation; the reference's value."""
MOST_HARMONICS = 9
VOXELS_AT_ONCE = 1 << 14
"""Voxels whose total variation is one task."""
FEWEST_SAMPLES = 24
"""Samples per ray that a batch has room for at first, on average over a range."""
SPARE = 1.25
"""Room made when that was too little, over what the rays so far took."""
_room: dict[int, int] = {}
"""Samples per ray that batches of the last lattice had room for, by its number of rows."""
NAMES = ("density", "sh", "temperature")


def march(
    voxels: KeptVoxels,
    density: Tensor,
    sh: Tensor | None,
    temperature: Tensor,
    activation: str,
    request: RayRequest,
    options: RenderOptions,
) -> Marched:
    """March rays and record their samples without gaps, for statistics; no gradients.

    Returns:
        The samples; ``records.offset`` has a last entry, the number of all records.

    Raises:
        ThermoxelsError: A density on the way is NaN.
    """
    marched, spans = _march(voxels, density, sh, temperature, activation, request, options)
    records = marched.records
    listed = [np.concatenate([field[:0], *(field[a:b] for a, b in spans)]) for field in records[2:]]
    offset = np.concatenate((np.zeros(1, np.int64), np.cumsum(records.used)))
    return replace(marched, records=Records(offset, records.used, *listed))


def _march(
    voxels: KeptVoxels,
    density: Tensor,
    sh: Tensor | None,
    temperature: Tensor,
    activation: str,
    request: RayRequest,
    options: RenderOptions,
) -> tuple[Marched, list[tuple[int, int]]]:
    """March rays and record their samples; give also the spans of the records in which there are no gaps."""
    dtype = density.detach().numpy().dtype
    lattice = voxels.lattice
    volume = Volume(
        np.asarray(lattice.lo),
        np.asarray(lattice.hi),
        lattice.voxel_size,
        np.asarray(lattice.cell_shape, dtype=np.int64),
        voxels.block_slot,
        voxels.voxel_number,
        voxels.voxel_rows,
        density.detach().numpy(),
        np.zeros((0, 0), dtype) if sh is None else sh.detach().numpy(),
        temperature.detach().numpy(),
        ACTIVATIONS[activation],
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
    return Marched(rays, volume, settings, records, sums), spans


def _record(rays: Rays, volume: Volume, settings: Settings, sums: Sums) -> tuple[Records, list[tuple[int, int]]]:
    """Fill `sums` and record the samples; every range of rays has room for as many per ray as were ever needed."""
    count = len(rays.origins)
    rows = len(volume.density)
    while True:
        # Of another lattice nothing is known.
        room = _room.get(rows, FEWEST_SAMPLES)
        records = _empty_records(count, (room + kernels.AHEAD) * count, volume)

        def work(first: int, last: int, room: int = room, records: Records = records) -> tuple[int, int, int]:
            begin, end = ((room + kernels.AHEAD) * ray for ray in (first, last))
            wrong, behind = kernels.march_forward(first, last, rays, volume, settings, records, sums, begin, end)
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
        raise ThermoxelsError(
            "density",
            expected="numbers >= 0",
            got=f"NaN in {sum(wrong)} places",
            remedy="Lower the density learning rate and resume from the last checkpoint.",
        )
    return records, [(begin, end) for begin, _, end in found]


def _empty_records(rays: int, total: int, volume: Volume) -> Records:
    dtype = volume.density.dtype
    return Records(
        np.zeros(rays, dtype=np.int64),
        np.zeros(rays, dtype=np.int64),
        BUFFERS.empty(total, np.int32),
        BUFFERS.empty(total, np.int32),
        BUFFERS.empty((total, 3), dtype),
        BUFFERS.empty(total, dtype),
        BUFFERS.empty(total, dtype),
        BUFFERS.empty(total, dtype),
        BUFFERS.empty((total if volume.sh.shape[1] else 0, 3), dtype),
        BUFFERS.empty(total, dtype),
        BUFFERS.empty(total, np.uint8),
    )


def render(
    voxels: KeptVoxels,
    density: Tensor,
    sh: Tensor | None,
    temperature: Tensor,
    activation: str,
    request: RayRequest,
    options: RenderOptions,
) -> RayRender:
    """Render rays; differentiable once with respect to the three parameters.

    Args:
        voxels: The kept voxels.
        density: Raw density, (rows, 1), float32 or float64, on the CPU.
        sh: Colour harmonics, (rows, 3 k); None: no colour.
        temperature: Temperature harmonics, (rows, k).
        activation: relu, softplus or exp.
        request: Rays and what they want.
        options: What to compute and how exactly.

    Returns:
        Sums per ray and the variations asked for.

    Raises:
        ThermoxelsError: A density on the way is NaN.
    """
    context = _Context(voxels, activation, request, options)
    out = _Render.apply(density, sh, temperature, context)
    assert isinstance(out, tuple)
    rgb, thermal, transmittance, accumulation, depth, distortion, sparsity, *variation = out
    return RayRender(
        rgb if sh is not None else None,
        thermal,
        transmittance,
        accumulation,
        depth,
        distortion if options.distortion_scale else None,
        sparsity if options.sparsity else None,
        dict(zip(options.variation, variation)),
    )


@dataclass
class _Context:
    voxels: KeptVoxels
    activation: str
    request: RayRequest
    options: RenderOptions


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, density: Tensor, sh: Tensor | None, temperature: Tensor, context: _Context):
        options, voxels = context.options, context.voxels
        marched, _ = _march(voxels, density, sh, temperature, context.activation, context.request, options)
        parameters = {"density": density, "sh": sh, "temperature": temperature}

        found = [
            _total_variation(values.detach().numpy(), voxels.voxel_rows, first, last, _channels(options, name, values))
            for name, (first, last) in options.variation.items()
            if (values := parameters[name]) is not None
        ]
        ctx.marched, ctx.options = marched, options
        ctx.set_materialize_grads(False)
        sums = [torch.from_numpy(values) for values in marched.sums]
        ctx.mark_non_differentiable(sums[4])
        return (*sums, *(torch.tensor(value, dtype=density.dtype) for value in found))

    @staticmethod
    def backward(ctx, *grad_outputs: Any):
        if ctx.marched is None:
            raise RuntimeError("a fused render can be differentiated once: its records hold the gradients afterwards")
        marched, options = ctx.marched, ctx.options
        ctx.marched = None
        rgb, thermal, transmittance, accumulation, _, distortion, sparsity, *variation = grad_outputs
        sums, records, volume = marched.sums, marched.records, marched.volume
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
        if any(gradient is not None for gradient in grad_outputs[:7]):
            run_ranges(
                lambda a, b: kernels_backward.march_backward(
                    a, b, marched.rays, volume, marched.settings, records, grads
                ),
                len(records.used),
            )
        else:
            records.used.fill(0)
        return (*row_gradients(marched, _blocks(options, variation, volume)), None)


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
