import math
from typing import NamedTuple

import numpy as np
import pytest
import torch

from tests.support.short_training import rays_along_minus_x
from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.refine import prune
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import Backend, sample_rays
from thermoxels_ns.training.ray_statistics import Sampler, backdrop_evidence, field_evidence, voxel_weights


class Scene(NamedTuple):
    """A grid and the sampling that the model does with it."""

    grid: VoxelGrid
    sample_rays: Sampler


def sampled(grid: VoxelGrid, backend: Backend) -> Scene:
    return Scene(grid, lambda *rays: sample_rays(grid, RayRequest(*rays), RenderOptions(), backend))


@pytest.fixture(params=["fused", "reference"])
def backend(request) -> Backend:
    return request.param


def slab(backend: Backend = "fused") -> Scene:
    """Solid for x < 0 (3 of 6 voxels), empty beyond; temperature rises along y from 0.25 to 0.75."""
    grid = VoxelGrid(Lattice.covering((-1, -1, -1), (1, 1, 1), 6), sh_degree=None, activation="relu")
    corners = torch.as_tensor(grid.lattice.corner_positions(), dtype=torch.float32).reshape(-1, 3)
    grid.density.data = torch.where(corners[:, :1] < 0.01, 500.0, 0.0)
    grid.temperature.data = 0.5 + 0.25 * corners[:, 1:2]
    return sampled(grid, backend)


def total_weight(scene) -> torch.Tensor:
    """Sum of the weights of all samples in each kept voxel."""
    total = torch.zeros(len(scene.grid.voxels))
    for bundle in rays_along_minus_x():
        samples = scene.sample_rays(bundle.origins, bundle.directions)
        total.index_add_(0, samples.at.number, samples.weight.float())
    return total


def test_weight_lies_in_the_surface_and_sums_to_the_rays(backend):
    """Of the kept voxels alone, in their order: those on one side of the slab are stored."""
    scene = slab(backend)
    prune(scene.grid, scene.grid.voxels.cells % 6 < 3)
    (largest, ends), total = voxel_weights(*scene, rays_along_minus_x()), total_weight(scene)
    assert largest.shape == ends.shape == total.shape == (108,)
    by_layer, ends = total.view(6, 18).sum(1), ends.view(6, 18)
    assert bool(ends[3].all()) and not bool(ends[:3].any()) and not bool(ends[4:].any())
    # Density ramps up in the first voxel beyond the last solid corner.
    assert float(total.sum()) == pytest.approx(800, rel=1e-4) and float(by_layer[3]) > 0.99 * 800
    assert float(largest.view(6, 18)[3].min()) > 0.9 and float(largest.max()) <= 1.0


def test_corner_temperature_is_measured_where_rays_came_and_only_there(backend):
    scene = slab(backend)
    shape = scene.grid.lattice.shape
    thermal, weight = (values.view(shape) for values in field_evidence(*scene, rays_along_minus_x())[:2])
    assert float(weight.sum()) == pytest.approx(1600, rel=1e-4)
    assert float(weight[:2].max()) < 1e-3 and float(weight[3].min()) > 0
    inner = thermal[3, 1:-1, 1:-1]  # away from the rim a linear temperature is its own average
    expected = scene.grid.temperature.data.view(shape)[3, 1:-1, 1:-1]
    torch.testing.assert_close(inner, expected, atol=5e-3, rtol=0)


def test_corners_that_differ_in_turn_are_averaged(backend):
    """Rays see a mixture of neighbours that are too warm and too cold in turn: it is the mixture that was measured."""
    scene = slab(backend)
    shape = scene.grid.lattice.shape
    index = torch.stack(torch.meshgrid(*[torch.arange(n) for n in shape], indexing="ij"), -1)
    scene.grid.temperature.data = (0.5 + 0.2 * (1 - 2 * (index.sum(-1) % 2))).reshape(-1, 1).float()
    thermal, weight, _ = field_evidence(*scene, rays_along_minus_x())
    inner = thermal.view(shape)[3:5, 1:-1, 1:-1]
    assert float((inner - 0.5).abs().max()) < 0.6 * 0.2 and float(weight.view(shape)[3:5].min()) > 0


