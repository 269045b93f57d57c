"""The words for a rig's covariance: what is exchanged with what, and what the images do not tell."""

from __future__ import annotations

import numpy as np
import pytest

from thermoxels_ns.capture.rig.parameters import PARAMETERS
from thermoxels_ns.capture.rig.uncertainty import certainty_text, turn_errors_deg

RX, TY, FOCAL, CY = (PARAMETERS.index(name) for name in ("rx", "ty", "log_focal", "cy"))


def covariance_of(first: int, second: int, correlation: float) -> np.ndarray:
    errors = np.linspace(0.01, 0.1, 10)
    result = np.diag(errors**2)
    result[first, second] = result[second, first] = correlation * errors[first] * errors[second]
    return result


def test_a_rig_that_is_known_needs_no_words() -> None:
    assert certainty_text(covariance_of(RX, CY, 0.5), np.ones(10)) == ""


def test_what_stands_for_each_other_is_named_with_either_sign() -> None:
    for sign in (1.0, -1.0):
        text = certainty_text(covariance_of(RX, CY, 0.95 * sign), np.ones(10))
        assert "hardly tell apart the tilt up or down and the principal point's row:" in text
        assert "shift" not in text and "focal" not in text
    assert "the tilt up or down and the shift up or down" in certainty_text(covariance_of(RX, TY, 0.9), np.ones(10))


def test_what_is_as_unsure_as_before_is_named_and_what_is_kept_fixed_is_not() -> None:
    covariance = covariance_of(RX, CY, 0.0)
    sigmas = np.ones(10)
    sigmas[[FOCAL, CY]] = np.sqrt(np.diag(covariance))[[FOCAL, CY]]
    text = certainty_text(covariance, sigmas)
    assert text.endswith("about the focal length, the principal point's row: they are as unsure as at the start.")
    covariance[CY], covariance[:, CY], sigmas[CY] = 0.0, 0.0, 0.0
    text = certainty_text(covariance, sigmas)
    assert text == "The images say next to nothing about the focal length: it is as unsure as at the start."


def test_the_turn_is_said_as_it_is_and_with_the_principal_point_known() -> None:
    errors = np.full(10, 1e-6)
    errors[[RX, CY]] = np.radians(0.5), 0.4
    covariance = np.diag(errors**2)
    covariance[RX, CY] = covariance[CY, RX] = -0.96 * errors[RX] * errors[CY]
    text = certainty_text(covariance, np.ones(10))
    assert "The turn is sure to 0.50 degrees; with the principal point known, " in text
    assert "it would be to 0.14." in text  # 0.5 sqrt(1 - 0.96^2)
    covariance[RX, CY] = covariance[CY, RX] = 0.5 * covariance[RX, CY]
    assert "The turn is sure to" not in certainty_text(covariance, np.ones(10))


def test_what_the_turn_would_be_is_the_inverse_of_the_information_on_all_but_the_principal_point() -> None:
    draw = np.random.default_rng(0).standard_normal((10, 14))
    information = draw @ draw.T
    free = [number for number in range(10) if number not in (CY - 1, CY)]
    alone = np.linalg.inv(information[np.ix_(free, free)])
    as_it_is, known = turn_errors_deg(np.linalg.inv(information))
    assert known == pytest.approx(np.degrees(np.sqrt(np.trace(alone[:3, :3]))), rel=1e-9)
    assert as_it_is > known


def test_a_principal_point_that_is_kept_fixed_changes_nothing() -> None:
    covariance = np.diag(np.r_[np.full(7, 1e-4), 0.0, 0.0, 0.0])
    as_it_is, known = turn_errors_deg(covariance)
    assert as_it_is == known == pytest.approx(np.degrees(np.sqrt(3e-4)))
