"""Fused rendering on a CPU: one march per ray instead of tables of samples; the twin of the torch reference.

Early stop and skipped colours have a stated bound (`RenderOptions`); everything else is the reference's sum. Gradients
come as row-sparse tensors that hold the touched rows only.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from thermoxels_ns.errors import ThermoxelsError, explain
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.render import kernels, kernels_backward
from thermoxels_ns.render.kernel_cache import forget_stale_kernels
from thermoxels_ns.render.kernels import Rays, Records, Settings, Sums, Volume
from thermoxels_ns.render.kernels_backward import RayGradients, RowGradients
from thermoxels_ns.render.ray_render import RayRender, RayRequest, RenderOptions, near_and_far
from thermoxels_ns.threads import num_threads, run_ranges, run_tasks

# Before the first call, which loads what was compiled earlier.
forget_stale_kernels(
    Path(str(kernels.march_forward.stats.cache_path)),
    (Path(str(module.__file__)) for module in (kernels, kernels_backward)),
)

ACTIVATIONS = {"relu": kernels.RELU, "softplus": kernels.SOFTPLUS, "exp": kernels.EXP}
SMALLEST_VARIATION = 1e-10
"""Added under the root of the total variation; the reference's value."""
MOST_HARMONICS = 9
NAMES = ("density", "sh", "temperature")


@dataclass(frozen=True)
class VoxelArrays:
    """Kept voxels as plain arrays; the rule of each is that of `field.kept_voxels.KeptVoxels`."""

    lattice: Lattice
    voxel_rows: np.ndarray
    block_slot: np.ndarray
    voxel_number: np.ndarray


@dataclass(frozen=True)
class Marched:
    """Samples of a batch of rays, for statistics: `records` and how to read them."""

    rays: Rays
    volume: Volume
    settings: Settings
    records: Records
    sums: Sums


def march(
    voxels: VoxelArrays,
    density: Tensor,
    sh: Tensor | None,
    temperature: Tensor,
    activation: str,
    request: RayRequest,
    options: RenderOptions,
) -> Marched:
    """March rays and record their samples; no gradients.

    Raises:
        ThermoxelsError: A density on the way is NaN.
    """
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
    offset = np.zeros(count + 1, dtype=np.int64)
    run_ranges(lambda a, b: kernels.count_samples(a, b, rays, volume, settings, offset[1:]), count)
    np.cumsum(offset, out=offset)
    total = int(offset[-1])
    channels = volume.sh.shape[1]
    records = Records(
        offset,
        np.zeros(count, dtype=np.int64),
        np.empty(total, dtype=np.int32),
        np.empty(total, dtype=np.int32),
        np.empty((total, 3), dtype=dtype),
        np.empty(total, dtype=dtype),
        np.empty(total, dtype=dtype),
        np.empty(total, dtype=dtype),
        np.empty((total if channels else 0, 3), dtype=dtype),
    )
    sums = Sums(
        np.empty((count if channels else 0, 3), dtype=dtype),
        np.empty((count, 1), dtype=dtype),
        np.empty(count, dtype=dtype),
        np.empty(count, dtype=dtype),
        np.empty(count, dtype=dtype),
        np.empty(count if options.distortion_scale else 0, dtype=dtype),
        np.empty(count if options.sparsity else 0, dtype=dtype),
    )
    wrong: Any = run_ranges(lambda a, b: kernels.march_forward(a, b, rays, volume, settings, records, sums), count)
    if sum(wrong):
        raise ThermoxelsError(
            explain(
                "density",
                expected="numbers >= 0",
                got=f"NaN on {sum(wrong)} rays",
                remedy="Lower the density learning rate and resume from the last checkpoint.",
            )
        )
    return Marched(rays, volume, settings, records, sums)


