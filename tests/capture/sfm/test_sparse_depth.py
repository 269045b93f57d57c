import numpy as np
import pytest

from thermoxels_ns.capture.sfm.sfm_model import SparseDepth


def test_a_slanted_plane_has_its_own_depth_and_not_that_of_its_nearest_points() -> None:
    draw = np.random.default_rng(0)
    rays = np.column_stack([draw.uniform(-0.4, 0.4, (600, 2)), np.ones(600)])
    normal = np.array([0.5, -0.2, 1.0])
    inverse = rays @ normal / 5.0
    depth, distance = SparseDepth(rays / inverse[:, None]).at(asked := rays[:100] * 0.7 + (0.0, 0.0, 0.3))
    assert np.median(np.abs(depth * (asked @ normal / 5.0) - 1.0)) < 2e-3
    assert distance.max() < 0.1


def test_at_an_outline_the_surface_in_front_counts_and_a_stray_point_does_not() -> None:
    draw = np.random.default_rng(1)
    rays = np.column_stack([draw.uniform(-0.4, 0.4, (2000, 2)), np.ones(2000)])
    depths = np.where(rays[:, 0] < 0.0, 2.0, 10.0)
    depths[7] = 0.1
    found, _ = SparseDepth(rays * depths[:, None]).at(np.array([[0.002, y, 1.0] for y in (-0.3, 0.0, 0.3)]))
    assert found == pytest.approx([2.0] * 3, rel=0.1)


def test_without_points_nothing_is_known() -> None:
    depth, distance = SparseDepth(np.zeros((0, 3))).at(np.ones((2, 3)))
    assert np.isinf(depth).all() and np.isinf(distance).all()
