"""Random grids and rays, and what both renderers make of them: values and gradients of everything they give."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.kept_voxels import KeptVoxels
from thermoxels_ns.field.voxel_grid import DensityActivation, VoxelGrid
from thermoxels_ns.render import fused, reference
from thermoxels_ns.render.ray_render import RayRender, RayRequest, RenderOptions

Renderer = Callable[[VoxelGrid, RayRequest, RenderOptions], RayRender]
RENDERERS: dict[str, Renderer] = {"reference": reference.render, "fused": fused.render}
PER_RAY = ("rgb", "thermal", "transmittance", "accumulation", "depth", "distortion")
EVERYTHING = RenderOptions(distortion_scale=2.0)


def keep_only(grid: VoxelGrid, cells: np.ndarray) -> VoxelGrid:
    """Exchange the storage of a grid for that of some voxels, all values 0."""
    voxels = KeptVoxels(grid.lattice, np.asarray(cells, dtype=np.int64))
    rows = {k: torch.zeros(voxels.num_rows, p.shape[1]) for k, p in grid.row_parameters().items()}
    grid.replace_voxels(voxels, rows)
    return grid


def random_grid(
    sh_degree: int | None = 2,
    temperature_degree: int = 0,
    activation: DensityActivation = "exp",
    kept: float | np.ndarray = 1.0,
    lattice: Lattice | None = None,
    seed: int = 0,
    density: float = 1.0,
) -> VoxelGrid:
    """A grid in single precision with random values in every row; `kept` is a share or the flat indices of voxels."""
    lattice = lattice or Lattice.covering((-1, -1, -0.8), (1, 1, 0.8), 12)
    grid = VoxelGrid(lattice, sh_degree, temperature_degree, 1.0, activation)
    random = np.random.default_rng(seed)
    if isinstance(kept, np.ndarray) or kept < 1.0:
        total = int(np.prod(lattice.cell_shape))
        keep_only(grid, kept if isinstance(kept, np.ndarray) else np.flatnonzero(random.random(total) < kept))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        grid.density.copy_(2.0 * torch.randn(grid.density.shape, generator=generator) + density)
        if grid.sh is not None:
            grid.sh.copy_(torch.randn(grid.sh.shape, generator=generator))
        grid.temperature.copy_(torch.rand(grid.temperature.shape, generator=generator))
    return grid


def as_double(grid: VoxelGrid) -> VoxelGrid:
    twin = VoxelGrid(grid.lattice, grid.sh_degree, grid.temperature_degree, 1.0, grid.activation)
    twin.replace_voxels(grid.voxels, {k: p.detach() for k, p in grid.row_parameters().items()})
    return twin.double()


def random_request(grid: VoxelGrid, rays: int = 150, seed: int = 0, mixed: bool = True) -> RayRequest:
    """Rays from outside towards the middle of the box, some from inside, some that miss it."""
    generator = torch.Generator().manual_seed(seed + 1)
    lo, hi = torch.tensor(grid.lattice.lo), torch.tensor(grid.lattice.hi)
    half = float((hi - lo).norm()) / 2.0
    origins = normalize(torch.randn(rays, 3, generator=generator), dim=-1) * 1.5 * half
    origins[: rays // 8] *= 0.2
    directions = torch.randn(rays, 3, generator=generator) * 0.3 * half - origins
    directions[: rays // 8] = torch.randn(rays // 8, 3, generator=generator)
    directions[rays // 8 : rays // 6] *= -1.0
    wants = torch.rand(2, rays, generator=generator) < 0.6
    origins, directions = (0.5 * (lo + hi) + origins).float(), normalize(directions, dim=-1).float()
    return RayRequest(origins, directions, 0.05 * half, None, *(wants if mixed else (None, None)))


def in_double(request: RayRequest) -> RayRequest:
    near = request.near.double() if isinstance(request.near, Tensor) else request.near
    far = None if request.far is None else request.far.double()
    return RayRequest(
        request.origins.double(), request.directions.double(), near, far, request.rgb_rays, request.thermal_rays
    )


@dataclass(frozen=True)
class Seen:
    """Everything one renderer gives, in double precision."""

    values: dict[str, Tensor]
    gradients: dict[str, Tensor]


def see(renderer: str, grid: VoxelGrid, request: RayRequest, options: RenderOptions = EVERYTHING) -> Seen:
    """Render, and differentiate a random combination of everything that has a gradient."""
    generator = torch.Generator().manual_seed(7)
    dtype = grid.density.dtype
    for parameter in grid.parameters():
        parameter.grad = None
    render = RENDERERS[renderer](grid, request, options)
    values = {name: getattr(render, name) for name in PER_RAY}
    values |= {f"variation of {name}": value for name, value in render.variation.items()}
    values = {name: value for name, value in values.items() if value is not None}
    # Sizes that differ by orders of magnitude would hide each other's errors.
    scale = {"thermal": 1.0 if options.thermal_moves_density else 3.0}
    loss = torch.zeros((), dtype=dtype)
    for name, value in values.items():
        push = torch.rand(value.shape, generator=generator) * scale.get(name, 1.0)
        loss = loss + (torch.where(torch.isfinite(value), value, 0.0) * push.to(dtype)).sum()
    if loss.requires_grad:
        loss.backward()
    gradients = {}
    for name, parameter in grid.row_parameters().items():
        gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        gradients[name] = gradient.to_dense().double()
    return Seen({name: value.detach().double() for name, value in values.items()}, gradients)


def assert_same(found: Seen, reference: Seen, values: float, gradients: float) -> None:
    """Compare as vectors: every value within `values` relative, every gradient within `gradients` relative L2."""
    assert found.values.keys() == reference.values.keys() and found.gradients.keys() == reference.gradients.keys()
    for name, expected in reference.values.items():
        size = max(expected[torch.isfinite(expected)].abs().flatten().tolist(), default=0.0)
        atol = values * max(1e-30, 0.1 * min(size, 1.0))
        torch.testing.assert_close(
            found.values[name], expected, rtol=values, atol=atol, msg=lambda m, n=name: f"{n}: {m}"
        )
    for name, expected in reference.gradients.items():
        got = found.gradients[name]
        assert bool(torch.isfinite(got).all()), f"gradient of {name} is not finite"
        size = float(expected.norm())
        error = float((got - expected).norm())
        assert error <= gradients * size, f"gradient of {name}: relative error {error / max(size, 1e-300):.3g}"


def assert_twins_agree(grid: VoxelGrid, request: RayRequest, options: RenderOptions = EVERYTHING) -> Seen:
    """Compare the fused renderer in both precisions with the reference in double precision, and return the latter."""
    twin, exact = as_double(grid), in_double(request)
    reference = see("reference", twin, exact, options)
    assert_same(see("fused", twin, exact, options), reference, 1e-11, 1e-11)
    assert_same(see("fused", grid, request, options), reference, 1e-5, 1e-4)
    return reference
