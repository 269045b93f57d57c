import numpy as np
import pytest

from thermoxels_ns.mesh.solid.surface_ramp import REACH, SurfaceRamp, surface_ramp


def depth(*, radius: float = 8.0, voxels: int = 24) -> np.ndarray:
    """How deep voxel centres lie in a ball, [voxels]."""
    index = np.indices((voxels,) * 3) - np.array([11.7, 11.4, 11.9])[:, None, None, None]
    return radius - np.sqrt((index**2).sum(axis=0))


def ramp_of(density: np.ndarray, threshold: float) -> SurfaceRamp | None:
    dense = density >= threshold
    return surface_ramp(density, threshold, 100.0, dense, dense)


SMOOTH = {
    "e-fold per voxel": (lambda d: np.exp(d), 1.0),
    "eight e-folds per voxel": (lambda d: np.exp(8.0 * d), 1.0),
    "linear, 0 from 5 voxels outside on": (lambda d: np.maximum(5.0 + d, 0.0), 5.0),
    "blurred step": (lambda d: 100.0 / (1.0 + np.exp(-2.0 * d)), 50.0),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_levels_of_smooth_ramps_are_linear_in_the_distance(name):
    function, threshold = SMOOTH[name]
    d = depth()
    ramp = ramp_of(function(d), threshold)
    assert ramp is not None
    close = np.abs(d) < 1.0
    assert ramp.belief[close].min() == 1.0
    slope = (ramp.level[close] @ d[close]) / (d[close] @ d[close])
    assert np.abs(ramp.level[close] / slope - d[close]).max() < (0.13 if name == "blurred step" else 1e-4)
    assert slope < 1.05 / REACH


@pytest.mark.parametrize("threshold", [1e-3, 50.0])
def test_a_jump_is_no_ramp(threshold):
    assert ramp_of(np.where(depth() > 0.0, 100.0, 0.0), threshold) is None
    assert ramp_of(np.where(depth() > 0.0, 100.0, 1e-6), threshold) is None


def test_the_share_of_each_voxel_that_is_inside_is_none():
    assert ramp_of(np.clip(0.5 + depth(), 0.0, 1.0), 0.5) is None


def test_walls_two_voxels_thick_are_not_taken_for_ramps():
    """Third differences of 0 1 1 0 are 0."""
    density = np.zeros((12, 9, 9))
    density[5:7] = 40.0
    assert ramp_of(density, 0.5) is None


@pytest.mark.parametrize(("noise", "least", "most"), [(0.02, 1.0, 1.0), (0.3, 0.0, 0.1)])
def test_belief_falls_with_noise(noise, least, most):
    """Noise as a shift of the surface in voxels."""
    d = depth()
    ramp = ramp_of(np.exp(d + noise * np.random.default_rng(0).normal(size=d.shape)), 1.0)
    mean = 0.0 if ramp is None else float(ramp.belief[np.abs(d) < 1.0].mean())
    assert least <= mean <= most


def test_only_the_noisy_half_is_doubted():
    d = depth()
    noise = np.where(np.arange(24)[:, None, None] < 12, 0.0, 0.6) * np.random.default_rng(1).normal(size=d.shape)
    ramp = ramp_of(np.exp(d + noise), 1.0)
    assert ramp is not None
    close = np.abs(d) < 1.0
    assert ramp.belief[:8][close[:8]].min() == 1.0
    assert ramp.belief[16:][close[16:]].mean() < 0.2


def test_filled_voxels_are_not_judged_by_their_density():
    d = depth()
    dense = np.exp(d) >= 1.0
    cells = dense.copy()
    cells[4:6, 10:13, 10:13] = True
    ramp = surface_ramp(np.exp(d), 1.0, 100.0, dense, cells)
    assert ramp is not None
    assert np.all(ramp.belief[cells & ~dense] == 0.0) and np.all(ramp.level[cells & ~dense] == 1.0)
