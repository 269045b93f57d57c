"""What stands behind the box: only rays that want it ask for it, and nothing else notices."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from thermoxels_ns.field.background import SkyTemperature, SphereImage, seen_behind


class Counting(nn.Module):
    """A background that remembers how many rays asked."""

    def __init__(self, background: nn.Module):
        super().__init__()
        self.background, self.asked = background, 0

    def forward(self, directions: torch.Tensor) -> torch.Tensor:
        self.asked = len(directions)
        return self.background(directions)


@pytest.mark.parametrize("make", [SphereImage, SkyTemperature])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_rays_that_want_nothing_are_not_asked_for_and_the_others_see_the_same_bits(make, share):
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(997, 3, generator=generator), dim=-1)
    wanted = torch.rand(997, generator=generator) < share
    background = Counting(make())
    (parameter,) = background.parameters()
    parameter.data = torch.randn(parameter.shape, generator=generator)
    push = torch.randn(997, 1, generator=generator) * wanted[:, None]
    all_rays = seen_behind(background, directions, None)
    assert background.asked == 997
    (expected,) = torch.autograd.grad((all_rays * push).sum(), parameter)
    values = seen_behind(background, directions, wanted)
    assert background.asked == int(wanted.sum())
    (gradient,) = torch.autograd.grad((values * push).sum(), parameter)
    assert torch.equal(values, all_rays * wanted[:, None]) and torch.equal(gradient, expected)
    assert (float(gradient.abs().max()) > 0) == (share > 0)
