"""The plain renderer against the paper's sums, sample by sample in Python floats, and where naive ones break."""

import math

import pytest
import torch

from tests.reference.two_renderers import as_double, in_double, random_grid, random_request
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render import reference
from thermoxels_ns.render.ray_render import RenderOptions


def test_renders_are_the_sums_of_the_paper():
    """Eq. 1 and 2 with all voxels kept: colour, temperature, opacity, expected distance."""
    grid = as_double(random_grid(1, 1, "exp", density=0.0))
    rays = in_double(random_request(grid, 12, mixed=False))
    seen = reference.render(grid, rays, RenderOptions())
    marched = reference.march(grid, rays, RenderOptions())
    distances, deltas = marched.t, marched.deltas
    assert seen.rgb is not None and int((seen.accumulation > 0.1).sum()) > 6
    for r in range(12):
        real = deltas[r] > 0
        points = rays.origins[r] + distances[r][real][:, None] * rays.directions[r]
        at, along = grid.locate(points), rays.directions[r].expand_as(points)
        rows = torch.cat((grid.rgb_at(at, along), grid.thermal_at(at, along)), 1).tolist()
        left, total, distance = 1.0, [0.0] * 4, 0.0
        columns = grid.density_at(at), deltas[r][real], distances[r][real]
        for density, delta, t, row in zip(*(column.tolist() for column in columns), rows):
            weight = left * -math.expm1(-density * delta)
            total = [c + weight * v for c, v in zip(total, row)]
            distance += weight * t
            left *= math.exp(-density * delta)
        assert [*seen.rgb[r].tolist(), float(seen.thermal[r])] == pytest.approx(total, abs=1e-12)
        assert float(seen.transmittance[r]) == pytest.approx(left, rel=1e-10)
        assert float(seen.accumulation[r]) == pytest.approx(1.0 - left, abs=1e-12)
        if left < 1.0:
            assert float(seen.depth[r]) == pytest.approx(distance / (1.0 - left), rel=1e-9)


@pytest.mark.parametrize("activation", ["relu", "softplus", "exp"])
def test_activations_stay_finite_for_any_stored_value(activation):
    grid = VoxelGrid(Lattice((0.0, 0.0, 0.0), 1.0, (2, 2, 2)), sh_degree=None, activation=activation)
    for value in (-1e30, -100.0, 0.0, 100.0, 1e30):
        grid.density.data.fill_(value)
        density = grid.density_at(grid.locate(torch.full((3, 3), 0.5)))
        assert (density >= 0).all() and torch.isfinite(density).all()
        density.sum().backward()
        assert grid.density.grad is not None and torch.isfinite(grid.density.grad).all()
