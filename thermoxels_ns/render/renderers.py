"""What rays see of a scene: the box by one of two renderers, what surrounds it, and what lies at infinity."""

from __future__ import annotations

from dataclasses import dataclass
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
"""Samples per voxel edge of the surroundings: what stands behind is soft anyway (a figure in a street: 17.1 dB, and
16.9 dB with two)."""
LEAST_LIGHT = 0.003  # Share of a ray's light that leaves the box from which its surroundings are asked for


def choose_backend(backend: Backend, device: torch.device) -> Literal["reference", "fused"]:
    """Turn auto into the fastest backend of a device; raises `ThermoxelsError` for the compiled one beside a CPU."""
    if backend == "fused" and device.type != "cpu":
        remedy = "Pass --pipeline.model.backend auto, or --machine.device-type cpu."
        got = "fused, whose kernels run on the CPU"
        raise ThermoxelsError("backend", expected=f"auto or reference on {device.type}", got=got, remedy=remedy)
    if backend == "auto":
        return "fused" if device.type == "cpu" else "reference"
    return backend


def _of(grid: VoxelGrid, backend: Backend) -> Any:
    """The module that renders a grid with the backend of choice."""
    if choose_backend(backend, grid.density.device) == "reference":
        return reference
    from thermoxels_ns.render import fused  # numba, which importing the configuration must not load

    return fused


def render_rays(grid: VoxelGrid, request: RayRequest, options: RenderOptions, backend: Backend) -> RayRender:
    """Render rays through a grid, without what stands behind it."""
    return _of(grid, backend).render(grid, request, options)


@torch.no_grad()
def sample_rays(grid: VoxelGrid, request: RayRequest, options: RenderOptions, backend: Backend) -> GridSamples:
    """March rays and list their samples; neither colour nor temperature is read."""
    return _of(grid, backend).samples(grid, request, options)


@dataclass(frozen=True)
class Scene:
    """All that rays can see; what is None is not there, infinity without a colour or temperature is black or 0."""

    grid: VoxelGrid
    surroundings: Surroundings | None = None
    rgb: nn.Module | None = None  # Colour at infinity along unit directions
    thermal: nn.Module | None = None  # Normalised temperature there


@dataclass(frozen=True)
class AroundRender:
    """What rays see of the surroundings; those that lost nearly all of their light in the box see nothing."""

    rgb: Float[Tensor, "rays 3"] | None  # Sum of weight times colour; None where there is no colour
    thermal: Float[Tensor, "rays 1"]  # Sum of weight times normalised temperature
    transmittance: Float[Tensor, " rays"]  # Share of the light that reaches them from infinity
    variation: dict[str, Float[Tensor, ""]]  # Total variation of the blocks asked for


@dataclass(frozen=True)
class SceneRender:
    """What rays see of a scene (paper, eq. 1 and 2): C = C_box + T_box (C_around + T_around C_infinity)."""

    rgb: Float[Tensor, "rays 3"] | None
    thermal: Float[Tensor, "rays 1"]
    box: RayRender
    around: AroundRender | None  # None without surroundings


def render_scene(
    scene: Scene,
    request: RayRequest,
    options: RenderOptions,
    backend: Backend,
    variation: dict[str, tuple[int, int]] | None = None,
) -> SceneRender:
    """Render rays through box and surroundings to infinity; rays that do not want a value get 0.

    `options` are those of the box, `variation` is the total variation to compute of the surroundings.
    """
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
    """Render the surroundings for rays of which enough light leaves the box: their pieces as rays, put together."""
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