def render(
    voxels: VoxelArrays,
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
    voxels: VoxelArrays
    activation: str
    request: RayRequest
    options: RenderOptions


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, density: Tensor, sh: Tensor | None, temperature: Tensor, context: _Context):
        options, voxels = context.options, context.voxels
        marched = march(voxels, density, sh, temperature, context.activation, context.request, options)
        parameters = {"density": density, "sh": sh, "temperature": temperature}

        def variation(name: str):
            first, last = options.variation[name]
            rows = voxels.voxel_rows
            values = parameters[name].detach().numpy()  # type: ignore[union-attr]
            low, high = int(rows[first, 0]), int(rows[last - 1, 3]) + 2
            gradient = np.zeros((high - low, values.shape[1]), values.dtype)
            value = kernels_backward.block_variation(values, rows, first, last, SMALLEST_VARIATION, low, gradient)
            return value, low, gradient

        found: Any = run_tasks([lambda name=name: variation(name) for name in options.variation])
        ctx.blocks = {name: block[1:] for name, block in zip(options.variation, found)}
        ctx.marched, ctx.options = marched, options
        ctx.set_materialize_grads(False)
        sums = [torch.from_numpy(values) for values in marched.sums]
        ctx.mark_non_differentiable(sums[4])
        return (*sums, *(torch.tensor(block[0], dtype=density.dtype) for block in found))

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
        rays_moved = any(g is not None for g in grad_outputs[:7])
        grads = RayGradients(
            _gradient(rgb, sums.rgb),
            _gradient(thermal, sums.thermal),
            left,
            _gradient(distortion, sums.distortion),
            _gradient(sparsity, sums.sparsity),
        )
        count = len(records.used)
        used = [np.zeros(len(volume.voxel_rows), dtype=np.uint8) for _ in NAMES]
        if rays_moved:
            run_ranges(
                lambda a, b: kernels_backward.march_backward(
                    a, b, marched.rays, volume, marched.settings, records, grads
                ),
                count,
            )
            run_ranges(
                lambda a, b: kernels_backward.mark_rows(a, b, marched.rays, volume, marched.settings, records, *used),
                count,
            )
        return (*_row_gradients(marched, used, rays_moved, options, ctx.blocks, variation), None)


def _row_gradients(marched: Marched, used, rays_moved: bool, options: RenderOptions, blocks, variation):
    """Sum the samples' gradients and those of the variations into row-sparse tensors."""
    volume, records = marched.volume, marched.records
    num_rows = len(volume.density)
    parameters = {"density": volume.density, "sh": volume.sh, "temperature": volume.temperature}
    pushes = {name: g for name, g in zip(options.variation, variation) if g is not None}
    places = [np.full(num_rows if parameters[name].shape[1] else 0, -1, dtype=np.int32) for name in NAMES]

    def place(index: int) -> np.ndarray:
        """Number the rows of a parameter that get a gradient and list them."""
        name = NAMES[index]
        first, last = options.variation[name] if name in pushes else (0, 0)
        if not parameters[name].shape[1]:
            return np.zeros(0, dtype=np.int64)
        total = kernels_backward.place_rows(used[index], volume.voxel_rows, first, last, places[index])
        return kernels_backward.list_rows(places[index], total)

    touched: Any = run_tasks([lambda index=index: place(index) for index in range(3)])
    values = [
        np.zeros((len(found), parameters[name].shape[1]), parameters[name].dtype) for name, found in zip(NAMES, touched)
    ]
    rows = RowGradients(places[0], values[0], places[1], values[1], places[2], values[2])
    if rays_moved:
        bounds = _row_ranges(touched[0], num_rows, num_threads())
        run_tasks(
            [
                lambda low=low, high=high: kernels_backward.add_rows(
                    low, high, marched.rays, volume, marched.settings, records, rows
                )
                for low, high in itertools.pairwise(bounds)
                if high > low
            ]
        )
    gradients = []
    for index, name in enumerate(NAMES):
        if name in pushes:
            low, block = blocks[name]
            at = places[index][low : low + len(block)]
            inside = np.flatnonzero(at >= 0)
            values[index][at[inside]] += block[inside] * values[index].dtype.type(float(pushes[name]))
        if len(touched[index]) == 0:
            gradients.append(None)
            continue
        gradients.append(
            torch.sparse_coo_tensor(
                torch.from_numpy(touched[index])[None],
                torch.from_numpy(values[index]),
                parameters[name].shape,
                is_coalesced=True,
                check_invariants=False,
            )
        )
    return gradients


def _row_ranges(touched: np.ndarray, num_rows: int, threads: int) -> list[int]:
    """Bounds of row ranges with about equally many touched rows."""
    if threads == 1 or len(touched) == 0:
        return [0, num_rows]
    cuts = touched[(np.arange(1, threads) * len(touched)) // threads]
    return [0, *(int(cut) for cut in cuts), num_rows]


def _array(values: Tensor) -> np.ndarray:
    return values.detach().contiguous().numpy()


def _gradient(gradient: Tensor | None, like: np.ndarray) -> np.ndarray:
    return np.zeros_like(like) if gradient is None else _array(gradient.to(torch.from_numpy(like).dtype))
