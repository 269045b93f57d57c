"""Lattices and colours that get finer: what rays see, gradients and optimisers go on as if it had been so."""

import copy

import numpy as np
import pytest
import torch

from tests.reference import two_renderers
from tests.support.small_fields import kept_mask
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.harmonics import num_coefficients
from thermoxels_ns.field.refine import prune, refine, split_voxels, widen_colour
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.reference import total_variation
from thermoxels_ns.training.optimizers import RowAdam, RowRMSprop


def random_grid(activation="exp", kept: float = 1.0, temperature_degree: int = 0) -> VoxelGrid:
    lattice = Lattice((-1.0, -1.0, -0.5), 0.25, (9, 9, 5))
    return two_renderers.random_grid(1, temperature_degree, activation, kept, lattice)


def points_inside(grid: VoxelGrid, n: int = 300) -> torch.Tensor:
    lo, hi = torch.tensor(grid.lattice.lo), torch.tensor(grid.lattice.hi)
    return lo + torch.rand(n, 3, generator=torch.Generator().manual_seed(3)) * (hi - lo)


def values_at(grid: VoxelGrid, points: torch.Tensor):
    directions = torch.nn.functional.normalize(points + 3.0, dim=-1)
    at = grid.locate(points)
    return grid.density_at(at), grid.rgb_at(at, directions), grid.thermal_at(at, directions)


@pytest.mark.parametrize("activation", ["relu", "exp"])
@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("kept", [1.0, 0.3])
def test_refinement_changes_nothing_that_a_ray_can_see(activation, factor, kept):
    grid = random_grid(activation, kept, temperature_degree=1)
    points = points_inside(grid, 1000)
    points = points[grid.locate(points).kept()]
    assert len(points) > 200
    before = values_at(grid, points)
    refine(grid, factor)
    assert grid.lattice.cell_shape == (8 * factor, 8 * factor, 4 * factor)
    assert bool(grid.locate(points).kept().all())
    for old, new in zip(before, values_at(grid, points)):
        torch.testing.assert_close(old, new, atol=2e-5, rtol=2e-5)


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("kept", [1.0, 0.3])
def test_old_corners_keep_their_values_to_the_last_bit(factor, kept):
    grid = random_grid(kept=kept)
    old = grid.voxels
    before = {name: p.detach().clone() for name, p in grid.row_parameters().items()}
    change = refine(grid, factor)
    fine = np.ravel_multi_index(tuple((old.corner_index() * factor).T), grid.lattice.shape)
    rows = np.searchsorted(grid.voxels.corners, fine)
    np.testing.assert_array_equal(grid.voxels.corners[rows], fine)
    for name, parameter in grid.row_parameters().items():
        assert torch.equal(parameter.data[rows], before[name])
        assert torch.equal(change(before[name]), parameter.data)
    # What is the same everywhere stays so.
    torch.testing.assert_close(change(torch.full((old.num_rows, 1), 7.0)), torch.full((grid.voxels.num_rows, 1), 7.0))


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_split_voxels_are_those_of_the_dense_mask(factor):
    voxels = random_grid(kept=0.3).voxels
    expected = kept_mask(voxels).numpy()
    for axis in range(3):
        expected = expected.repeat(factor, axis)
    fine = split_voxels(voxels, factor)
    np.testing.assert_array_equal(kept_mask(fine), expected)
    assert fine.lattice == voxels.lattice.refined(factor) and bool((np.diff(fine.cells) > 0).all())


@pytest.mark.parametrize("kept", [1.0, 0.3])
def test_pruning_copies_what_stays(kept):
    grid = random_grid(kept=kept)
    old, before = grid.voxels, {name: p.detach().clone() for name, p in grid.row_parameters().items()}
    points = points_inside(grid, 1000)
    keep = np.random.default_rng(5).random(len(old)) < 0.4
    number = grid.locate(points).number
    stays = (number >= 0) & torch.from_numpy(keep)[number.clamp(min=0)]
    seen = values_at(grid, points[stays])
    change = prune(grid, keep)
    np.testing.assert_array_equal(grid.voxels.cells, old.cells[keep])
    assert torch.equal(grid.locate(points).kept(), stays) and 50 < int(stays.sum()) < 500
    assert all(torch.equal(a, b) for a, b in zip(seen, values_at(grid, points[stays])))
    for name, parameter in grid.row_parameters().items():
        where = np.searchsorted(old.corners, grid.voxels.corners)
        assert torch.equal(parameter.data, before[name][where])
        assert torch.equal(change(before[name]), parameter.data) and parameter.requires_grad


def test_pruning_nothing_and_everything():
    grid = random_grid()
    before = grid.density.detach().clone()
    prune(grid, np.ones(len(grid.voxels), dtype=bool))
    assert torch.equal(grid.density, before) and len(grid.voxels) == np.prod(grid.lattice.cell_shape)
    prune(grid, np.zeros(len(grid.voxels), dtype=bool))
    assert len(grid.voxels) == 0 and grid.density.shape == (0, 1)
    assert float(grid.voxel_density().abs().max()) == 0.0


def test_dense_views_are_nil_where_nothing_is_kept():
    grid = random_grid("relu", kept=0.3)
    centres, kept = grid.voxel_density(), kept_mask(grid.voxels)
    stored = torch.zeros(grid.lattice.num_corners, dtype=torch.bool)
    stored[torch.from_numpy(grid.voxels.corners)] = True
    assert float(centres[~kept].abs().max()) == 0.0
    middle = torch.as_tensor(grid.lattice.cell_centres(), dtype=torch.float32)[kept]
    torch.testing.assert_close(centres[kept], grid.density_at(grid.locate(middle)).detach(), rtol=1e-5, atol=1e-6)
    corners = grid.corner_values(grid.density.data[:, 0], fill=0.5).view(-1)
    assert torch.equal(corners[stored], grid.density.data[:, 0]) and set(corners[~stored].tolist()) == {0.5}


STEPS = [(0, 1), (0, 2), (1, 2)]


def places_of(low: int, high: int) -> torch.Tensor:
    """Columns in which the harmonics of the lower degree stand among those of the higher one."""
    few, many = num_coefficients(low), num_coefficients(high)
    return torch.tensor([channel * many + k for channel in range(3) for k in range(few)])


@pytest.mark.parametrize("low, high", STEPS)
def test_colours_stay_and_new_columns_are_nil(low, high):
    grid = two_renderers.random_grid(low, kept=0.5)
    before, old = grid.sh.detach().clone(), grid.sh
    points = torch.as_tensor(grid.lattice.cell_centres(), dtype=torch.float32)[kept_mask(grid.voxels)]
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
    narrow, places = two_renderers.random_grid(low, kept=0.5), places_of(low, high)
    wide = copy.deepcopy(narrow)
    widen_colour(wide, high)
    pair = [(grid, make([grid.sh], lr=0.1)) for grid in (narrow, wide)]
    generator = torch.Generator().manual_seed(0)
    for turn in range(6):
        if turn == 3:
            old = narrow.sh
            change = widen_colour(narrow, high)
            pair[0][1].follow(old, narrow.sh, change)
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
