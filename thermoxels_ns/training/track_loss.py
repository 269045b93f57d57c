"""Opacity along lines of sight: none before the point that a photograph sees, all up to just behind it.

Points are those of structure from motion, or those on whose depth photographs agree (`photo_depth`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from thermoxels_ns.core.feature_rays import Sightlines
from thermoxels_ns.render.ray_render import RayRequest

MARGIN_VOXELS = 1.5
"""Voxels before and behind a point between which the surface may lie."""
MARGIN_ERRORS = 2.0
"""Standard errors of a line's length by which that is widened."""

COARSE_LIGHT = 0.5
"""Share of the light that may pass a depth of photographs while the lattice is coarse. A coarse voxel that has to be
opaque reaches beyond what it holds, and what of it lies before the surroundings stays, painted like these. One that
takes half of the light yields to colours, and is there before the surroundings are painted to show the thing instead.
Tracks of structure from motion are fewer, and let none pass: rooms would keep more fog."""


class TrackRays:
    """Rays along lines of sight.

    Args:
        lines: Lines of sight, world units; at least one.
        coarse_light: Share of the light that may pass a point while the lattice is coarse.
    """

    def __init__(self, lines: Sightlines, coarse_light: float = 0.0) -> None:
        self.coarse_light = coarse_light
        along = torch.from_numpy(lines.points[lines.point] - lines.origins)
        self._length = torch.linalg.norm(along, dim=-1)
        self._directions = (along / self._length[:, None].clamp(min=1e-12)).float()
        self._origins = torch.from_numpy(lines.origins).float()
        self._uncertainty = torch.from_numpy(lines.uncertainty)

    def request(
        self, count: int, near: float, voxel_size: float, generator: torch.Generator, device: torch.device
    ) -> RayRequest:
        """Choose lines at random and make two rays of each, that before the point and that through it.

        Args:
            count: Number of lines.
            near: Distance where sampling starts, [world units].
            voxel_size: Of the lattice, [world units].
            generator: On the CPU.
            device: Where the rays are wanted.

        Returns:
            2 `count` rays without colour and temperature: first those that end before their points.
        """
        chosen = torch.randint(len(self._length), (count,), generator=generator)
        margin = MARGIN_VOXELS * voxel_size + MARGIN_ERRORS * self._uncertainty[chosen]
        length = self._length[chosen]
        far = torch.cat(((length - margin).clamp(min=0.0), length + margin)).float()
        nothing = torch.zeros(2 * count, dtype=torch.bool, device=device)
        origins, directions = (v[chosen].repeat(2, 1).to(device) for v in (self._origins, self._directions))
        return RayRequest(origins, directions, near, far.to(device), nothing, nothing)


def track_loss(accumulation: Tensor, transmittance: Tensor, tolerated: float = 0.0) -> Tensor:
    """Mean share of light that a line loses before its point, and that passes it: both are 0 for a surface in place.

    Args:
        accumulation: Of the rays of `TrackRays.request`, shape (2 n,).
        transmittance: Of the same rays, shape (2 n,).
        tolerated: Share of the light that may pass without counting.

    >>> float(track_loss(torch.tensor([0.25, 0.9]), torch.tensor([0.75, 0.1])))
    0.3499999940395355
    >>> float(track_loss(torch.tensor([0.25, 0.3]), torch.tensor([0.75, 0.7]), tolerated=0.5))
    0.44999998807907104
    """
    count = len(accumulation) // 2
    return accumulation[:count].mean() + (transmittance[count:] - tolerated).clamp(min=0.0).mean()
