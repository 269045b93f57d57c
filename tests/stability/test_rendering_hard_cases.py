"""Cases that break naive volume rendering: extreme densities, grazing and axis-parallel rays, cameras inside."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.refine import prune
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.compositing import composite, intersect_box, ray_weights, sample_box
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import reference_march

LO, HI = torch.tensor([-1.0, -1.0, -1.0]), torch.tensor([1.0, 1.0, 1.0])


@pytest.mark.parametrize("sigma", [1e4, 1e30, float("inf")])
def test_huge_density_is_opaque_with_finite_gradients(sigma):
    density = torch.zeros(1, 8)
    density[0, 3] = sigma
    density.requires_grad_()
    along = ray_weights(density, torch.full((1, 8), 0.05))
    assert torch.isfinite(along.weights).all()
    assert float(along.weights.detach().sum()) <= 1.0
    assert float(along.weights[0, 3].detach()) == 1.0
    assert float(along.accumulation.detach()) == 1.0 and float(along.transmittance.detach()) < 1e-30
    along.weights.sum().backward()
    assert density.grad is not None and torch.isfinite(density.grad).all()


def test_infinite_density_over_a_step_of_no_length_has_no_weight():
    along = ray_weights(torch.tensor([[float("inf"), 1.0]]), torch.tensor([[0.0, 0.1]]))
    assert float(along.weights[0, 0]) == 0.0
    assert float(along.weights[0, 1]) == pytest.approx(-np.expm1(-0.1))


def test_nan_density_is_refused_not_made_transparent():
    with pytest.raises(ThermoxelsError, match="1 NaN"):
        ray_weights(torch.tensor([[1.0, float("nan")]]), torch.full((1, 2), 0.1))


def test_transmittance_keeps_its_digits_behind_an_opaque_sample():
    density = torch.full((1, 512), 0.3, dtype=torch.float64)
    density[0, 0] = 300.0
    deltas = torch.full_like(density, 0.1)
    exact, single = ray_weights(density, deltas), ray_weights(density.float(), deltas.float())
    assert 0 < float(exact.weights[0, 1]) < 1e-13
    error = (single.weights.double() - exact.weights).abs() / exact.weights
    assert float(error.max()) < 1e-4


def test_vanishing_density_keeps_value_and_gradient():
    density = torch.full((1, 4), 1e-8, requires_grad=True)
    along = ray_weights(density, torch.full((1, 4), 0.5))
    torch.testing.assert_close(along.weights, torch.full((1, 4), 5e-9), rtol=1e-6, atol=0)
    assert float(along.accumulation.detach()) == pytest.approx(2e-8, rel=1e-6)
    along.weights.sum().backward()
    assert density.grad is not None
    torch.testing.assert_close(density.grad, torch.full((1, 4), 0.5), rtol=1e-6, atol=0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("slope", [0.0, 1e-7, -1e-7, 1e-6, -1e-6, 1e-30, -1e-30, 1e-42])
def test_axis_parallel_rays(axis, slope):
    """d in {0, +-1e-6, +-1e-7}: no sign flips, no infinities; the chord is 2 for all."""
    direction = torch.zeros(3)
    direction[axis], direction[(axis + 1) % 3] = 1.0, slope
    origin = torch.zeros(3)
    origin[axis], origin[(axis + 2) % 3] = -4.0, 0.5
    enter, leave, hit = intersect_box(origin[None], normalize(direction[None], dim=-1), LO, HI)
    assert bool(hit) and float(enter) == pytest.approx(3.0) and float(leave) == pytest.approx(5.0)


@pytest.mark.parametrize("offset, expected", [(1.0, True), (1.0 + 1e-6, False), (-1.0, True), (1.5, False)])
def test_parallel_ray_on_a_face_hits_just_outside_it_misses(offset, expected):
    origin = torch.tensor([[-4.0, offset, 0.0]], dtype=torch.float64)
    *_, hit = intersect_box(origin, torch.tensor([[1.0, 0.0, 0.0]]).double(), LO.double(), HI.double())
    assert bool(hit) is expected


@pytest.mark.parametrize("corner", [(1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (1.0, 1.0, 1.0)])
def test_camera_on_a_face_an_edge_and_a_corner(corner):
    origin = torch.tensor([corner])
    inward, outward = normalize(-torch.ones(1, 3), dim=-1), normalize(torch.ones(1, 3), dim=-1)
    enter, leave, hit = intersect_box(origin, inward, LO, HI)
    assert bool(hit) and float(enter) == 0.0 and float(leave) > 0.1
    assert not bool(intersect_box(origin, outward, LO, HI)[2])


def test_camera_inside_starts_at_itself_and_a_box_behind_is_missed():
    origins = torch.tensor([[0.2, 0.0, 0.0], [3.0, 0.0, 0.0]])
    enter, leave, hit = intersect_box(origins, torch.tensor([[1.0, 0.0, 0.0]]).expand(2, 3), LO, HI)
    assert enter[0] == 0 and float(leave[0]) == pytest.approx(0.8)
    assert hit.tolist() == [True, False]


def test_grazing_an_edge_is_a_miss_of_no_length():
    origin, direction = torch.tensor([[-2.0, 0.0, 0.0]]), normalize(torch.tensor([[1.0, 1.0, 0.0]]), dim=-1)
    steps = sample_box(origin, direction, LO, HI, step=0.1)
    assert float(steps.deltas.sum()) == pytest.approx(0.0, abs=1e-6)


def test_miss_is_exactly_the_background_with_depth_infinite():
    grid = VoxelGrid(Lattice((-1.0, -1.0, -1.0), 0.5, (5, 5, 5)), start_density=50.0)
    origins, directions = torch.tensor([[0.0, 0.0, 5.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    marched = reference_march(grid, RayRequest(origins, directions), RenderOptions())
    background = torch.tensor([0.125, 0.5, 0.75])
    seen = composite(
        marched.steps,
        marched.along,
        lambda flat: torch.ones(len(flat), 3),
        lambda flat: torch.ones(len(flat), 1),
        background_rgb=background,
        background_thermal=torch.tensor([0.25]),
    )
    assert torch.equal(seen.rgb[0], background) and float(seen.thermal) == 0.25  # type: ignore[index,arg-type]
    assert float(seen.accumulation) == 0.0 and torch.isinf(seen.depth).all()


def wall(angle_deg: float, resolution: int = 32):
    """A wall one voxel thick through the middle of the box, turned about z; densities at corners, relu."""
    lattice = Lattice.covering((-1, -1, -1), (1, 1, 1), resolution)
    grid = VoxelGrid(lattice, sh_degree=None, activation="relu")
    normal = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg)), 0.0])
    distance = np.abs(lattice.corner_positions() @ normal) / lattice.voxel_size
    density = np.where(distance <= 0.75, 600.0, 0.0)
    grid.density.data = torch.tensor(density.reshape(-1, 1), dtype=torch.float32)
    return grid, torch.tensor(normal, dtype=torch.float32)


@pytest.mark.parametrize("angle", [0.0, 30.0, 45.0])
def test_wall_one_voxel_thick_is_opaque_from_both_sides(angle):
    grid, normal = wall(angle)
    side = torch.tensor([-float(normal[1]), float(normal[0]), 0.0])
    offsets = torch.linspace(-0.5, 0.5, 101)[:, None]
    for sign in (1.0, -1.0):
        origins = sign * 3.0 * normal + offsets * side + torch.tensor([0.0, 0.0, 0.137])
        directions = (-sign * normal).expand(101, 3)
        marched = reference_march(grid, RayRequest(origins, directions), RenderOptions())
        assert float(marched.along.accumulation.min()) > 0.99


def test_constant_temperature_renders_constant_wherever_it_hits_after_pruning():
    """Pruned neighbours must not leak their values into what is kept."""
    grid, _ = wall(0.0)
    middle = grid.kept.shape[0] // 2
    keep = grid.kept.numpy()
    keep[: middle - 1], keep[middle + 1 :] = False, False
    grid.temperature.data[:] = 0.0
    grid.temperature.data.view(*grid.lattice.shape)[middle - 1 : middle + 2] = 0.4
    prune(grid, keep.reshape(-1))
    assert bool((grid.temperature == 0.4).all()) and len(grid.voxels) == 2 * 32 * 32
    origins = torch.tensor([[3.0, 0.1, 0.2], [2.0, -2.0, 0.3]])
    directions = normalize(torch.tensor([[-1.0, 0.01, 0.02], [-1.0, 1.0, 0.0]]), dim=-1)
    marched = reference_march(grid, RayRequest(origins, directions), RenderOptions())
    at = grid.locate(marched.positions)
    seen = composite(
        marched.steps,
        marched.along,
        None,
        lambda flat: grid.thermal_at(at.select(marched.active_index(flat)), directions[marched.rays_of(flat)]),
    )
    assert seen.thermal is not None
    torch.testing.assert_close(seen.thermal[:, 0] / seen.accumulation, torch.full((2,), 0.4), rtol=1e-6, atol=0)
    assert float(seen.accumulation.min()) > 0.99


@pytest.mark.parametrize("activation", ["relu", "softplus", "exp"])
def test_activations_stay_finite_for_any_stored_value(activation):
    grid = VoxelGrid(Lattice((0.0, 0.0, 0.0), 1.0, (2, 2, 2)), sh_degree=None, activation=activation)
    for value in (-1e30, -100.0, 0.0, 100.0, 1e30):
        grid.density.data.fill_(value)
        density = grid.density_at(grid.locate(torch.full((3, 3), 0.5)))
        assert (density >= 0).all() and torch.isfinite(density).all()
        density.sum().backward()
        assert grid.density.grad is not None and torch.isfinite(grid.density.grad).all()