def test_what_leaks_through_a_surface_measures_nothing_and_ends_nothing_behind_it(backend):
    """A first wall of optical depth 2.3 lets 10 % through to a second one, in which no ray ends."""
    scene = slab(backend)
    layers(scene, {4: -3 * math.log(0.1), 1: 500.0, 0: 500.0})
    _, weight, evidence = field_evidence(*scene, rays_along_minus_x())
    assert len(evidence.ends) == 1600 and 3.0 < evidence.ends[:, 0].min() <= evidence.ends[:, 0].max() < 5.0
    np.testing.assert_array_equal(evidence.directions, np.broadcast_to([-1.0, 0.0, 0.0], (1600, 3)))
    across = torch.cat([bundle.origins[:, 1:] for bundle in rays_along_minus_x()])
    np.testing.assert_allclose(evidence.ends[:, 1:], 3.0 * (across.numpy() + 1.0), atol=1e-4, rtol=0)
    weight = weight.view(7, 7, 7)
    assert float(weight[:3].max()) == 0.0 and float(weight[4].min()) > 0.0


def test_rays_that_leave_the_box_are_found(backend):
    scene = slab(backend)
    scene.grid.density.data[:] = 0.0
    unsaturated, directions = backdrop_evidence(*scene, rays_along_minus_x())
    assert unsaturated == 1.0 and len(directions) == 1600
    assert backdrop_evidence(*slab(backend), rays_along_minus_x())[0] == 0.0


def layers(scene: Scene, density: dict[int, float]) -> None:
    """Give whole layers of corners along x a density, all others none."""
    values = torch.zeros(scene.grid.lattice.shape)
    for layer, value in density.items():
        values[layer] = value
    scene.grid.density.data = values.reshape(-1, 1)


@pytest.mark.parametrize(
    ("let_through", "wall", "found"), [(2 / 3, 500.0, 250.0), (1 / 3, 500.0, None), (0.1, -3e3 * math.log(0.1), None)]
)
def test_half_depth_lies_behind_a_thin_veil_alone(backend, let_through, wall, found):
    """A veil that takes a third leaves the half to the wall behind it; one that takes two thirds does not, nor does
    one that takes 90 % before a wall a thousand times as dense, two voxels behind it."""
    scene, veil = slab(backend), -3 * math.log(let_through)
    layers(scene, {4: veil, 1: wall, 0: wall})
    density = field_evidence(*scene, rays_along_minus_x())[2].half_depth_density
    torch.testing.assert_close(torch.from_numpy(density), torch.full((1600,), found or veil / 2))


def test_rays_that_end_on_nothing_have_no_half_depth(backend):
    scene = slab(backend)
    layers(scene, {2: -3 * math.log(0.55)})
    _, weight, evidence = field_evidence(*scene, rays_along_minus_x())
    assert len(evidence.half_depth_density) == 0
    assert float(weight.max()) == 0.0


def test_rays_of_photographs_are_evidence_but_measure_no_temperature(backend):
    scene = slab(backend)

    def bundles(bits):
        for number, bundle in enumerate(rays_along_minus_x()):
            bundle.metadata["stream"] = torch.full((len(bundle), 1), bits(number), dtype=torch.uint8)
            yield bundle

    stored, weight, colour = field_evidence(*scene, bundles(lambda _: RGB_STREAM))
    assert float(weight.max()) == 0.0 and len(colour.half_depth_density) == 1600
    assert torch.equal(stored, scene.grid.temperature.data[:, 0].clamp(0, 1))
    # The first three of six bundles carry both streams.
    half = field_evidence(*scene, bundles(lambda number: RGB_STREAM | THERMAL_STREAM if number < 3 else RGB_STREAM))
    thermal = field_evidence(*scene, [b for n, b in enumerate(rays_along_minus_x()) if n < 3])
    assert torch.equal(half[0], thermal[0]) and torch.equal(half[1], thermal[1])
    np.testing.assert_array_equal(half[2].ends, colour.ends)


def behind_plane(place: float, backend: Backend) -> Scene:
    """Solid for x < `place`, as sharp as a density that is interpolated before its exponential can be."""
    grid = VoxelGrid(Lattice.covering((-1, -1, -1), (1, 1, 1), 8), sh_degree=None, activation="exp")
    corners = torch.as_tensor(grid.lattice.corner_positions(), dtype=torch.float32).reshape(-1, 3)
    grid.density.data = 60.0 * (place - corners[:, :1]) / 0.25
    return sampled(grid, backend)


@pytest.mark.parametrize("place", [0.02, 0.06, 0.1, 0.16, 0.19, 0.23])
def test_rays_meet_the_solid_wherever_in_a_voxel_a_sharp_surface_lies(backend, place):
    """The voxel between x = 0 and 0.25 is empty at its centre if the surface lies before 0.125."""
    scene = behind_plane(place, backend)
    evidence = field_evidence(*scene, rays_along_minus_x())[2]
    centre = scene.grid.voxel_density()
    assert len(evidence.half_depth_density) == 1600
    assert bool((centre[4] > 1e3).all()) == (place > 0.125)
    assert float(evidence.half_depth_density.min()) > 1e3 and float(centre[5:].max()) < 1.0
