"""The net of a voxel mesh's faces: closed, with a vertex of its own for each sheet that passes a node."""

from __future__ import annotations

import numpy as np
import pytest

from thermoxels_ns.mesh.boundary.surface_net import SurfaceNet, surface_net, voxel_faces
from thermoxels_ns.mesh.voxel_tets import kuhn_tets, voxel_facets


def net_of(level: np.ndarray) -> SurfaceNet:
    points, facets = kuhn_tets(level > 0.0)[0], voxel_facets(level > 0.0)
    return surface_net(level, points, voxel_faces(level, points, facets))


def two_voxels(second: tuple[int, int, int], solid: float = 1.0) -> np.ndarray:
    level = -np.ones((6, 6, 6))
    level[2, 2, 2] = level[second] = solid
    return level


def test_a_voxel_has_eight_vertices_of_three_faces() -> None:
    net = net_of(two_voxels((2, 2, 2)))
    assert len(net.faces) == 6 and len(net.index) == 8
    assert np.array_equal(np.diff(net.first), [3] * 8)
    assert np.array_equal(np.sort(net.corners.ravel()), np.sort(np.repeat(np.arange(8), 3)))


def test_voxels_that_touch_by_a_corner_have_a_vertex_each() -> None:
    net = net_of(two_voxels((3, 3, 3)))
    assert len(net.index) == 16
    assert np.count_nonzero(np.all(net.index == 3, axis=1)) == 2


@pytest.mark.parametrize(("solid", "vertices"), [(0.5, 16), (1.5, 14)])
def test_the_level_decides_what_goes_on_where_voxels_touch_by_an_edge(solid: float, vertices: int) -> None:
    """At its saddle, where it is the product of the solid ones less that of the empty ones, up to a factor.

    Apart, both nodes of the edge have two vertices; together, the sheet around both passes each end of the edge once,
    or twice where it is split again.
    """
    level = two_voxels((3, 3, 2), solid)
    net = net_of(level)
    ends = [np.count_nonzero(np.all(net.index == end, axis=1)) for end in ((3, 3, 2), (3, 3, 3))]
    assert ends == ([2, 2] if solid < 1.0 else [1, 1])
    assert len(net.index) == vertices


@pytest.mark.parametrize("seed", range(4))
def test_every_edge_belongs_to_an_even_number_of_faces(seed: int) -> None:
    """The net is closed; two sheets may have an edge in common where both of its ends are one vertex of the two."""
    level = np.full((9, 9, 9), -1.0)
    level[1:-1, 1:-1, 1:-1] = np.random.default_rng(seed).normal(size=(7, 7, 7))
    net = net_of(level)
    ends = np.stack([net.corners, np.roll(net.corners, -1, axis=1)], axis=2).reshape(-1, 2)
    _, uses = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    assert len(net.corners) > 500
    assert np.all(uses % 2 == 0)


def test_faces_around_a_vertex_are_those_that_have_it_as_a_corner() -> None:
    level = np.random.default_rng(0).normal(size=(8, 7, 6))
    net = net_of(level)
    for vertex in range(0, len(net.index), 17):
        around = net.around[net.first[vertex] : net.first[vertex + 1]]
        assert np.array_equal(np.sort(around), np.flatnonzero(np.any(net.corners == vertex, axis=1)))
