"""What rays say about voxels and corners, on a slab whose answer is known; with both renderers."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle

from thermoxels_ns.field.refine import prune
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.ray_rendering import Backend, GridSamples, sample_rays
from thermoxels_ns.ray_statistics import backdrop_evidence, corner_temperature, share_of_rays_opened, voxel_weights
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions


@dataclass
class Scene:
    """A grid and the sampling that the model does with it."""

    grid: VoxelGrid
    backend: Backend

    def sample_rays(self, origins, directions) -> GridSamples:
        return sample_rays(self.grid, RayRequest(origins, directions), RenderOptions(), self.backend)


@pytest.fixture(params=["fused", "reference"])
def backend(request) -> Backend:
    return request.param


def slab(backend: Backend = "fused") -> Scene:
    """Solid for x < 0 (3 of 6 voxels), empty beyond; temperature rises along y from 0.25 to 0.75."""
    grid = VoxelGrid(Lattice.covering((-1, -1, -1), (1, 1, 1), 6), sh_degree=None, activation="relu")
    corners = torch.as_tensor(grid.lattice.corner_positions(), dtype=torch.float32).reshape(-1, 3)
    grid.density.data = torch.where(corners[:, :1] < 0.01, 500.0, 0.0)
    grid.temperature.data = 0.5 + 0.25 * corners[:, 1:2]
    return Scene(grid, backend)


def rays_along_minus_x(n: int = 40, chunk: int = 300):
    y, z = torch.meshgrid(*[torch.linspace(-0.97, 0.97, n)] * 2, indexing="ij")
    origins = torch.stack((torch.full_like(y, 3.0), y, z), -1).reshape(-1, 3)
    directions = torch.tensor([-1.0, 0.0, 0.0]).expand_as(origins)
    for start in range(0, len(origins), chunk):
        part = slice(start, start + chunk)
        yield RayBundle(origins[part], directions[part], torch.ones(len(origins[part]), 1))


def total_weight(scene) -> torch.Tensor:
    """Sum of the weights of all samples in each kept voxel."""
    total = torch.zeros(len(scene.grid.voxels))
    for bundle in rays_along_minus_x():
        samples = scene.sample_rays(bundle.origins, bundle.directions)
        total.index_add_(0, samples.at.number, samples.weight.float())
    return total


def test_weight_lies_in_the_surface_and_sums_to_the_rays(backend):
    weights, total = voxel_weights(slab(backend), rays_along_minus_x()), total_weight(slab(backend))
    assert float(total.sum()) == pytest.approx(1600, rel=1e-4)
    by_layer = total.view(6, 6, 6).sum((1, 2))
    ends = weights.ends.view(6, 6, 6)
    assert bool(ends[3].all()) and not bool(ends[:3].any()) and not bool(ends[4:].any())
    assert float(by_layer[3]) > 0.99 * 1600  # density ramps up in the first voxel beyond the last solid corner
    assert float(by_layer[:2].abs().max()) < 1e-3 and float(by_layer[4:].abs().max()) == 0.0
    assert float(weights.largest.view(6, 6, 6)[3].min()) > 0.9 and float(weights.largest.max()) <= 1.0


def test_corner_temperature_is_measured_where_rays_came_and_only_there(backend):
    scene = slab(backend)
    seen = corner_temperature(scene, rays_along_minus_x())
    shape = scene.grid.lattice.shape
    weight, thermal = seen.weight.view(shape), seen.thermal.view(shape)
    assert float(seen.weight.sum()) == pytest.approx(1600, rel=1e-4)
    assert float(weight[:2].max()) < 1e-3 and float(weight[3].min()) > 0
    inner = thermal[3, 1:-1, 1:-1]  # away from the rim a linear temperature is its own average
    expected = scene.grid.temperature.data.view(shape)[3, 1:-1, 1:-1]
    torch.testing.assert_close(inner, expected, atol=5e-3, rtol=0)


def test_corner_that_overshoots_is_brought_back_to_what_rays_saw(backend):
    scene = slab(backend)
    shape = scene.grid.lattice.shape
    stored = scene.grid.temperature.data.view(shape)
    stored[4:] = 9.0  # in front of the surface, where hardly any weight lies
    stored[3] -= 0.4
    seen = corner_temperature(scene, rays_along_minus_x())
    assert float(seen.thermal.min()) >= 0.0 and float(seen.thermal.max()) <= 1.0


def test_corners_that_differ_in_turn_are_averaged(backend):
    """Rays see a mixture of neighbours that are too warm and too cold in turn: it is the mixture that was measured."""
    scene = slab(backend)
    shape = scene.grid.lattice.shape
    index = torch.stack(torch.meshgrid(*[torch.arange(n) for n in shape], indexing="ij"), -1)
    scene.grid.temperature.data = (0.5 + 0.2 * (1 - 2 * (index.sum(-1) % 2))).reshape(-1, 1).float()
    seen = corner_temperature(scene, rays_along_minus_x())
    inner = seen.thermal.view(shape)[3:5, 1:-1, 1:-1]
    assert float((inner - 0.5).abs().max()) < 0.6 * 0.2 and float(seen.weight.view(shape)[3:5].min()) > 0


def test_what_leaks_through_a_surface_measures_nothing_behind_it(backend):
    """A first wall of optical depth 1.7 lets 18 % through to a second one, which is not measured for that."""
    scene = slab(backend)
    shape = scene.grid.lattice.shape
    density = torch.zeros(shape)
    density[4], density[1] = 5.0, 500.0  # optical depth 5 x voxel size 1/3
    scene.grid.density.data = density.reshape(-1, 1)
    leaked = total_weight(scene).view(6, 6, 6).sum((1, 2))
    assert float(leaked[:2].sum()) > 0.1 * 1600
    weight = corner_temperature(scene, rays_along_minus_x()).weight.view(shape)
    assert float(weight[:3].max()) == 0.0 and float(weight[4].min()) > 0.0


def test_rays_that_leave_the_box_are_found(backend):
    scene = slab(backend)
    scene.grid.density.data[:] = 0.0
    evidence = backdrop_evidence(scene, rays_along_minus_x())
    assert evidence.rays == 1600 and evidence.unsaturated == 1.0 and len(evidence.directions) == 1600
    assert backdrop_evidence(slab(backend), rays_along_minus_x()).unsaturated == 0.0


def test_voxels_that_are_not_kept_have_no_weight(backend):
    """Only the voxels on one side of the slab are stored: weights come one per kept voxel, in their order."""
    scene = slab(backend)
    prune(scene.grid, scene.grid.voxels.cells % 6 < 3)
    weights = voxel_weights(scene, rays_along_minus_x())
    total = total_weight(scene)
    assert weights.largest.shape == weights.ends.shape == total.shape == (108,)
    assert float(total.sum()) == pytest.approx(800, rel=1e-4)
    assert float(total.view(6, 6, 3)[3].sum()) > 0.99 * 800 and bool(weights.ends.view(6, 6, 3)[3].all())
    seen = corner_temperature(scene, rays_along_minus_x())
    assert seen.weight.shape == (scene.grid.voxels.num_rows,) and float(seen.weight.sum()) == pytest.approx(
        800, rel=1e-4
    )


def test_rays_are_opened_by_the_loss_of_what_they_end_on_alone(backend):
    scene = slab(backend)
    layer = torch.arange(216) // 36
    for keep, expected in (
        (layer >= 0, 0.0),
        (layer != 3, 1.0),
        (layer == 3, 0.0),
        ((layer != 3) | (torch.arange(216) % 6 < 3), 0.5),
    ):
        assert share_of_rays_opened(scene, rays_along_minus_x(), keep) == pytest.approx(expected, abs=0.02)
    scene.grid.density.data[:] = 0.05  # fog that no ray ends in
    assert share_of_rays_opened(scene, rays_along_minus_x(), layer < 0) == 0.0
