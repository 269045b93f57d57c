"""Rendering of a scene: the box and its surroundings by one of two backends, and the background at infinity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.field.surroundings import Surroundings, seen_behind
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render import reference
from thermoxels_ns.render.ray_render import GridSamples, RayRender, RayRequest, RenderOptions

Backend = Literal["auto", "reference", "fused"]
STEPS_PER_VOXEL = 1.0
"""Most samples per voxel edge of the surroundings, which are soft anyway (a figure in a street: 17.1 dB with one,
16.9 dB with two samples)."""
LEAST_LIGHT = 0.003  # The surroundings of a ray are rendered if more than this share of its light leaves the box


def choose_backend(backend: Backend, device: torch.device) -> Literal["reference", "fused"]:
    """Return the backend for a device: auto is fused on a CPU, else reference. Raise `ThermoxelsError` for fused on a
    device other than a CPU."""
    if backend == "fused" and device.type != "cpu":
        remedy = "Pass --pipeline.model.backend auto, or --machine.device-type cpu."
        got = "fused, whose kernels run on the CPU"
        raise ThermoxelsError("backend", expected=f"auto or reference on {device.type}", got=got, remedy=remedy)
    if backend == "auto":
        return "fused" if device.type == "cpu" else "reference"
    return backend


def _of(grid: VoxelGrid, backend: Backend) -> Any:
    """Return the module, `reference` or `fused`, that renders a grid."""
    if choose_backend(backend, grid.density.device) == "reference":
        return reference
    from thermoxels_ns.render import fused  # numba, which importing the configuration must not load

    return fused


def render_rays(grid: VoxelGrid, request: RayRequest, options: RenderOptions, backend: Backend) -> RayRender:
    """Return what rays see of a grid alone; no background is added."""
    return _of(grid, backend).render(grid, request, options)


@torch.no_grad()
def sample_rays(grid: VoxelGrid, request: RayRequest, options: RenderOptions, backend: Backend) -> GridSamples:
    """Return the samples of rays in kept voxels with their weights; neither colour nor temperature is read."""
    return _of(grid, backend).samples(grid, request, options)


@dataclass(frozen=True)
class Scene:
    """All that rays can see: the grid in the box, the surroundings outside the box, and the values at infinity."""

    grid: VoxelGrid
    surroundings: Surroundings | None = None  # None: between the box and infinity is nothing
    rgb: nn.Module | None = None  # Maps unit directions to colour at infinity, (n, 3); None: black
    thermal: nn.Module | None = None  # Maps unit directions to normalised temperature at infinity, (n, 1); None: 0


@dataclass(frozen=True)
class AroundRender:
    """Rendered rays through the surroundings; a ray that lost nearly all light in the box: sums 0, transmittance 1."""

    rgb: Float[Tensor, "rays 3"] | None  # Sum of weight times colour; None where there is no colour
    thermal: Float[Tensor, "rays 1"]  # Sum of weight times normalised temperature
    transmittance: Float[Tensor, " rays"]  # Share of the light from infinity that passes the surroundings
    variation: dict[str, Float[Tensor, ""]]  # Total variation by parameter name, of the blocks that were requested


@dataclass(frozen=True)
class SceneRender:
    """Rendered rays through a scene (paper, eq. 1 and 2): C = C_box + T_box (C_around + T_around C_infinity)."""

    rgb: Float[Tensor, "rays 3"] | None  # Colour; None for a grid without colour
    thermal: Float[Tensor, "rays 1"]  # Normalised temperature
    box: RayRender  # Result of the box alone
    around: AroundRender | None  # None without surroundings


def split_render(requests: Sequence[RayRequest], render: Callable[[RayRequest], SceneRender]) -> list[SceneRender]:
    """Return the results of several requests, of which `render` renders all rays in one call. Each result has the rays
    of its own request, and the total variation of the whole call."""
    ends = [request.near_and_far() for request in requests]
    counts = [len(request.origins) for request in requests]
    every = torch.ones(sum(counts), dtype=torch.bool, device=requests[0].origins.device)
    wants = [
        torch.cat([every[:count] if bits is None else bits for bits, count in zip(chosen, counts)])
        for chosen in ([request.rgb_rays for request in requests], [request.thermal_rays for request in requests])
    ]
    origins, directions = (
        torch.cat([getattr(request, name) for request in requests]) for name in ("origins", "directions")
    )
    near, far = (torch.cat([pair[number] for pair in ends]) for number in range(2))
    seen, parts, first = render(RayRequest(origins, directions, near, far, *wants)), [], 0
    for count in counts:
        parts.append(_rays_of(seen, slice(first, first + count)))
        first += count
    return parts


def _rays_of(result: Any, part: slice) -> Any:
    """Return a result of rendering (a dataclass) with only the rays of the slice `part`."""
    cut = {}
    for name, value in vars(result).items():
        if isinstance(value, Tensor):
            cut[name] = value[part]
        elif isinstance(value, (RayRender, AroundRender)):
            cut[name] = _rays_of(value, part)
    return replace(result, **cut)


def render_scene(
    scene: Scene,
    request: RayRequest,
    options: RenderOptions,
    backend: Backend,
    variation: dict[str, tuple[int, int]] | None = None,
) -> SceneRender:
    """Return what rays see of box, surroundings and infinity; a ray that does not want a value gets 0. `options` are
    for the grid in the box. `variation` is `RenderOptions.variation` for the grid of the surroundings."""
    box = render_rays(scene.grid, request, options, backend)
    around = None
    if scene.surroundings is not None:
        around = _render_around(scene.surroundings, box.transmittance, request, options, backend, variation or {})
    rgb, thermal, light = box.rgb, box.thermal, box.transmittance[:, None]
    of_thermal = light if options.thermal_moves_density else light.detach()
    if around is not None:
        if rgb is not None and around.rgb is not None:
            rgb = rgb + light * around.rgb
        thermal = thermal + of_thermal * around.thermal
        light, of_thermal = light * around.transmittance[:, None], of_thermal * around.transmittance.detach()[:, None]
    if rgb is not None and scene.rgb is not None:
        rgb = rgb + light * seen_behind(scene.rgb, request.directions, request.rgb_rays)
    if scene.thermal is not None:
        thermal = thermal + of_thermal * seen_behind(scene.thermal, request.directions, request.thermal_rays)
    return SceneRender(rgb, thermal, box, around)


def _render_around(
    surroundings: Surroundings,
    light: Tensor,
    request: RayRequest,
    options: RenderOptions,
    backend: Backend,
    variation: dict[str, tuple[int, int]],
) -> AroundRender:
    """Return what rays see of the surroundings; `light` (rays,) is the share of their light that leaves the box."""
    (chosen,) = (light.detach() > LEAST_LIGHT).nonzero(as_tuple=True)
    far = None if request.far is None else request.far[chosen]
    cut = surroundings.segments(request.origins[chosen], request.directions[chosen], far)
    ray = chosen[cut.ray]
    wants = (None if bits is None else bits[ray] for bits in (request.rgb_rays, request.thermal_rays))
    plain = RenderOptions(
        min(STEPS_PER_VOXEL, options.steps_per_voxel),
        options.smallest_weight,
        options.early_stop,
        options.thermal_moves_density,
        variation=variation,
    )
    pieces = RayRequest(cut.origins, cut.directions, 0.0, cut.lengths, *wants)
    seen = render_rays(surroundings.grid, pieces, plain, backend)
    values = seen.thermal if seen.rgb is None else torch.cat((seen.rgb, seen.thermal), 1)
    total, left = values.new_zeros(len(light), values.shape[1]), torch.ones_like(light)
    for rank in range(int(cut.rank.max()) + 1 if len(ray) else 0):
        (some,) = (cut.rank == rank).nonzero(as_tuple=True)
        rays = ray[some]
        before = left.index_select(0, rays)
        weight = before[:, None].expand(-1, values.shape[1])
        if not options.thermal_moves_density:
            weight = torch.cat((weight[:, :-1], weight[:, -1:].detach()), 1)
        total = total.index_add(0, rays, weight * values.index_select(0, some))
        left = left.index_copy(0, rays, before * seen.transmittance.index_select(0, some))
    rgb = None if seen.rgb is None else total[:, :-1]
    return AroundRender(rgb, total[:, -1:], left, seen.variation)
