from dataclasses import replace

import numpy as np
import pytest

from tests.support.plane_photographs import EYES, LATTICE, photographs
from thermoxels_ns.multiview.differences import matters, photograph_differences
from thermoxels_ns.multiview.stereo import depths_of


@pytest.fixture(scope="module")
def depths():
    return depths_of(photographs(), LATTICE.lo, LATTICE.hi)


def unknown(depths) -> np.ndarray:
    return np.full(len(depths.depth), np.nan, np.float32)


def with_colours(depths, colours):
    return replace(depths, photographs=replace(depths.photographs, colours=colours.astype(np.float32)))


def test_gains_are_found_within_half_a_percent(depths):
    draw = np.random.default_rng(0)
    gain = 2.0 ** draw.normal(0.0, 0.2, (len(EYES), 1)) * (1.0 + draw.normal(0.0, 0.03, (len(EYES), 3)))
    seen = np.clip(depths.photographs.colours * gain[depths.photographs.numbers], 0.0, 1.0)
    found = photograph_differences(with_colours(depths, seen), unknown(depths))
    true = np.log(gain) - np.log(gain).mean(0)
    assert np.abs(found.log_gain - true).max() < 0.012
    assert np.sqrt(np.mean((found.log_gain - true) ** 2)) < 0.005
    assert matters(found.log_gain, found.log_gain_error, 0.01)
    again = found.without_gains(replace(depths.photographs, colours=seen.astype(np.float32))).colours
    ratio = again / depths.photographs.colours
    assert np.abs(ratio[seen.max(1) < 1.0] / ratio.mean() - 1.0).max() < 0.02


def test_photographs_that_differ_by_noise_alone_stay(depths):
    found = photograph_differences(depths, unknown(depths))
    assert np.abs(found.log_gain).max() < 0.005
    assert not matters(found.log_gain, found.log_gain_error, 0.01)
    assert not matters(found.offset, found.offset_error, 0.0)  # no thermal images: nothing is known
    np.testing.assert_array_equal(found.offset, 0.0)
    noise = np.random.default_rng(1).normal(0.0, 3.0 / 255.0, depths.photographs.colours.shape)
    noisy = photograph_differences(with_colours(depths, depths.photographs.colours + noise), unknown(depths))
    assert not matters(noisy.log_gain, noisy.log_gain_error, 0.01)


def test_offsets_are_found_and_their_mean_is_not(depths):
    offset = np.random.default_rng(2).normal(0.3, 0.03, len(EYES))
    warm = 0.2 + 0.1 * depths.photographs.colours[:, 0] + offset[depths.photographs.numbers]
    found = photograph_differences(depths, warm.astype(np.float32))
    np.testing.assert_allclose(found.offset, offset - offset.mean(), atol=0.002)
    assert np.all(np.abs(found.offset - (offset - offset.mean())) < 4.0 * found.offset_error + 1e-3)
    assert matters(found.offset, found.offset_error, 0.003)


def test_saturated_pixels_tell_no_gain(depths):
    gain = np.ones((len(EYES), 1))
    gain[3] = 1.5
    seen = np.clip(depths.photographs.colours * gain[depths.photographs.numbers], 0.0, 1.0)
    found = photograph_differences(with_colours(depths, seen), unknown(depths))
    np.testing.assert_allclose(np.exp(found.log_gain[3] - np.delete(found.log_gain, 3, 0).mean(0)), 1.5, rtol=0.015)


def test_a_photograph_that_shares_nothing_is_not_known(depths):
    first = depths.photographs.numbers == 0
    found = photograph_differences(replace(depths, depth=np.where(first, np.nan, depths.depth)), unknown(depths))
    assert found.log_gain_error[0].min() > 1.0 > found.log_gain_error[1:].max()
    assert np.abs(found.log_gain[0] - found.log_gain[1:].mean(0)).max() < 0.01
