"""What is asked of a renderer, and what it gives."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from thermoxels_ns.field.interpolation import TrilinearPoints


@dataclass(frozen=True)
class RayRequest:
    """Rays and what they want."""

    origins: Float[Tensor, "rays 3"]  # World units
    directions: Float[Tensor, "rays 3"]  # Unit vectors
    near: float | Float[Tensor, " rays"] = 0.0  # Distance where sampling starts, world units
    far: Float[Tensor, " rays"] | None = None  # Distance where it ends; None: at the box
    rgb_rays: Bool[Tensor, " rays"] | None = None  # Rays that want colour; None: all that can. The others get 0
    thermal_rays: Bool[Tensor, " rays"] | None = None  # Rays that want temperature; None: all. The others get 0

    def near_and_far(self) -> tuple[Tensor, Tensor]:
        """`near` and `far` as one number per ray."""
        like = self.origins[:, 0]
        far = torch.full_like(like, torch.inf) if self.far is None else self.far
        return torch.as_tensor(self.near, dtype=like.dtype, device=like.device).expand(len(like)), far


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
    colour_channels: int | None = None
    """Channels over which total variation of colour is averaged: those that are not stored yet are 0 and count. None:
    the stored ones."""
    sparsity: bool = False  # Sum the Cauchy sparsity of each ray, over the samples at hand
    variation: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Total variation to compute: parameter name to the first and one behind the last kept voxel of a block."""


@dataclass(frozen=True)
class RayRender:
    """What a bundle of rays sees."""

    rgb: Float[Tensor, "rays 3"] | None  # Sum of weight times colour; None where there is no colour
    thermal: Float[Tensor, "rays 1"]  # Sum of weight times normalised temperature
    transmittance: Float[Tensor, " rays"]  # Share of the light that comes from behind
    accumulation: Float[Tensor, " rays"]  # 1 - transmittance, with all digits when it is small
    depth: Float[Tensor, " rays"]  # Expected distance of what was hit; infinite where nothing was. Carries no gradient
    distortion: Float[Tensor, " rays"] | None = None  # Distortion of each ray
    sparsity: Float[Tensor, " rays"] | None = None  # Sum of log(1 + 2 density^2) over each ray's samples
    variation: dict[str, Float[Tensor, ""]] = field(default_factory=dict)  # Total variation of the blocks asked for


@dataclass(frozen=True)
class GridSamples:
    """Samples of rays in kept voxels, ray after ray, for statistics. No gradients."""

    ray: Int64[Tensor, " n"]  # Ray of each sample, ascending
    at: TrilinearPoints  # Where the samples lie
    weight: Float[Tensor, " n"]  # Share of the pixel
    before: Float[Tensor, " n"]  # Share of the pixel that is spent before the sample
    transmittance: Float[Tensor, " rays"]  # Share of the pixel that is left for the background
