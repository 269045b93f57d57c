"""Windows that follow the photographs bring the rig to hundredths of a pixel, and say where they cannot."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.support.known_rig import KnownCapture, painted_sky
from thermoxels_ns.capture.rig.images import prepare_frames
from thermoxels_ns.capture.rig.refinement import (
    THERMAL_BLUR_PX,
    RefinedRig,
    SmoothThermal,
    WindowScore,
    inflate_centre_covariance,
    refine,
    window_design,
)
from thermoxels_ns.capture.rig_types import RigModel, RigStart, prior_sigmas

NEAR = np.array([0.003, -0.004, 0.002, 0.0, 0.0, 0.0, 0.004, 0.0, 0.0, 0.0])
"""About half a pixel off."""


@pytest.fixture(scope="module")
def sky() -> KnownCapture:
    return painted_sky(views=3)


def polished(sky: KnownCapture, temperatures: list[np.ndarray]) -> RefinedRig | None:
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
    assert found.windows > 300
    assert sky.thermal.fl_x * np.abs(found.change[:3]).max() < 0.02
    assert 0.5 * sky.thermal.width * abs(found.change[6]) < 0.02
    errors = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.change) <= 3.0 * errors + 1e-12)
    assert sky.thermal.fl_x * errors[:3].max() < 0.1


def test_noise_and_other_pictures_are_left_alone(sky: KnownCapture) -> None:
    draw = np.random.default_rng(1)
    shape = (sky.thermal.height, sky.thermal.width)
    assert polished(sky, [20.0 + 0.05 * draw.standard_normal(shape) for _ in sky.frames]) is None
    assert polished(sky, images(sky)[1:] + images(sky)[:1]) is None


def score_of(image: np.ndarray, sky: KnownCapture) -> WindowScore:
    """Windows of a picture against itself, seen by one camera."""
    camera = sky.thermal
    rows, columns = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5]))
    usable = np.zeros((camera.height, camera.width), dtype=bool)
    usable[8:-8, 8:-8] = True
    seen = cv2.GaussianBlur(image.astype(np.float32), (0, 0), THERMAL_BLUR_PX).astype(np.float32)
    design = window_design(seen, rays, usable, 1.0, 1.5, 400)
    return WindowScore([design], [SmoothThermal((3.0 - 2.0 * image).astype(np.float32))], RigModel(camera, np.eye(4)))


def test_slopes_are_the_derivatives_of_the_likelihood(sky: KnownCapture) -> None:
    score = score_of(images(sky)[0], sky)
    change = np.array([0.002, -0.003, 0.004, 0.002, -0.001, 0.003, 0.01, 0.4, -0.3, 0.02])
    total, parts = score.slopes(change)
    assert total == pytest.approx(score.value(change), rel=1e-12)
    slopes = parts.sum(axis=0)
    for number, step in enumerate([1e-5] * 7 + [1e-3] * 2 + [1e-4]):
        moved = [change.copy(), change.copy()]
        moved[0][number] += step
        moved[1][number] -= step
        ahead, behind = (score.value(one) for one in moved)
        assert slopes[number] == pytest.approx(
            (ahead - behind) / (2 * step), rel=0.03, abs=0.02 * np.abs(slopes[number]) + 1e-3
        )


def covariance_with_centre(variance_px: float) -> np.ndarray:
    """A covariance whose principal point is known to that variance, the tilt standing for its row."""
    errors = np.linspace(0.01, 0.1, 10)
    result = np.diag(errors**2)
    result[[7, 8], [7, 8]] = variance_px
    result[0, 8] = result[8, 0] = 0.9 * errors[0] * np.sqrt(variance_px)
    return result


def test_a_quarter_of_what_windows_say_of_the_principal_point_counts() -> None:
    covariance, sigmas = covariance_with_centre(1.0 / 9.0), np.ones(10)
    doubted = inflate_centre_covariance(covariance, sigmas)
    # Information 9, of it 1 from the start and 8 from the windows.
    assert doubted[7, 7] == pytest.approx(1.0 / 3.0)
    assert doubted[8, 8] == pytest.approx(1.0 / 3.0)
    assert doubted[0, 0] == pytest.approx(covariance[0, 0] * (1.0 + 0.81 * 2.0))
    rest = [1, 2, 3, 4, 5, 6, 9]
    assert np.allclose(doubted[np.ix_(rest, rest)], covariance[np.ix_(rest, rest)], rtol=0.0, atol=1e-15)
