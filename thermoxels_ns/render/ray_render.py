"""Inputs of a renderer (rays and options) and its results."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from thermoxels_ns.field.interpolation import TrilinearPoints


@dataclass(frozen=True)
class RayRequest:
    """Rays to render, and which of them want colour and temperature."""

    origins: Float[Tensor, "rays 3"]  # World units
    directions: Float[Tensor, "rays 3"]  # Unit vectors
    near: float | Float[Tensor, " rays"] = 0.0  # Distance where sampling starts, world units
    far: Float[Tensor, " rays"] | None = None  # Distance where sampling ends, world units; None: behind the grid
    rgb_rays: Bool[Tensor, " rays"] | None = None  # True: the ray wants colour; False: it gets 0; None: all want it
    thermal_rays: Bool[Tensor, " rays"] | None = None  # The same for temperature

    def near_and_far(self) -> tuple[Tensor, Tensor]:
        """Return `near` and `far` with one number per ray, shape (rays,); `far` is infinite where it is None."""
        like = self.origins[:, 0]
        far = torch.full_like(like, torch.inf) if self.far is None else self.far
        return torch.as_tensor(self.near, dtype=like.dtype, device=like.device).expand(len(like)), far


@dataclass(frozen=True)
class RenderOptions:
    """Options of a renderer, which say what it computes and with which tolerances."""

    steps_per_voxel: float = 2.0  # Samples per voxel edge along a ray
    smallest_weight: float = 0.0
    """Samples of at most this weight add no colour and no temperature; the error of a pixel is at most this weight
    times its number of samples. 0 is exact."""
    early_stop: float = 0.0
    """A ray ends when less than this share of its light is left, so that its pixel, accumulation and weights are off by
    at most this much. 0: it does not end. The backend reference ignores this option and follows rays to their ends."""
    thermal_moves_density: bool = False  # True: density gets a gradient from temperature
    distortion_scale: float | None = None
    """Length that counts as 1 in the distortion of each ray, world units; None: no distortion is computed."""
    colour_channels: int | None = None
    """Number of channels over which the total variation of colour is averaged; channels that the grid does not store
    yet count as 0. None: the stored channels."""
    variation: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By parameter name, the first number and the last number plus 1 of the kept voxels with total variation."""


@dataclass(frozen=True)
class RayRender:
    """The result of rendering rays through one grid, without the background."""

    rgb: Float[Tensor, "rays 3"] | None  # Sum of weight times colour; None where there is no colour
    thermal: Float[Tensor, "rays 1"]  # Sum of weight times normalised temperature
    transmittance: Float[Tensor, " rays"]  # Share of the light from behind the grid that passes the grid
    accumulation: Float[Tensor, " rays"]  # Opacity, 1 - transmittance, with all digits when it is small
    depth: Float[Tensor, " rays"]  # Weighted mean distance, world units; infinite at opacity 0
    distortion: Float[Tensor, " rays"] | None = None  # See `reference.ray_distortion`; None where not requested
    variation: dict[str, Float[Tensor, ""]] = field(default_factory=dict)  # Total variation by parameter name


@dataclass(frozen=True)
class GridSamples:
    """Samples of rays in kept voxels, ray after ray, for statistics; they carry no gradients."""

    ray: Int64[Tensor, " n"]  # Ray of each sample, ascending
    at: TrilinearPoints  # Voxel of each sample, and the place in the voxel
    weight: Float[Tensor, " n"]  # Share of its ray's light that ends in each sample
    before: Float[Tensor, " n"]  # Share of the light that ended before each sample
    transmittance: Float[Tensor, " rays"]  # Share of each ray's light that leaves the grid
