"""What rays say about voxels and corners, on a slab whose answer is known."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle

from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.ray_statistics import backdrop_evidence, corner_temperature, voxel_weights
from thermoxels_ns.render.march import March, march


@dataclass
class Scene:
    """A grid and the marching the model does with it."""

    grid: VoxelGrid

    def march_rays(self, origins, directions) -> March:
        return march(origins, directions, self.grid.lattice, lambda p: self.grid.density_at(self.grid.locate(p)))


def slab() -> Scene:
    """Solid for x < 0 (3 of 6 voxels), empty beyond; temperature rises along y from 0.25 to 0.75."""
    grid = VoxelGrid(Lattice.covering((-1, -1, -1), (1, 1, 1), 6), sh_degree=None, activation="relu")
    corners = torch.as_tensor(grid.lattice.corner_positions(), dtype=torch.float32).reshape(-1, 3)
    grid.density.data = torch.where(corners[:, :1] < 0.01, 500.0, 0.0)
    grid.temperature.data = 0.5 + 0.25 * corners[:, 1:2]
    return Scene(grid)


def rays_along_minus_x(n: int = 40, chunk: int = 300):
    y, z = torch.meshgrid(*[torch.linspace(-0.97, 0.97, n)] * 2, indexing="ij")
    origins = torch.stack((torch.full_like(y, 3.0), y, z), -1).reshape(-1, 3)
    directions = torch.tensor([-1.0, 0.0, 0.0]).expand_as(origins)
    for start in range(0, len(origins), chunk):
        part = slice(start, start + chunk)
        yield RayBundle(origins[part], directions[part], torch.ones(len(origins[part]), 1))


def test_weight_lies_in_the_surface_and_sums_to_the_rays():
    weights = voxel_weights(slab(), rays_along_minus_x())
    assert float(weights.total.sum()) == pytest.approx(1600, rel=1e-4)
    by_layer = weights.total.sum((1, 2))
    assert float(by_layer[3]) > 0.99 * 1600  # density ramps up in the first voxel beyond the last solid corner
    assert float(by_layer[:2].abs().max()) < 1e-3 and float(by_layer[4:].abs().max()) == 0.0
    assert float(weights.largest[3].min()) > 0.9 and float(weights.largest.max()) <= 1.0


def test_corner_temperature_is_measured_where_rays_came_and_only_there():
    scene = slab()
    seen = corner_temperature(scene, rays_along_minus_x())
    shape = scene.grid.lattice.shape
    weight, thermal = seen.weight.view(shape), seen.thermal.view(shape)
    assert float(seen.weight.sum()) == pytest.approx(1600, rel=1e-4)
    assert float(weight[:2].max()) < 1e-3 and float(weight[3].min()) > 0
    inner = thermal[3, 1:-1, 1:-1]  # away from the rim a linear temperature is its own average
    expected = scene.grid.temperature.data.view(shape)[3, 1:-1, 1:-1]
    torch.testing.assert_close(inner, expected, atol=5e-3, rtol=0)


def test_corner_that_overshoots_is_brought_back_to_what_rays_saw():
    scene = slab()
    shape = scene.grid.lattice.shape
    stored = scene.grid.temperature.data.view(shape)
    stored[4:] = 9.0  # in front of the surface, where hardly any weight lies
    stored[3] -= 0.4
    seen = corner_temperature(scene, rays_along_minus_x())
    assert float(seen.thermal.min()) >= 0.0 and float(seen.thermal.max()) <= 1.0


def test_what_leaks_through_a_surface_measures_nothing_behind_it():
    """A first wall of optical depth 1.7 lets 18 % through to a second one, which is not measured for that."""
    scene = slab()
    shape = scene.grid.lattice.shape
    density = torch.zeros(shape)
    density[4], density[1] = 5.0, 500.0  # optical depth 5 x voxel size 1/3
    scene.grid.density.data = density.reshape(-1, 1)
    leaked = voxel_weights(scene, rays_along_minus_x()).total.sum((1, 2))
    assert float(leaked[:2].sum()) > 0.1 * 1600
    weight = corner_temperature(scene, rays_along_minus_x()).weight.view(shape)
    assert float(weight[:3].max()) == 0.0 and float(weight[4].min()) > 0.0


def test_rays_that_leave_the_box_are_found():
    scene = slab()
    scene.grid.density.data[:] = 0.0
    evidence = backdrop_evidence(scene, rays_along_minus_x())
    assert evidence.rays == 1600 and evidence.unsaturated == 1.0 and len(evidence.directions) == 1600
    assert backdrop_evidence(slab(), rays_along_minus_x()).unsaturated == 0.0
