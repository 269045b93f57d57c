"""Colour gets columns for further harmonics: colours, gradients and optimisers go on as if they had been there."""

import copy

import pytest
import torch

from tests.reference.two_renderers import random_grid
from thermoxels_ns.field.harmonics import num_coefficients
from thermoxels_ns.field.refine import widen_colour
from thermoxels_ns.render.reference import total_variation
from thermoxels_ns.training.optimizers import RowAdam, RowRMSprop

STEPS = [(0, 1), (0, 2), (1, 2)]


def places_of(low: int, high: int) -> torch.Tensor:
    """Columns in which the harmonics of the lower degree stand among those of the higher one."""
    few, many = num_coefficients(low), num_coefficients(high)
    return torch.tensor([channel * many + k for channel in range(3) for k in range(few)])


@pytest.mark.parametrize("low, high", STEPS)
def test_colours_stay_and_new_columns_are_nil(low, high):
    grid = random_grid(low, kept=0.5)
    before, old = grid.sh.detach().clone(), grid.sh
    points = torch.as_tensor(grid.lattice.cell_centres(), dtype=torch.float32)[grid.kept]
    directions = torch.nn.functional.normalize(torch.randn(len(points), 3), dim=-1)
    colours = grid.rgb_at(grid.locate(points), directions).detach()
    change = widen_colour(grid, high)
    assert grid.sh is not old and grid.sh_degree == high and grid.sh.shape[1] == 3 * num_coefficients(high)
    places = places_of(low, high)
    assert torch.equal(grid.sh[:, places], before)
    assert int((grid.sh != 0).sum()) == int((before != 0).sum())
    torch.testing.assert_close(grid.rgb_at(grid.locate(points), directions), colours, rtol=0, atol=1e-6)
    assert torch.equal(change(before), grid.sh)


def test_variation_of_columns_that_are_not_stored_is_that_of_zeros():
    rows, corners = torch.randn(20, 3), torch.arange(16).view(2, 8)
    padded = torch.cat((rows, torch.zeros(20, 24)), 1)
    found = total_variation(rows, corners, channels=27)
    assert float(found) == pytest.approx(float(total_variation(padded, corners)), rel=1e-6)
    assert float(found) < 0.2 * float(total_variation(rows, corners))


@pytest.mark.parametrize("make", [RowAdam, RowRMSprop])
@pytest.mark.parametrize("low, high", STEPS)
def test_optimisers_go_on_as_if_the_columns_had_been_there(make, low, high):
    """Rows with a gradient now, earlier, never: moments widen, the number of updates stays."""
    narrow, places = random_grid(low, kept=0.5), places_of(low, high)
    wide = copy.deepcopy(narrow)
    widen_colour(wide, high)
    pair = [(grid, make([grid.sh], lr=0.1)) for grid in (narrow, wide)]
    generator = torch.Generator().manual_seed(0)
    for turn in range(6):
        if turn == 3:
            old = narrow.sh
            change = widen_colour(narrow, high)
            pair[0][1].change_columns(old, narrow.sh, change)
            assert pair[0][1].param_groups[0]["params"] == [narrow.sh] and list(pair[0][1].state) == [narrow.sh]
        rows = (torch.rand(len(wide.sh), generator=generator) < 0.4).nonzero()[:, 0]
        push = torch.randn(len(rows), wide.sh.shape[1], generator=generator)
        if turn < 3:
            push[:, ~torch.isin(torch.arange(push.shape[1]), places)] = 0.0
        for grid, optimizer in pair:
            values = push if grid.sh.shape == wide.sh.shape else push[:, places]
            grid.sh.grad = torch.sparse_coo_tensor(rows[None], values.contiguous(), grid.sh.shape)
            optimizer.step()
    assert torch.equal(narrow.sh, wide.sh)
    states = [optimizer.state[grid.sh] for grid, optimizer in pair]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(values, states[1][name]) for name, values in states[0].items())
