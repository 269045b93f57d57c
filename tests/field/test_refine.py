import numpy as np
import pytest
import torch

from tests.reference import two_renderers
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.refine import prune, refine, split_voxels
from thermoxels_ns.field.voxel_grid import VoxelGrid


def random_grid(activation="exp", kept: float = 1.0, temperature_degree: int = 0) -> VoxelGrid:
    return two_renderers.random_grid(
        1, temperature_degree, activation, kept, Lattice((-1.0, -1.0, -0.5), 0.25, (9, 9, 5))
    )


def points_inside(grid: VoxelGrid, n: int = 300) -> torch.Tensor:
    lo, hi = torch.tensor(grid.lattice.lo), torch.tensor(grid.lattice.hi)
    return lo + torch.rand(n, 3, generator=torch.Generator().manual_seed(3)) * (hi - lo)


def values_at(grid: VoxelGrid, points: torch.Tensor):
    directions = torch.nn.functional.normalize(points + 3.0, dim=-1)
    at = grid.locate(points)
    return grid.density_at(at), grid.rgb_at(at, directions), grid.thermal_at(at, directions)


@pytest.mark.parametrize("activation", ["relu", "exp", "softplus"])
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
    expected = voxels.mask()
    for axis in range(3):
        expected = expected.repeat(factor, axis)
    fine = split_voxels(voxels, factor)
    np.testing.assert_array_equal(fine.mask(), expected)
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
    assert torch.equal(grid.density, before) and grid.voxels.all_kept
    prune(grid, np.zeros(len(grid.voxels), dtype=bool))
    assert len(grid.voxels) == 0 and grid.density.shape == (0, 1) and not bool(grid.kept.any())
    assert float(grid.voxel_density().abs().max()) == 0.0


def test_dense_views_are_nil_where_nothing_is_kept():
    grid = random_grid("relu", kept=0.3)
    corners, centres = grid.corner_density(), grid.voxel_density()
    stored = torch.zeros(grid.lattice.num_corners, dtype=torch.bool)
    stored[torch.from_numpy(grid.voxels.corners)] = True
    assert float(corners.view(-1)[~stored].abs().max()) == 0.0 and int((~stored).sum()) > 0
    torch.testing.assert_close(corners.view(-1)[stored], grid.density.data[:, 0].clamp(min=0))
    assert float(centres[~grid.kept].abs().max()) == 0.0
    middle = torch.as_tensor(grid.lattice.cell_centres(), dtype=torch.float32)[grid.kept]
    torch.testing.assert_close(centres[grid.kept], grid.density_at(grid.locate(middle)).detach(), rtol=1e-5, atol=1e-6)
    assert float(grid.corner_values(grid.density.data[:, 0], fill=0.5).view(-1)[~stored].min()) == 0.5
