import numpy as np
import pytest

from thermoxels_ns.capture.rig.images import edge_field, local_contrast, without_fixed_pattern


def step(angle_deg: float, size: int = 64) -> np.ndarray:
    """An edge through the middle whose normal has an angle to the x axis."""
    x, y = np.meshgrid(np.arange(size) - 0.5 * (size - 1), np.arange(size) - 0.5 * (size - 1))
    along = x * np.cos(np.radians(angle_deg)) + y * np.sin(np.radians(angle_deg))
    return np.tanh(along).astype(np.float32)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 45.0, 90.0, 135.0, 160.0])
def test_an_edge_has_twice_its_angle_and_its_negative_too(angle_deg: float) -> None:
    edge = edge_field(step(angle_deg), 1.0)
    middle = edge[30:34, 30:34].mean()
    assert np.abs(middle / np.abs(middle) - np.exp(2j * np.radians(angle_deg))) < 0.03
    assert 0.7 < np.abs(middle) <= 1.0
    assert np.allclose(edge_field(5.0 - 3.0 * step(angle_deg), 1.0), edge, atol=1e-4)


def test_a_pattern_that_stays_is_taken_out_and_the_scene_is_kept() -> None:
    draw = np.random.default_rng(1)
    scenes = [step(angle) for angle in np.linspace(0.0, 170.0, 12)]
    pattern = 0.5 * draw.standard_normal((64, 64)).astype(np.float32)
    cleaned = without_fixed_pattern([scene + pattern for scene in scenes])
    left = np.array([image - local_contrast(scene) for image, scene in zip(cleaned, scenes)])
    assert left[:, :20, :20].std() < 0.1 * pattern.std()
    assert np.corrcoef(cleaned[4].ravel(), local_contrast(scenes[4]).ravel())[0, 1] > 0.8


def test_images_without_a_pattern_stay_as_they_are() -> None:
    images = [np.random.default_rng(seed).standard_normal((48, 64)).astype(np.float32) for seed in range(10)]
    cleaned = without_fixed_pattern(images)
    assert all(np.array_equal(image, local_contrast(raw)) for image, raw in zip(cleaned, images))
