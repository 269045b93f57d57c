from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.capture.rig.explanation import rig_lines, turn_error_deg, turn_errors_deg, why_turn_is_unsure
from thermoxels_ns.capture.rig.parameters import PARAMETERS
from thermoxels_ns.capture.rig_types import RigEstimate
from thermoxels_ns.core.camera import Camera

ERRORS = {"rx": 0.003, "ry": 0.004, "rz": 0.012, "log_focal": 0.01, "cx": 0.42, "cy": 0.57}
"""Their squares add up to 0.013 rad squared, 0.745 degrees."""


@pytest.fixture
def rig() -> RigEstimate:
    turn = np.radians(2.0)
    transform = np.eye(4)
    transform[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    transform[:3, 3] = (0.03, 0.0, -0.04)
    covariance = np.diag([ERRORS.get(name, 0.0) ** 2 for name in PARAMETERS])
    camera = Camera(80, 60, 70.0, 70.0, 41.0, 29.0)
    return RigEstimate(camera, transform, True, "Found. Long words.", PARAMETERS, covariance, 0.1, 0.4, 0.08)


def test_two_short_lines_say_what_was_found(rig):
    first, second = rig_lines(rig, 2.0)
    assert first == "turned by 2.00 ± 0.74 degrees, 10.0 cm apart, focal length 70.0 ± 0.7 pixels"
    assert second.startswith("points fall within 0.08 thermal pixels")
    assert max(len(first), len(second)) < 100
    assert "0.05 units apart" in rig_lines(rig, None)[0]


def test_a_turn_that_is_less_sure_than_the_points_says_why(rig):
    assert turn_error_deg(rig) == pytest.approx(np.degrees(0.013))
    assert why_turn_is_unsure(rig).startswith("The turn is sure to 0.74 degrees only, though points fall within 0.08")
    assert why_turn_is_unsure(replace(rig, projection_sigma_px=0.9)) == ""  # alone it moves a point by 0.91
    assert why_turn_is_unsure(replace(rig, score_after=np.nan)) == ""  # from a board
    assert why_turn_is_unsure(replace(rig, determined=False)) == ""
    assert why_turn_is_unsure(replace(rig, parameters=(), covariance=np.zeros((0, 0)))) == ""


CY = PARAMETERS.index("cy")


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
