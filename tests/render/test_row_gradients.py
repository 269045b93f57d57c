"""Sums over rows: the order of samples, and that no split of the rows changes a sum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.reference.two_renderers import (
    EVERYTHING,
    as_double,
    assert_same,
    in_double,
    random_grid,
    random_request,
    see,
)
from thermoxels_ns.core.threads import num_threads, set_num_threads
from thermoxels_ns.render import fused, row_gradients
from thermoxels_ns.render.kernels import AHEAD, Records
from thermoxels_ns.render.kernels_rows import Order, first_voxel, order_records
from thermoxels_ns.render.ray_render import RenderOptions
from thermoxels_ns.render.renderers import fused_render
from thermoxels_ns.training.optimizers import touched_rows


@pytest.fixture
def three_threads():
    before = num_threads()
    set_num_threads(3)
    yield
    set_num_threads(before)


def records_with(offset, used, number, uses) -> Records:
    total = len(number)
    nothing = np.zeros(total, np.float32)
    return Records(
        np.array(offset),
        np.array(used),
        np.array(number, np.int32),
        np.zeros(total, np.int32),
        np.zeros((total, 3), np.float32),
        nothing,
        nothing,
        nothing,
        np.zeros((total, 3), np.float32),
        nothing,
        np.array(uses, np.uint8),
    )


@pytest.mark.parametrize(
    ("shift", "record", "group"),
    [(0, [5, 0, 1, 4], [0, 1, 2, 3, 3, 4]), (1, [0, 5, 1, 4], [0, 2, 3, 4])],
    ids=["one voxel a group", "two voxels a group"],
)
def test_records_are_ordered_by_group_then_by_ray(shift, record, group):
    # Ray 0 has records 0 to 1, ray 1 has 4 to 6; record 3 is a gap, 6 has no gradient.
    records = records_with([0, 4], [2, 3], [1, 2, 9, 9, 4, 0, 3], [1, 2, 7, 7, 4, 1, 0])
    order = Order(shift, np.zeros(len(group), np.int64), np.full(4, -1, np.int32), np.full(4, -1, np.int32))
    order_records(records, order)
    assert order.record.tolist() == record and order.group.tolist() == group
    assert order.ray.tolist() == [0 if n < 2 else 1 for n in record]


def test_first_voxel_is_a_binary_search():
    rows = np.array([[0, 2, 5, 7], [1, 3, 6, 8], [4, 6, 9, 11]], np.int32)
    for corner in range(4):
        for row in range(-1, 13):
            assert first_voxel(rows, corner, row) == int(np.searchsorted(rows[:, corner], row))


@pytest.mark.usefixtures("three_threads")
@pytest.mark.parametrize("kept", [1.0, 0.4], ids=["dense", "sparse"])
@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("ranges", [1, 30, 400])
def test_any_number_of_row_ranges_gives_the_reference_s_sums(monkeypatch, ranges, degree, kept):
    """Ranges of a few rows cut through voxels, blocks of total variation and groups of samples."""
    monkeypatch.setattr(row_gradients, "RANGES_PER_THREAD", ranges)
    grid = as_double(random_grid(2, 1, "exp", kept, density=0.0))
    request, count = in_double(random_request(grid)), len(grid.voxels)
    blocks = {"density": (3, count), "sh": (count // 3, count // 2), "temperature": (0, 1)}
    options = replace(EVERYTHING, variation=blocks, sh_degree=degree)
    reference = see("reference", grid, request, options)
    assert_same(see("fused", grid, request, options), reference, 1e-11, 1e-11)
    assert all(float(g.norm()) > 0 for g in reference.gradients.values())


def test_rows_of_total_variation_alone_have_a_gradient_and_no_others():
    grid = random_grid(2, kept=0.4)
    first, last = 50, 60
    options = fused.RenderOptions(variation={"sh": (first, last)})
    fused_render_variation(grid, options).backward()
    corners = grid.voxels.voxel_rows[first:last]
    expected = np.unique(np.concatenate((corners[:, 0], corners[:, 0] + 1, corners[:, 1], corners[:, 2])))
    assert grid.sh.grad._indices()[0].tolist() == expected.tolist()
    assert grid.density.grad is None and grid.temperature.grad is None


def fused_render_variation(grid, options) -> torch.Tensor:
    return fused_render(grid, random_request(grid, 10), options).variation["sh"]


@pytest.mark.usefixtures("three_threads")
def test_a_batch_that_needs_more_room_than_the_last_one_is_complete(monkeypatch):
    """Fewer places than samples at first: the render is repeated with room for all, and nothing is lost."""
    grid = random_grid(1, density=-3.0)
    request = random_request(grid, 500)
    expected = see("fused", grid, request)
    for room in (1, AHEAD):
        monkeypatch.setitem(fused._room, len(grid.density), room)
        found = see("fused", grid, request)
        assert fused._room[len(grid.density)] > room
        assert all(torch.equal(found.gradients[name], value) for name, value in expected.gradients.items())
        assert all(torch.equal(found.values[name], value) for name, value in expected.values.items())


@pytest.mark.parametrize("renders", [1, 2])
def test_gradients_of_renders_in_one_step_are_summed_in_the_order_of_rows(renders):
    """Torch puts one list of rows behind the other, which the optimisers must find and put in order."""
    grid, flat = random_grid(1, kept=0.5), RenderOptions(sh_degree=1)
    dense = []
    for seed in range(renders):
        request = random_request(grid, 80, seed)
        dense.append(torch.autograd.grad(fused_render(grid, request, flat).rgb.sum(), grid.sh)[0].to_dense())
        fused_render(grid, request, flat).rgb.sum().backward()
    assert not grid.sh.grad.is_coalesced()
    rows, values = touched_rows(grid.sh.grad)
    assert bool((rows[1:] > rows[:-1]).all())
    torch.testing.assert_close(torch.zeros_like(grid.sh).index_add(0, rows, values).detach(), sum(dense))
