"""Points that lie where their neighbours in the photographs do not: found, however dense or far they are."""

import numpy as np
import pytest

import thermoxels_ns.core.feature_rays as module
from thermoxels_ns.core.feature_rays import FeatureRays, agrees_with_neighbours

CAMERAS = np.random.default_rng(9).uniform(-0.6, 0.6, (6, 3)) + np.array([0.0, 0.0, 2.0])


def seen_by_all(points: np.ndarray, uncertainty: float = 0.0) -> FeatureRays:
    number = np.repeat(np.arange(len(points)), len(CAMERAS))
    return FeatureRays(np.tile(CAMERAS, (len(points), 1)), number, points, np.full(len(number), uncertainty))


def floor(count: int = 600, seed: int = 0, slope: float = 0.0) -> np.ndarray:
    x, y = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, count))
    return np.column_stack((x, y, slope * x))


def moved_in_sight(points: np.ndarray, wrong: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Points at another distance from the middle of the cameras."""
    middle = CAMERAS.mean(axis=0)
    return np.where(wrong[:, None], middle + factors[:, None] * (points - middle), points)


@pytest.mark.parametrize("slope, most_missed", [(0.0, 0.1), (1.0, 0.25)])
@pytest.mark.parametrize("share", [0.05, 0.2])
@pytest.mark.parametrize("side", ["before", "behind"])
def test_wrong_points_before_and_behind_a_surface_are_found_and_right_ones_stay(
    slope, most_missed, share, side
) -> None:
    random = np.random.default_rng(1)
    points = floor(slope=slope)
    wrong = random.random(len(points)) < share
    factors = random.uniform(0.5, 0.75, len(points)) if side == "before" else random.uniform(1.3, 1.6, len(points))
    agrees = agrees_with_neighbours(seen_by_all(moved_in_sight(points, wrong, factors)))
    assert agrees[~wrong].mean() > 0.97
    assert agrees[wrong].mean() < most_missed


def test_of_two_surfaces_one_before_the_other_both_stay() -> None:
    points = floor(2000)
    near = points[:, 0] > 0.1
    points[near, 2] = 0.7
    points = points[near | (points[:, 0] < 0.0)]
    assert agrees_with_neighbours(seen_by_all(points)).mean() > 0.99


def test_the_same_distance_off_is_doubted_where_points_are_dense_and_not_where_they_are_sparse() -> None:
    off = np.array([[0.0, 0.0, 0.3]])
    dense, sparse = (np.concatenate((floor(count), off)) for count in (4000, 12))
    assert not agrees_with_neighbours(seen_by_all(dense))[-1]
    assert agrees_with_neighbours(seen_by_all(sparse))[-1]
    assert agrees_with_neighbours(seen_by_all(dense, uncertainty=0.2))[-1], "what is not known better"


def test_the_verdict_is_the_same_in_any_world_and_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(4)
    points = floor(300)
    wrong = random.random(300) < 0.2
    lines = seen_by_all(moved_in_sight(points, wrong, random.uniform(0.5, 1.6, 300)))
    whole = agrees_with_neighbours(lines)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    assert 0.05 < (~whole).mean() < 0.3
    assert np.array_equal(agrees_with_neighbours(lines.moved(turn, np.array([5.0, -3.0, 1.0]), 250.0)), whole)
    monkeypatch.setattr(module, "_RAYS_AT_ONCE", 37)
    assert np.array_equal(agrees_with_neighbours(lines), whole)


def test_points_without_lines_are_not_doubted_and_nothing_is_made_of_nothing() -> None:
    nothing = FeatureRays(np.zeros((0, 3)), np.zeros(0, dtype=np.int64), floor(4), np.zeros(0))
    assert agrees_with_neighbours(nothing).tolist() == [True] * 4
    none = FeatureRays(nothing.origins, nothing.point, np.zeros((0, 3)), nothing.uncertainty)
    assert agrees_with_neighbours(none).shape == (0,)
