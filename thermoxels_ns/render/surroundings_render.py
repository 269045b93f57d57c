"""Rays behind the box: their pieces in the surroundings, rendered as rays and put together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from thermoxels_ns.field.surroundings import Surroundings
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import Backend, render_rays

STEPS_PER_VOXEL = 1.0
"""Samples per voxel edge: what stands behind is soft anyway (a figure in a street: 17.1 dB, and 16.9 dB with two)."""


@dataclass(frozen=True)
class SurroundingsRender:
    """What rays see of the surroundings."""

    rgb: Float[Tensor, "rays 3"] | None  # Sum of weight times colour; None where there is no colour
    thermal: Float[Tensor, "rays 1"]  # Sum of weight times normalised temperature
    transmittance: Float[Tensor, " rays"]  # Share of the light that reaches them from infinity
    variation: dict[str, Float[Tensor, ""]]  # Total variation of the blocks asked for


def render_surroundings(
    surroundings: Surroundings,
    request: RayRequest,
    options: RenderOptions,
    backend: Backend,
    asked: Bool[Tensor, " rays"],
) -> SurroundingsRender:
    """Render the surroundings behind the box for the rays asked for; the others see nothing of them."""
    (chosen,) = asked.nonzero(as_tuple=True)
    far = None if request.far is None else request.far[chosen]
    cut = surroundings.segments(request.origins[chosen], request.directions[chosen], far)
    ray = chosen[cut.ray]
    wants = (None if bits is None else bits[ray] for bits in (request.rgb_rays, request.thermal_rays))
    pieces = RayRequest(cut.origins, cut.directions, 0.0, cut.lengths, *wants)
    plain = replace(
        options,
        steps_per_voxel=min(STEPS_PER_VOXEL, options.steps_per_voxel),
        distortion_scale=None,
        sparsity=False,
        sh_degree=None,
        colour_channels=None,
    )
    seen = render_rays(surroundings.grid, pieces, plain, backend)
    values = seen.thermal if seen.rgb is None else torch.cat((seen.rgb, seen.thermal), 1)
    total = values.new_zeros(len(asked), values.shape[1])
    left = values.new_ones(len(asked))
    for rank in range(int(cut.rank.max()) + 1 if len(ray) else 0):
        (some,) = (cut.rank == rank).nonzero(as_tuple=True)
        rays = ray[some]
        before = left.index_select(0, rays)
        weight = before[:, None].expand(-1, values.shape[1])
        if not options.thermal_moves_density:
            weight = torch.cat((weight[:, :-1], weight[:, -1:].detach()), 1)
        total = total.index_add(0, rays, weight * values.index_select(0, some))
        left = left.index_copy(0, rays, before * seen.transmittance.index_select(0, some))
    return SurroundingsRender(total[:, :-1] if seen.rgb is not None else None, total[:, -1:], left, seen.variation)
