"""Which cameras the similarity between two worlds is fitted to in the end."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thermoxels_ns.data.pose_alignment import _fit, align_poses


def poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    made = np.tile(np.eye(4), (count, 1, 1))
    made[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    made[:, :3, 3] = rng.uniform(-2.0, 2.0, (count, 3))
    return made


@pytest.mark.parametrize("seed", range(3))
def test_all_cameras_but_strays_take_part(seed) -> None:
    """Not only the half that fits best: what the others know of the similarity would be lost."""
    source = poses(12, seed)
    target = source.copy()
    target[:, :3, 3] = 2.0 * source[:, :3, 3] + 1.0 + 0.01 * np.random.default_rng(seed).normal(size=(12, 3))
    target[5, :3, 3] += 3.0
    good = np.arange(12) != 5
    found, expected = align_poses(source, target), _fit(source[good], target[good])
    assert found is not None and expected is not None
    assert found.scale == pytest.approx(expected.scale, rel=1e-12)
    np.testing.assert_allclose(found.translation, expected.translation, atol=1e-12)
