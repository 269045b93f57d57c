"""Edges count by place and direction, not by sign; what stays in place while the camera moves is taken out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermoxels_ns.capture.rig.images import edge_field, edge_weights, local_contrast, without_fixed_pattern


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


def test_strong_edges_count_alike_whatever_their_contrast_and_faint_ones_little() -> None:
    rows = np.ones((96, 1))
    profile = 10.0 * (np.arange(96) > 24) + 3.0 * (np.arange(96) > 48) + 0.05 * (np.arange(96) > 72)
    strength = np.abs(edge_field((rows * profile).astype(np.float32), 1.0))[48]
    strong, weaker, faint = (strength[place - 3 : place + 5].max() for place in (24, 48, 72))
    assert weaker == pytest.approx(strong, rel=0.1)  # eleven times the squared gradient
    assert strong > 0.7
    assert faint < 0.1 * strong
    assert np.allclose(edge_field((1000.0 * rows * profile).astype(np.float32), 1.0)[48], strength, atol=1e-3)


def test_lengths_follow_the_pixels_that_they_are_given_in() -> None:
    plain = step(30.0, 64)
    fine = cv2.resize(plain, (192, 192), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    coarse = edge_field(plain, 1.5)
    same = edge_field(fine, 1.5, 3.0)[1::3, 1::3]
    middle = slice(12, -12)
    assert np.abs(same - coarse)[middle, middle].max() < 0.12
    without = edge_field(fine, 1.5)[1::3, 1::3]
    assert np.abs(without - coarse)[middle, middle].max() > 0.3


def test_an_edge_is_trusted_alike_on_both_sides() -> None:
    rows, columns = (axis.ravel() for axis in np.mgrid[:20, 8:13])
    distance = np.where(columns < 10, 0.001, 0.05)  # scene points on the left side only
    trust = edge_weights(rows, columns, distance, (20, 20), 1.0).reshape(20, 5)
    assert np.allclose(trust, 1.0, atol=1e-3)
    alone = edge_weights(rows, columns, np.full(len(rows), 0.05), (20, 20), 1.0)
    assert alone.max() < 0.01


def test_noise_counts_little_and_a_flat_image_nothing() -> None:
    draw = np.random.default_rng(0)
    noisy = step(20.0) + 0.01 * draw.standard_normal((64, 64)).astype(np.float32)
    strength = np.abs(edge_field(noisy, 1.0))
    corner = strength[48:60, 4:16]  # far from the edge
    assert corner.mean() < 0.25 * strength[31, 31]
    assert not edge_field(np.full((64, 64), 20.0, np.float32), 1.0).any()


def test_pixels_without_a_value_make_no_edges() -> None:
    image = np.full((64, 64), 20.0, np.float32)
    image[20:30, 20:30] = np.nan
    assert not edge_field(image, 1.0).any()
    contrast = local_contrast(image)
    assert np.isnan(contrast[25, 25])
    assert np.nanmax(np.abs(contrast)) < 1e-4


def test_a_pattern_that_stays_is_taken_out_and_the_scene_is_kept() -> None:
    draw = np.random.default_rng(1)
    scenes = [step(angle) for angle in np.linspace(0.0, 170.0, 12)]
    pattern = 0.5 * draw.standard_normal((64, 64)).astype(np.float32)
    cleaned, agreement = without_fixed_pattern([scene + pattern for scene in scenes])
    assert agreement > 0.8
    left = np.array([image - local_contrast(scene) for image, scene in zip(cleaned, scenes)])
    assert left[:, :20, :20].std() < 0.1 * pattern.std()
    assert np.corrcoef(cleaned[4].ravel(), local_contrast(scenes[4]).ravel())[0, 1] > 0.8


def test_images_without_a_pattern_stay_as_they_are() -> None:
    draw = np.random.default_rng(2)
    images = [draw.standard_normal((48, 64)).astype(np.float32) for _ in range(10)]
    cleaned, agreement = without_fixed_pattern(images)
    assert abs(agreement) < 0.1
    assert all(np.array_equal(image, local_contrast(raw)) for image, raw in zip(cleaned, images))
