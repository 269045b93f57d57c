"""Cases that break naive volume rendering; those that both renderers can be asked are in tests/reference."""

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render.compositing import ray_weights, sample_box

LO, HI = torch.tensor([-1.0, -1.0, -1.0]), torch.tensor([1.0, 1.0, 1.0])


def test_infinite_density_over_a_step_of_no_length_has_no_weight():
    along = ray_weights(torch.tensor([[float("inf"), 1.0]]), torch.tensor([[0.0, 0.1]]))
    assert float(along.weights[0, 0]) == 0.0
    assert float(along.weights[0, 1]) == pytest.approx(-np.expm1(-0.1))


def test_grazing_an_edge_is_a_miss_of_no_length():
    origin, direction = torch.tensor([[-2.0, 0.0, 0.0]]), normalize(torch.tensor([[1.0, 1.0, 0.0]]), dim=-1)
    steps = sample_box(origin, direction, LO, HI, step=0.1)
    assert float(steps.deltas.sum()) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("activation", ["relu", "softplus", "exp"])
def test_activations_stay_finite_for_any_stored_value(activation):
    grid = VoxelGrid(Lattice((0.0, 0.0, 0.0), 1.0, (2, 2, 2)), sh_degree=None, activation=activation)
    for value in (-1e30, -100.0, 0.0, 100.0, 1e30):
        grid.density.data.fill_(value)
        density = grid.density_at(grid.locate(torch.full((3, 3), 0.5)))
        assert (density >= 0).all() and torch.isfinite(density).all()
        density.sum().backward()
        assert grid.density.grad is not None and torch.isfinite(grid.density.grad).all()
