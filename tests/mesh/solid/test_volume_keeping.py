import numpy as np
import pytest

from tests.support.stuffed_shapes import volumes_and_angles
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.level_set import level_of
from thermoxels_ns.mesh.solid.volume_keeping import keep_volume
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid, stuff
from thermoxels_ns.mesh.stuffing.sharp_edges import sharpen


def meshed(cells: np.ndarray) -> StuffedSolid:
    """Opaque voxels beside empty ones, as training leaves them."""
    return sharpen(stuff(level_of(np.where(cells, 40.0, 0.0), 0.5, cells, cells)), cells.shape)


def share_kept(cells: np.ndarray) -> float:
    solid = meshed(cells)
    _, low, high = volumes_and_angles(solid.points, solid.tets)
    assert low >= 10.7 and high <= 164.8
    return float(signed_volumes(solid.points, solid.tets).sum() / np.count_nonzero(cells))


def block(*size: int, border: int = 4) -> np.ndarray:
    return np.pad(np.ones(size, dtype=bool), border)


def turned_bar(degrees: float, width: float) -> np.ndarray:
    x, y, z = np.indices((30, 30, 11)) + 0.5 - np.array([15.1, 14.9, 5.6])[:, None, None, None]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return (np.abs(x * c + y * s) < 10) & (np.abs(y * c - x * s) < width / 2) & (np.abs(z) < width / 2)


@pytest.mark.parametrize("size", [(2, 2, 2), (3, 3, 3), (8, 8, 8), (1, 3, 20), (12, 12, 1), (12, 12, 2)])
def test_small_and_flat_bodies_keep_their_volume(size):
    assert 0.84 < share_kept(block(*size)) < 1.05


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_bars_keep_their_volume(width):
    """A third of a bar one voxel thick was left, three quarters of one of three."""
    assert 0.84 < share_kept(block(20, width, width)) < 1.02


@pytest.mark.parametrize("degrees", [30.0, 45.0])
@pytest.mark.parametrize("width", [1.5, 3.0])
def test_turned_bars_keep_their_volume(degrees, width):
    assert 0.84 < share_kept(turned_bar(degrees, width)) < 1.02


def test_a_single_voxel_keeps_most_of_its_volume():
    assert 0.8 < share_kept(block(1, 1, 1)) < 1.1


def test_pits_and_channels_stay_open_as_bars_stay_solid():
    cells = np.ones((20, 14, 14), dtype=bool)
    cells[:, 6:8, 6:8] = False
    lost = cells.size - share_kept(cells) * np.count_nonzero(cells)
    assert 0.84 < lost / (20 * 4) < 1.02


def test_faces_stay_where_they_are():
    """On a flat wall smoothing takes nothing, and nothing moves."""
    sharp = np.where(np.arange(12)[:, None, None] < 6, 1.0, -1.0).astype(np.float32) * np.ones((12, 9, 9), np.float32)
    level = np.clip((5.5 - np.arange(12.0)) / 1.0, -1.0, 1.0).astype(np.float32)[:, None, None] * np.ones_like(sharp)
    kept = keep_volume(level, sharp, 0.25 * np.abs(sharp), sharp > 0.0)
    assert np.array_equal(kept, level)


@pytest.mark.parametrize("seed", range(4))
def test_signs_range_and_least_levels_hold(seed):
    random = np.random.default_rng(seed)
    cells = random.random((9, 10, 11)) < (0.1, 0.4, 0.6, 0.95)[seed]
    sharp = np.where(cells, 1.0, -1.0).astype(np.float32)
    least = (0.25 * random.random(cells.shape)).astype(np.float32)
    level = sharp * np.maximum(least, random.random(cells.shape)).astype(np.float32)
    kept = keep_volume(level, sharp, least, cells)
    assert np.array_equal(kept > 0.0, cells) and np.abs(kept).max() <= 1.0
    assert np.all(np.abs(kept) >= np.minimum(least, np.abs(level)))
    assert not np.array_equal(kept, level)
