"""Offsets and vignetting come back from readings of shared points, and only where there are any."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.known_rig import known_capture
from thermoxels_ns.capture.rig.drift import DriftSamples, estimate_drift, sample_shared_points
from thermoxels_ns.capture.rig_types import radius_squared

FRAMES = 12


def readings(
    offsets_k: np.ndarray,
    radial: tuple[float, float] = (0.0, 0.0),
    noise_k: float = 0.05,
    wrong_share: float = 0.0,
    groups: int = 1,
    points: int = 600,
    seed: int = 0,
) -> DriftSamples:
    """Readings of points, each seen by four frames of one group."""
    draw = np.random.default_rng(seed)
    frames = len(offsets_k)
    per_group = frames // groups
    group = np.arange(points) % groups
    seen = np.sort(np.argsort(draw.random((points, per_group)), axis=1)[:, :4], axis=1) + group[:, None] * per_group
    radius2 = draw.uniform(0.0, 1.0, seen.shape)
    truth = draw.uniform(5.0, 25.0, (points, 1))
    value = truth + offsets_k[seen] + radial[0] * radius2 + radial[1] * radius2**2
    value = value + noise_k * draw.standard_normal(seen.shape)
    value = value + np.where(draw.random(seen.shape) < wrong_share, -8.0, 0.0)
    return DriftSamples(np.repeat(np.arange(points), 4), seen.ravel(), value.ravel(), radius2.ravel(), frames)


@pytest.fixture
def offsets_k() -> np.ndarray:
    offsets = 2.0 * np.random.default_rng(4).standard_normal(FRAMES)
    return offsets - offsets.mean()


@pytest.mark.parametrize(("noise_k", "wrong_share", "limit_k"), [(0.0, 0.0, 1e-8), (0.05, 0.1, 0.1)])
def test_offsets_are_exact_without_noise_and_a_tenth_of_wrong_readings_does_not_pull_them(
    offsets_k: np.ndarray, noise_k: float, wrong_share: float, limit_k: float
) -> None:
    found = estimate_drift(readings(offsets_k, (1.5, -0.4), noise_k, wrong_share))
    assert np.abs(found.offsets_k - offsets_k).max() < limit_k and abs(found.offsets_k.mean()) < 1e-12
    assert np.allclose(found.radial, (1.5, -0.4), atol=limit_k)
    assert found.used
    assert found.after_k < 1e-9 + 2.0 * noise_k < 1.0 < found.before_k


def test_groups_that_share_no_points_get_mean_zero_each(offsets_k: np.ndarray) -> None:
    found = estimate_drift(readings(offsets_k, groups=2))
    half = FRAMES // 2
    for part in (slice(0, half), slice(half, None)):
        assert abs(found.offsets_k[part].mean()) < 1e-6
        assert np.allclose(found.offsets_k[part], offsets_k[part] - offsets_k[part].mean(), atol=0.05)


def test_too_few_points_or_frames_are_said() -> None:
    few = estimate_drift(readings(np.ones(FRAMES), points=20))
    assert not few.used
    assert "only 20 scene points" in few.explanation
    capture = known_capture("sphere", views=2, photograph_width=80, thermal_width=40)
    one = estimate_drift(sample_shared_points(capture.frames[:1], capture.thermal, capture.visible_to_thermal))
    assert not one.used
    assert len(one.offsets_k) == 1
    assert "only 0 scene points" in one.explanation


def test_images_are_corrected_by_what_was_put_into_them_where_they_have_a_temperature() -> None:
    capture = known_capture(photograph_width=320, views=8)
    hole = np.zeros((capture.thermal.height, capture.thermal.width), dtype=bool)
    hole[40:60, 50:70] = True
    frames = [replace(f, temperature_c=np.where(hole, np.nan, f.temperature_c)) for f in capture.frames]
    found = estimate_drift(sample_shared_points(frames, capture.thermal, capture.visible_to_thermal))
    assert found.used
    assert np.abs(found.offsets_k - capture.offsets_k).max() < 0.1
    size = capture.thermal.width, capture.thermal.height
    radius2 = radius_squared(np.array([[8.0, 8.0]]), *size)[0]
    put_in = capture.radial[0] * radius2 + capture.radial[1] * radius2**2
    assert found.radial_k(*size)[7:9, 7:9].mean() == pytest.approx(put_in, abs=0.35)
    raw = np.asarray(capture.frames[3].temperature_c)
    centre = slice(62, 66), slice(78, 82)
    assert np.abs((raw - found.corrected(3, raw))[centre] - capture.offsets_k[3]).max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_what_helps_only_the_points_it_was_fitted_to_or_lies_far_below_the_noise_is_no_drift(seed) -> None:
    """80 offsets take 9 % out of the noise of 600 readings; offsets of 0.01 K beside 0.05 K gain 2 %."""
    alone = estimate_drift(readings(np.zeros(80), points=150, seed=seed))
    offsets_k = 0.01 * np.random.default_rng(seed).standard_normal(12)
    small = estimate_drift(readings(offsets_k, points=4000, seed=seed))
    assert not alone.used and not alone.offsets_k.any() and alone.radial == ()
    assert alone.before_k == alone.after_k == pytest.approx(0.05 * np.sqrt(2.0) * 0.6745, rel=0.15)
    assert not small.used and "at points it was not fitted to" in small.explanation
    assert estimate_drift(readings(5.0 * offsets_k, points=4000, seed=seed)).used
