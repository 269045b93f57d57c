"""Sums over rows: no split of the rows changes a sum."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import njit

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
from thermoxels_ns.render import fused
from thermoxels_ns.render.kernels import AHEAD, prefetch


@pytest.fixture
def three_threads():
    before = num_threads()
    set_num_threads(3)
    yield
    set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
@pytest.mark.parametrize("kept", [1.0, 0.4], ids=["dense", "sparse"])
@pytest.mark.parametrize("ranges", [1, 30, 400])
def test_any_number_of_row_ranges_gives_the_reference_s_sums(monkeypatch, ranges, kept):
    """Ranges of a few rows cut through voxels, blocks of total variation and groups of samples."""
    monkeypatch.setattr(fused, "RANGES_PER_THREAD", ranges)
    grid = as_double(random_grid(2, 1, "exp", kept, density=0.0))
    request, count = in_double(random_request(grid)), len(grid.voxels)
    blocks = {"density": (3, count), "sh": (count // 3, count // 2), "temperature": (0, 1)}
    options = replace(EVERYTHING, variation=blocks)
    reference = see("reference", grid, request, options)
    assert_same(see("fused", grid, request, options), reference, 1e-11, 1e-11)
    assert all(float(g.norm()) > 0 for g in reference.gradients.values())


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


def test_hint_is_compiled_in():
    """A hint that does nothing at all would pass every other test."""

    @njit
    def hint(values, row):
        prefetch(values, row, 1)

    hint(np.zeros((4, 2), np.float32), 10**6)  # reads nothing
    assert "call void @llvm.prefetch" in "".join(hint.inspect_llvm().values())
