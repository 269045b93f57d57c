"""Values at nodes from values at corners."""

from __future__ import annotations

import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.temperature import interpolate_corners

SHAPE = (4, 5, 3)


def some_points(count: int = 200) -> np.ndarray:
    return np.random.default_rng(0).random((count, 3)) * (np.array(SHAPE) - 1)


def test_trilinear_functions_are_exact_where_all_is_known():
    x, y, z = np.indices(SHAPE).astype(float)
    points = some_points()
    values, weight = interpolate_corners(points, 2 + x - 3 * y + x * y * z, np.ones(SHAPE))
    px, py, pz = points.T
    assert values == pytest.approx(2 + px - 3 * py + px * py * pz, abs=1e-12)
    assert weight == pytest.approx(np.ones(len(points)))


def test_a_constant_comes_out_as_it_is_whatever_the_weights():
    weights = np.random.default_rng(1).random(SHAPE) * (np.random.default_rng(2).random(SHAPE) > 0.3)
    values, weight = interpolate_corners(some_points(), np.full(SHAPE, 19.3, np.float32), weights)
    assert np.all(values[weight > 0] == np.float64(np.float32(19.3)))


def test_corners_that_know_nothing_have_no_influence():
    values = np.full(SHAPE, 1e6)
    weights = np.zeros(SHAPE)
    values[1, 1, 1], weights[1, 1, 1] = 20.0, 3.0
    values[1, 1, 2], weights[1, 1, 2] = 24.0, 1.0
    found, weight = interpolate_corners(np.array([[1.0, 1.0, 1.5], [0.5, 1.0, 1.0], [3.0, 4.0, 0.0]]), values, weights)
    assert found.tolist() == [21.0, 20.0, 0.0]
    assert weight.tolist() == [2.0, 1.5, 0.0]


def test_results_stay_within_the_range_of_what_is_known():
    random = np.random.default_rng(3)
    values, weights = random.normal(size=SHAPE), random.random(SHAPE) * (random.random(SHAPE) > 0.5)
    found, weight = interpolate_corners(some_points(1000), values, weights)
    known = values[weights > 0]
    assert np.all(found[weight > 0] >= known.min() - 1e-12)
    assert np.all(found[weight > 0] <= known.max() + 1e-12)


def test_several_columns_are_interpolated_like_one():
    random = np.random.default_rng(4)
    values, weights, points = random.random((*SHAPE, 3)), random.random(SHAPE), some_points(50)
    together, _ = interpolate_corners(points, values, weights)
    for column in range(3):
        assert together[:, column] == pytest.approx(interpolate_corners(points, values[..., column], weights)[0])


def test_the_last_corner_is_part_of_the_lattice():
    values = np.arange(np.prod(SHAPE), dtype=float).reshape(SHAPE)
    found, _ = interpolate_corners(np.array([[3.0, 4.0, 2.0]]), values, np.ones(SHAPE))
    assert found[0] == values[-1, -1, -1]


def test_values_of_another_shape_are_refused():
    with pytest.raises(MeshError, match="values"):
        interpolate_corners(some_points(), np.zeros((2, 2, 2)), np.ones(SHAPE))
