"""The words for a rig's covariance: what is exchanged with what, and what the images do not tell."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.capture.rig_certainty import certainty_text
from thermoxels_ns.capture.rig_parameters import PARAMETERS

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
