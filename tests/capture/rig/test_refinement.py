"""Windows that follow the photographs bring the rig to hundredths of a pixel, and say where they cannot."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.known_rig import KnownCapture, painted_sky
from thermoxels_ns.capture.rig.images import prepare_frames
from thermoxels_ns.capture.rig.refinement import refine
from thermoxels_ns.capture.rig_types import RigModel, RigStart, prior_sigmas

NEAR = np.array([0.003, -0.004, 0.002, 0.0, 0.0, 0.0, 0.004, 0.0, 0.0, 0.0])
"""About half a pixel off."""


@pytest.fixture(scope="module")
def sky() -> KnownCapture:
    return painted_sky(views=3)


def polished(sky: KnownCapture, temperatures: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, int] | None:
    frames = [replace(f, temperature_c=t.astype(np.float32)) for f, t in zip(sky.frames, temperatures)]
    prepared = prepare_frames(frames, sky.visible, sky.thermal)
    start = RigStart(sky.thermal, sky.visible_to_thermal, centre_sigma=0.0, k1_sigma=0.0, translation_sigma=1e-6)
    rig = RigModel(sky.thermal, sky.visible_to_thermal)
    return refine(prepared, rig, NEAR, prior_sigmas(start, prepared.median_depth))


def images(sky: KnownCapture) -> list[np.ndarray]:
    return [np.asarray(frame.temperature_c) for frame in sky.frames]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_half_a_pixel_becomes_a_hundredth_for_warm_as_for_cold(sky: KnownCapture, sign: float) -> None:
    draw = np.random.default_rng(0)
    noisy = [20.0 + sign * image + 0.05 * draw.standard_normal(image.shape) for image in images(sky)]
    found = polished(sky, noisy)
    assert found is not None
    change, covariance, windows = found
    assert windows > 300
    assert sky.thermal.fl_x * np.abs(change[:3]).max() < 0.02
    assert 0.5 * sky.thermal.width * abs(change[6]) < 0.02
    errors = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(change) <= 3.0 * errors + 1e-12)
    assert sky.thermal.fl_x * errors[:3].max() < 0.1


def test_noise_and_other_pictures_are_left_alone(sky: KnownCapture) -> None:
    draw = np.random.default_rng(1)
    shape = (sky.thermal.height, sky.thermal.width)
    assert polished(sky, [20.0 + 0.05 * draw.standard_normal(shape) for _ in sky.frames]) is None
    assert polished(sky, images(sky)[1:] + images(sky)[:1]) is None
