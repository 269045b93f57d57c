"""What is asked of a renderer, and what it gives."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class RayRequest:
    """Rays and what they want."""

    origins: Float[Tensor, "rays 3"]  # World units
    directions: Float[Tensor, "rays 3"]  # Unit vectors
    near: float | Float[Tensor, " rays"] = 0.0  # Distance where sampling starts, world units
    far: Float[Tensor, " rays"] | None = None  # Distance where it ends; None: at the box
    rgb_rays: Bool[Tensor, " rays"] | None = None  # Rays that want colour; None: all that can. The others get 0
    thermal_rays: Bool[Tensor, " rays"] | None = None  # Rays that want temperature; None: all. The others get 0


@dataclass(frozen=True)
class RenderOptions:
    """What to compute, and how exactly."""

    steps_per_voxel: float = 2.0  # Samples per voxel edge along a ray
    smallest_weight: float = 0.0
    """Steps of at most this weight add no colour and no temperature; the error of a pixel is at most this times its
    number of steps. 0 is exact."""
    early_stop: float = 0.0
    """A ray ends when less than this share of its light is left; its pixel, accumulation and weights are off by at
    most this much. 0: never. (The reference has no use for it and marches on.)"""
    thermal_moves_density: bool = False  # Let the thermal sum carry gradients into the weights
    distortion_scale: float | None = None
    """Length that counts as 1 in the distortion of each ray, world units; None: not computed."""
    sh_degree: int | None = None
    """Degree up to which the stored colour harmonics take part; None: all. What lies behind gets no gradient."""
    colour_channels: int | None = None
    """Channels over which total variation of colour is averaged: those that are not stored yet are 0 and count. None:
    the stored ones."""
    sparsity: bool = False  # Sum the Cauchy sparsity of each ray, over the samples at hand
    variation: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Total variation to compute: parameter name to the first and one behind the last kept voxel of a block."""


@dataclass(frozen=True)
class RayRender:
    """What a bundle of rays sees, without what stands behind the box."""

    rgb: Float[Tensor, "rays 3"] | None  # Sum of weight times colour; None where there is no colour
    thermal: Float[Tensor, "rays 1"]  # Sum of weight times normalised temperature
    transmittance: Float[Tensor, " rays"]  # Share of the background that is left
    accumulation: Float[Tensor, " rays"]  # 1 - transmittance, with all digits when it is small
    depth: Float[Tensor, " rays"]  # Expected distance of what was hit; infinite where nothing was. Carries no gradient
    distortion: Float[Tensor, " rays"] | None = None  # Distortion of each ray
    sparsity: Float[Tensor, " rays"] | None = None  # Sum of log(1 + 2 density^2) over each ray's samples
    variation: dict[str, Float[Tensor, ""]] = field(default_factory=dict)  # Total variation of the blocks asked for
    surroundings: Float[Tensor, " rays"] | None = None
    """Share of the light from infinity that the surroundings keep from each ray; None without any."""

    def with_background(
        self, rgb: Tensor | None, thermal: Tensor | None, request: RayRequest, thermal_moves_density: bool = False
    ) -> tuple[Tensor | None, Tensor]:
        """Colour and temperature with what stands behind the box: C + T_end C_background (paper, eq. 1 and 2).

        Args:
            rgb: Colour at infinity, (rays, 3); None: black.
            thermal: Normalised temperature at infinity, (rays, 1); None: 0, the scene's minimum.
            request: The rays; those that do not want a value get 0.
            thermal_moves_density: Let the thermal sum carry gradients into the weights.
        """
        left = self.transmittance[:, None]
        seen, warm = self.rgb, self.thermal
        if seen is not None and rgb is not None:
            behind = left * rgb
            seen = seen + (behind if request.rgb_rays is None else behind * request.rgb_rays[:, None])
        if thermal is not None:
            behind = (left if thermal_moves_density else left.detach()) * thermal
            warm = warm + (behind if request.thermal_rays is None else behind * request.thermal_rays[:, None])
        return seen, warm


def near_and_far(request: RayRequest) -> tuple[Tensor, Tensor]:
    """`near` and `far` as one number per ray."""
    origins = request.origins
    near = torch.as_tensor(request.near, dtype=origins.dtype, device=origins.device).expand(len(origins))
    far = request.far
    if far is None:
        far = torch.full((len(origins),), torch.inf, dtype=origins.dtype, device=origins.device)
    return near, far
