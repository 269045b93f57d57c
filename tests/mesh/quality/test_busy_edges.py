"""Cracks beside edges at which more than two boundary triangles meet."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from thermoxels_ns.mesh.quality.checks import count_overlaps
from thermoxels_ns.mesh.quality.topology import group_sides

POINTS = np.array(
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.3, 0.7, 0.0], [0.5, -1.0, 1.0], [0.5, -1.0, -1.0]]
)
"""An edge along x; two points on one side of it in one plane, and two in planes of their own."""


@pytest.mark.parametrize("order", itertools.permutations(range(4)))
def test_two_of_four_triangles_at_an_edge_that_lie_on_each_other_are_found_in_any_order(order) -> None:
    facets = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 5]])[list(order)]
    assert count_overlaps(POINTS, facets, group_sides(facets)) == 1


@pytest.mark.parametrize("order", itertools.permutations(range(3)))
def test_triangles_that_only_meet_at_an_edge_do_not_count(order) -> None:
    facets = np.array([[0, 1, 2], [0, 1, 4], [1, 0, 5]])[list(order)]
    assert count_overlaps(POINTS, facets, group_sides(facets)) == 0
