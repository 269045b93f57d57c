import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thermoxels_ns.data.colmap_tracks import _fit, align_poses

TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
SCALE, SHIFT = 0.37, np.array([5.0, -2.0, 0.3])


def worlds(count: int, on_a_line: bool = False) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(count)
    source = np.tile(np.eye(4), (count, 1, 1))
    source[:, :3, :3] = Rotation.from_rotvec(2.0 * random.normal(size=(count, 3))).as_matrix()
    source[:, :3, 3] = random.normal(size=(count, 3))
    if on_a_line:
        source[:, :3, 3] = np.linspace(0, 1, count)[:, None] * [1.0, 2.0, 3.0]
    target = source.copy()
    target[:, :3, :3] = TURN @ source[:, :3, :3]
    target[:, :3, 3] = SCALE * source[:, :3, 3] @ TURN.T + SHIFT
    return source, target


@pytest.mark.parametrize("count, on_a_line", [(3, False), (3, True), (40, False), (40, True)])
def test_the_similarity_is_found_also_of_cameras_on_one_line(count, on_a_line):
    found = align_poses(*worlds(count, on_a_line))
    assert found is not None
    np.testing.assert_allclose(found[:3], np.column_stack((SCALE * TURN, SHIFT)), atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_all_cameras_but_strays_take_part(seed) -> None:
    """Not only the half that fits best: what the others know of the similarity would be lost."""
    source, _ = worlds(12)
    target = source.copy()
    target[:, :3, 3] = 2.0 * source[:, :3, 3] + 1.0 + 0.01 * np.random.default_rng(seed).normal(size=(12, 3))
    target[5, :3, 3] += 3.0
    good = np.arange(12) != 5
    found, expected = align_poses(source, target), _fit(source[good], target[good])
    assert found is not None and expected is not None
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
