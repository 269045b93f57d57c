"""Loss terms of colour, temperature, opacity and feature rays, in plain torch; each term is a mean."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from thermoxels_ns.core.feature_rays import MARGIN_ERRORS, MARGIN_VOXELS, FeatureRays
from thermoxels_ns.render.ray_render import RayRequest

LARGEST_ERROR = 0.25  # Points outside the box count if `MARGIN_ERRORS` errors are less than this share of the length
COARSE_LIGHT = 0.5
"""Share of the light that may pass a depth found in photographs while the lattice is coarse: an opaque coarse voxel
reaches beyond the surface in it and hides things beside that surface. No light may pass points of structure from
motion: these are fewer, and rooms would keep more floaters."""


def thermal_loss(predicted: Float[Tensor, "n 1"], target: Float[Tensor, "n 1"]) -> Float[Tensor, ""]:
    """Return half of the mean squared plus half of the mean absolute error (paper, eq. 4 with lambda = 1/2)."""
    error = predicted - target
    return 0.5 * torch.mean(error**2) + 0.5 * torch.mean(error.abs())


def random_block(voxels: int, share: float, generator: torch.Generator) -> tuple[int, int]:
    """Return the first number and the last number plus 1 of a random block of about `share` of all kept `voxels`. Kept
    voxels are numbered slab by slab along x, so that a block is contiguous in space too."""
    length = min(voxels, max(1, math.ceil(share * voxels)))
    first = int(torch.randint(voxels - length + 1, (), generator=generator))
    return first, first + length


def beta_loss(accumulation: Float[Tensor, " rays"], guard: float = 1e-3) -> Float[Tensor, ""]:
    """Return the mean of log(A + guard) + log(1 - A + guard) over opacities A, shifted to be 0 for A of 0 or 1. This
    term pushes rays to be opaque or empty (Neural Volumes; Plenoxels)."""
    decided = math.log(guard) + math.log(1.0 + guard)
    return torch.mean(torch.log(accumulation + guard) + torch.log(1.0 - accumulation + guard)) - decided


class FeatureRaySampler:
    """Sampler of random feature rays for `feature_ray_loss`, which is 0 if the surface lies at their points.

    Args:
        rays: Feature rays, [world units]; at least one.
        box: Lower and upper corner, (2, 3), [world units]. A surface is expected at all points inside the box.
        surroundings: True: a surface is also expected at points outside whose distance is known (`LARGEST_ERROR`).
        coarse_light: Share of the light that may pass a point while the lattice is coarse.
    """

    def __init__(
        self, rays: FeatureRays, box: npt.ArrayLike, surroundings: bool = False, coarse_light: float = 0.0
    ) -> None:
        self.coarse_light = coarse_light
        lo, hi = np.asarray(box, dtype=np.float64)
        self._ends = torch.from_numpy(((rays.points > lo) & (rays.points < hi)).all(1)[rays.point])
        along = torch.from_numpy(rays.points[rays.point] - rays.origins)
        self._length = torch.linalg.norm(along, dim=-1)
        # Depth of a voxel of the surroundings at each point, world units, per `Surroundings.step`; 0 inside the box.
        times = (np.abs(rays.points - 0.5 * (lo + hi)) / (0.5 * (hi - lo))).max(1)[rays.point]
        self._growth = torch.from_numpy(np.where(times > 1.0, times * times, 0.0) * 0.5 * (hi - lo).max())
        if surroundings:
            uncertainty = torch.from_numpy(rays.uncertainty)
            self._ends |= (uncertainty > 0) & (MARGIN_ERRORS * uncertainty < LARGEST_ERROR * self._length)
        self._directions = (along / self._length[:, None].clamp(min=1e-12)).float()
        self._origins = torch.from_numpy(rays.origins).float()
        self._uncertainty = torch.from_numpy(rays.uncertainty)

    def request(
        self,
        count: int,
        near: float,
        voxel_size: float,
        generator: torch.Generator,
        device: torch.device,
        surroundings_step: float = 0.0,
    ) -> RayRequest:
        """Return 2 `count` rays: `count` random feature rays that end a margin before their points, then the same rays,
        ending a margin behind their points, or with length 0 if no surface is expected there.

        The rays want neither colour nor temperature. `near` and `voxel_size`, for the margin, are in world units;
        `generator` must be on the CPU. `surroundings_step` is `Surroundings.step`, or 0 without surroundings.
        """
        chosen = torch.randint(len(self._length), (count,), generator=generator)
        margin = (
            MARGIN_VOXELS * (voxel_size + surroundings_step * self._growth[chosen])
            + MARGIN_ERRORS * self._uncertainty[chosen]
        )
        length = self._length[chosen]
        # The error is one of 1 / length: a margin as large as the length leaves half of the length.
        before = length * length / (length + margin).clamp(min=1e-12)
        far = torch.cat((before, (length + margin) * self._ends[chosen])).float()
        nothing = torch.zeros(2 * count, dtype=torch.bool, device=device)
        origins, directions = (v[chosen].repeat(2, 1).to(device) for v in (self._origins, self._directions))
        return RayRequest(origins, directions, near, far.to(device), nothing, nothing)


def feature_ray_loss(accumulation: Tensor, transmittance: Tensor, tolerated: float = 0.0) -> Tensor:
    """Return the mean share of light that feature rays lose before their points, plus the share that passes the points.

    Both shares are 0 if the surface lies at the points. Opacity `accumulation` and `transmittance` have shape (2 n,),
    one entry per ray of `FeatureRaySampler.request`. The share `tolerated` may pass a point without loss.

    >>> float(feature_ray_loss(torch.tensor([0.25, 0.9]), torch.tensor([0.75, 0.1])))
    0.3499999940395355
    >>> float(feature_ray_loss(torch.tensor([0.25, 0.3]), torch.tensor([0.75, 0.7]), tolerated=0.5))
    0.44999998807907104
    """
    count = len(accumulation) // 2
    return accumulation[:count].mean() + (transmittance[count:] - tolerated).clamp(min=0.0).mean()
