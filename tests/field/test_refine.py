from __future__ import annotations

import pytest
import torch

from thermoxels_ns.errors import PruningError
from thermoxels_ns.field.refine import dilate, prune, refine
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.lattice import Lattice


def random_grid(activation="exp") -> VoxelGrid:
    torch.manual_seed(0)
    grid = VoxelGrid(Lattice((-1.0, -1.0, -0.5), 0.25, (9, 9, 5)), sh_degree=1, activation=activation)
    for parameter in grid.row_parameters().values():
        parameter.data = torch.randn_like(parameter)
    return grid


def points_inside(grid: VoxelGrid, n: int = 300) -> torch.Tensor:
    lo, hi = torch.tensor(grid.lattice.lo), torch.tensor(grid.lattice.hi)
    return lo + torch.rand(n, 3, generator=torch.Generator().manual_seed(3)) * (hi - lo)


@pytest.mark.parametrize("activation", ["relu", "exp", "softplus"])
@pytest.mark.parametrize("factor", [2, 3])
def test_refinement_changes_nothing_that_a_ray_can_see(activation, factor):
    grid = random_grid(activation)
    points, directions = points_inside(grid), torch.nn.functional.normalize(torch.randn(300, 3), dim=-1)
    at = grid.locate(points)
    before = grid.density_at(at), grid.rgb_at(at, directions), grid.thermal_at(at, directions)
    refine(grid, factor)
    assert grid.lattice.cell_shape == (8 * factor, 8 * factor, 4 * factor)
    at = grid.locate(points)
    after = grid.density_at(at), grid.rgb_at(at, directions), grid.thermal_at(at, directions)
    for old, new in zip(before, after):
        torch.testing.assert_close(old, new, atol=2e-5, rtol=2e-5)


def test_refinement_while_an_old_graph_is_alive():
    grid = random_grid()
    loss = grid.density_at(grid.locate(points_inside(grid))).sum()
    loss.backward()
    refine(grid, 2)
    fresh = grid.density_at(grid.locate(points_inside(grid))).sum()
    fresh.backward()
    assert grid.density.grad is not None and grid.density.grad.shape == grid.density.shape
    assert float(loss) == pytest.approx(float(fresh), rel=1e-5)


def test_refinement_keeps_the_children_of_kept_voxels():
    grid = random_grid()
    grid.kept[:] = False
    grid.kept[2, 3, 1] = True
    points = points_inside(grid, 3000)
    before = grid.in_kept_voxel(points)
    refine(grid, 2)
    assert int(grid.kept.sum()) == 8
    assert torch.equal(before, grid.in_kept_voxel(points)) and bool(before.any())


def test_kept_includes_the_far_face_and_nothing_outside():
    grid = random_grid()
    hi = torch.tensor([grid.lattice.hi])
    assert bool(grid.in_kept_voxel(hi)) and not bool(grid.in_kept_voxel(hi + 1e-3))
    assert not bool(grid.in_kept_voxel(torch.tensor([grid.lattice.lo]) - 1e-3))


def test_pruning_keeps_what_rays_see_and_its_neighbours():
    grid = random_grid()
    largest, total = torch.zeros(8, 8, 4), torch.zeros(8, 8, 4)
    largest[4, 4, 2], total[4, 4, 2] = 0.9, 50.0
    report = prune(grid, largest, total, threshold=0.01, dilation=1)
    assert int(grid.kept.sum()) == report.kept_voxels == 27 and report.lost_weight == 0.0
    assert bool(grid.kept[3:6, 3:6, 1:4].all())


def test_pruning_that_would_remove_the_scene_fails_and_changes_nothing():
    grid = random_grid()
    largest, total = torch.full((8, 8, 4), 0.005), torch.ones(8, 8, 4)
    largest[0, 0, 0] = 0.5
    with pytest.raises(PruningError, match=r"at most 1% of the rays' weight, got 9\d\.\d%.*--pipeline.model.prune"):
        prune(grid, largest, total, threshold=0.01)
    assert bool(grid.kept.all())


def test_pruning_without_any_weight_fails():
    grid = random_grid()
    with pytest.raises(PruningError):
        prune(grid, torch.zeros(8, 8, 4), torch.zeros(8, 8, 4), threshold=0.01)


def test_dilation_at_the_border():
    voxels = torch.zeros(4, 4, 4, dtype=torch.bool)
    voxels[0, 0, 0] = True
    assert int(dilate(voxels, 1).sum()) == 8 and int(dilate(voxels, 0).sum()) == 1


def test_checkpoint_of_a_finer_lattice_loads_into_a_coarse_grid_with_the_same_parameters():
    fine = random_grid()
    refine(fine, 2)
    fine.kept[:3] = False
    coarse = random_grid()
    density = coarse.density
    coarse.load_state_dict(fine.state_dict())
    assert coarse.density is density and coarse.lattice == fine.lattice
    assert torch.equal(coarse.density, fine.density) and torch.equal(coarse.kept, fine.kept)
    at = coarse.locate(points_inside(coarse))
    assert torch.equal(coarse.density_at(at), fine.density_at(at))


def test_a_query_without_points_gives_no_rows():
    grid = random_grid()
    at = grid.locate(torch.zeros(0, 3))
    assert grid.rgb_at(at, torch.zeros(0, 3)).shape == (0, 3) and grid.thermal_at(at, torch.zeros(0, 3)).shape == (0, 1)
