"""Which lists of rows are looked through, and that memory which others got since is not taken for them."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import torch

from tests.reference.two_renderers import random_grid, random_request
from thermoxels_ns.render import ordered_rows
from thermoxels_ns.render.ordered_rows import in_order, remember_order
from thermoxels_ns.render.ray_render import RenderOptions
from thermoxels_ns.render.renderers import fused_render
from thermoxels_ns.training.optimizers import touched_rows

FLAT = RenderOptions(sh_degree=1)


def test_lists_are_looked_through():
    assert in_order(torch.tensor([1, 2, 5])) and in_order(torch.tensor([3])) and in_order(torch.zeros(0).long())
    assert not in_order(torch.tensor([1, 5, 2])) and not in_order(torch.tensor([1, 2, 2]))


def test_a_known_list_is_recognised_until_it_is_gone():
    rows = np.array([4, 2, 2])  # not in order: the answer tells whether it was looked through
    remember_order(rows)
    tensor, address = torch.from_numpy(rows), rows.ctypes.data
    assert in_order(tensor) and in_order(tensor[None][0])
    assert not in_order(tensor[:2]) and not in_order(tensor[1:]), "another list"
    assert not in_order(tensor.clone())
    del rows
    gc.collect()
    assert in_order(tensor), "the tensor keeps its memory"
    del tensor
    gc.collect()
    assert address not in ordered_rows._known


@pytest.mark.parametrize("renders", [1, 2])
def test_gradients_of_the_renderer_are_known_and_their_sum_is_not(renders):
    """Two renders in one step: torch puts one list behind the other, which must be found and put in order."""
    grid = random_grid(1, kept=0.5)
    dense = []
    for seed in range(renders):
        request = random_request(grid, 80, seed)
        dense.append(torch.autograd.grad(fused_render(grid, request, FLAT).rgb.sum(), grid.sh)[0].to_dense())
        fused_render(grid, request, FLAT).rgb.sum().backward()
    assert not grid.sh.grad.is_coalesced()
    known = ordered_rows._known.get(grid.sh.grad._indices().data_ptr())
    assert (known is not None and len(known) == grid.sh.grad._nnz()) == (renders == 1)
    rows, values = touched_rows(grid.sh.grad)
    assert bool((rows[1:] > rows[:-1]).all())
    torch.testing.assert_close(torch.zeros_like(grid.sh).index_add(0, rows, values).detach(), sum(dense))
