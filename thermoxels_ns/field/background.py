"""What a ray sees behind the box: a sphere image, a low-order sky temperature."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from thermoxels_ns.field.harmonics import MAX_DEGREE, harmonics_with_unit_mean, num_coefficients

RAYS_AT_ONCE = 8192
"""Rays for which a background is evaluated together: torch splits tensors of 32,768 entries or more among its threads,
and then the last bits of gradients and of some functions depend on how many there are."""


def seen_behind(
    background: nn.Module, directions: Float[Tensor, "n 3"], wanted: Bool[Tensor, " n"] | None
) -> Float[Tensor, "n c"]:
    """What is behind the box along unit directions; 0 for rays that do not want it, which are not asked for."""
    if wanted is None or bool(wanted.all()):
        if len(directions) <= RAYS_AT_ONCE:
            return background(directions)
        return torch.cat([background(part) for part in directions.split(RAYS_AT_ONCE)])
    (places,) = wanted.nonzero(as_tuple=True)
    values = seen_behind(background, directions[places], None)
    return values.new_zeros((len(directions), values.shape[1])).index_copy(0, places, values)


class SphereImage(nn.Module):
    """Colour at infinity as an equirectangular image around the z axis, bilinear, in logits.

    Args:
        height: Rows from the +z pole to the -z pole; there are twice as many columns.
    """

    def __init__(self, height: int = 32):
        super().__init__()
        self.image = nn.Parameter(torch.zeros(height, 2 * height, 3))

    def forward(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Colour in [0, 1] seen along unit directions."""
        height, width, _ = self.image.shape
        x, y, z = directions.unbind(-1)
        column = (torch.atan2(y, x) / (2 * math.pi) + 0.5) * width - 0.5
        row = (torch.acos(z.clamp(-1, 1)) / math.pi * height - 0.5).clamp(0, height - 1)
        left, top = column.floor(), row.floor().clamp(max=height - 2)
        s, t = (column - left)[:, None], (row - top)[:, None]
        j0, i0 = left.long() % width, top.long()
        j1, i1 = (j0 + 1) % width, i0 + 1
        upper = torch.lerp(self.image[i0, j0], self.image[i0, j1], s)
        lower = torch.lerp(self.image[i1, j0], self.image[i1, j1], s)
        return torch.sigmoid(torch.lerp(upper, lower, t))


class SkyTemperature(nn.Module):
    """Normalised temperature at infinity as spherical harmonics, 0 in every direction at first."""

    def __init__(self) -> None:
        super().__init__()
        self.coefficients = nn.Parameter(torch.zeros(num_coefficients(MAX_DEGREE)))

    def forward(self, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
        """Normalised temperature seen along unit directions."""
        # BLAS splits a product over rays among its threads; the gradient of `embedding` adds rays in their order.
        one = torch.zeros(len(directions), dtype=torch.long, device=directions.device)
        coefficients = F.embedding(one, self.coefficients[None])
        return (harmonics_with_unit_mean(directions, MAX_DEGREE) * coefficients).sum(-1, keepdim=True)
