"""Plain walls are planes: dents go, what bends or is no plane stays."""

from __future__ import annotations

import numpy as np
import pytest

from thermoxels_ns.multiview.photographs import Photographs
from thermoxels_ns.multiview.planes import depths_on_planes

WIDTH, HEIGHT, FOCAL = 80, 60, 70.0


def one_photograph(colours: np.ndarray) -> Photographs:
    matrix = np.array([[FOCAL, 0, WIDTH / 2, 0], [0, FOCAL, HEIGHT / 2, 0], [0, 0, 1, 0]], dtype=np.float64)
    return Photographs(
        matrix[None],
        np.zeros((1, 3)),
        np.array([[WIDTH, HEIGHT]]),
        np.zeros(1, dtype=np.int64),
        np.ascontiguousarray(colours.reshape(-1, 3), dtype=np.float32),
        np.full(WIDTH * HEIGHT, np.nan, dtype=np.float32),
    )


def wall() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (x, y) relative to the focal length, and depths of a slanted wall, 2.5 to 4.3 away."""
    y, x = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    x, y = (x + 0.5 - WIDTH / 2) / FOCAL, (y + 0.5 - HEIGHT / 2) / FOCAL
    return x, y, 3.0 / (1.0 + 0.4 * x - 0.2 * y)


@pytest.mark.parametrize("seed", range(3))
def test_a_dented_plain_wall_becomes_a_plane(seed):
    x, y, exact = wall()
    seen = exact + np.random.default_rng(seed).normal(0.0, 0.01, len(exact))
    dent = (x > 0.1) & (x < 0.35) & (np.abs(y) < 0.25)
    seen[dent] += 0.8
    seen[::97] = np.nan
    photographs, nothing = one_photograph(np.full((HEIGHT, WIDTH, 3), 0.6)), np.zeros(len(seen), dtype=bool)
    found = depths_on_planes(photographs, nothing, seen.astype(np.float32), tolerance=0.05)
    assert 0.1 < dent.mean() < 0.2 and np.abs(found - exact).max() < 0.01


def test_what_is_textured_bends_or_is_a_backdrop_is_left_alone():
    x, _, exact = wall()
    plain, nothing = np.full((HEIGHT, WIDTH, 3), 0.6), np.zeros(len(exact), dtype=bool)
    textured = np.random.default_rng(0).uniform(0.0, 1.0, plain.shape)
    pillar = (3.0 - 0.1 * np.sqrt(np.clip(1.0 - (x / 0.7) ** 2, 0.0, None))).astype(np.float32)
    wavy = (exact + 0.5 * np.sin(20.0 * x)).astype(np.float32)
    exact = exact.astype(np.float32)
    for colours, backdrop, depth in (
        (textured, nothing, exact),
        (plain, ~nothing, exact),
        (plain, nothing, pillar),
        (plain, nothing, wavy),
        (plain, nothing, np.where(x > 0.0, np.float32(np.nan), exact)),
    ):
        assert np.isnan(depths_on_planes(one_photograph(colours), backdrop, depth, 0.05)).all()


def test_a_plain_corner_is_cut_at_its_edge():
    x, y, exact = wall()
    other = 3.0 / (1.0 - 0.9 * x - 0.2 * y)
    colours = np.where(x > 0.0, 0.60, 0.62).reshape(HEIGHT, WIDTH, 1).repeat(3, axis=2)
    depth = np.where(x > 0.0, exact, other).astype(np.float32)
    found = depths_on_planes(one_photograph(colours), np.zeros(len(x), dtype=bool), depth, 0.02)
    known = np.isfinite(found)
    assert known.mean() > 0.9 and np.abs(found - depth)[known].max() < 0.01
