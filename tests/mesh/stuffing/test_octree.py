"""Balanced octrees: exact cases, and every rule against a plain construction from above."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy import ndimage

from thermoxels_ns.mesh.stuffing.interior import balanced_octree, eroded, split_in_eight


def edges_of_cubes(cells: np.ndarray, largest: int) -> np.ndarray:
    """Edge of the cube that each voxel is in, [voxels]."""
    edges = np.ones(cells.shape, dtype=np.int64)
    for number, level in enumerate(balanced_octree(cells, largest)):
        whole = level
        for below in range(number, -1, -1):
            half = tuple(-(-n // 2**below) for n in cells.shape)
            whole = split_in_eight(whole, half)
        edges[whole] = 2 ** (number + 1)
    return edges


def edges_from_above(cells: np.ndarray, largest: int) -> np.ndarray:
    """The same by splitting: the largest cubes that hold nothing else, halved until all neighbours fit."""
    edges = np.ones(cells.shape, dtype=np.int64)
    size = 2
    while size <= largest:
        for corner in product(*(range(0, n - size + 1, size) for n in cells.shape)):
            cube = tuple(slice(c, c + size) for c in corner)
            if cells[cube].all():
                edges[cube] = size
        size *= 2
    while True:
        smallest = ndimage.minimum_filter(edges, size=3, mode="constant", cval=1)
        wrong = edges > 2 * smallest
        if not wrong.any():
            return edges
        for size in np.unique(edges[wrong]):
            lowest = np.argwhere(wrong & (edges == size)) // size * size
            for corner in np.unique(lowest, axis=0):
                edges[tuple(slice(c, c + size) for c in corner)] = size // 2


@pytest.mark.parametrize("largest", [1, 2, 4, 16, 2**40])
@pytest.mark.parametrize("seed", range(4))
def test_every_cube_is_as_large_as_balance_allows(seed, largest):
    random = np.random.default_rng(seed)
    shape = tuple(random.integers(20, 40, size=3))
    cells = random.random(shape) > 10.0 ** -random.uniform(2, 4.5)
    found = edges_of_cubes(cells, largest)
    assert np.array_equal(found, edges_from_above(cells, min(largest, 64)))
    assert found.max() <= largest and np.all(found[~cells] == 1)


def test_sizes_in_a_large_cube():
    edges = edges_of_cubes(np.ones((62, 62, 62), dtype=bool), 64)
    middle = edges[31, 31]
    # One layer of every size, as far as where the sizes begin allows: 2, 4, 8 and so on from either side.
    assert middle[:32].tolist() == [2] * 4 + [4] * 4 + [8] * 8 + [16] * 16
    assert middle[32:].tolist() == [16] * 16 + [8] * 8 + [4] * 4 + [2] * 2


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 9, 9), (2, 2, 2), (3, 2, 5)])
def test_nothing_larger_fits(shape):
    levels = balanced_octree(np.ones(shape, dtype=bool), 8)
    assert sum(np.count_nonzero(level) for level in levels) == np.prod([n // 2 for n in shape])


@pytest.mark.parametrize("by", [1, 2, 3])
def test_erosion_is_that_of_a_cube(by):
    cells = np.random.default_rng(by).random((15, 14, 16)) > 0.005
    expected = ndimage.binary_erosion(cells, np.ones((2 * by + 1,) * 3))
    assert expected.any() and np.array_equal(eroded(cells, by), expected)
    assert not eroded(np.ones((2 * by, 9, 9), dtype=bool), by).any()
