"""A rig and its uncertainty in words, for console and page."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.capture.rig.parameters import PARAMETERS
from thermoxels_ns.capture.rig_types import FloatArray, RigEstimate

_FAR_LESS_SURE = 2.0
"""Times the standard error of a point's place that the turn alone would move it, from which on that is explained."""
_WORDS = {
    "rx": "the tilt up or down",
    "ry": "the turn left or right",
    "rz": "the roll",
    "tx": "the shift to the side",
    "ty": "the shift up or down",
    "tz": "the shift ahead",
    "log_focal": "the focal length",
    "cx": "the principal point's column",
    "cy": "the principal point's row",
    "k1": "the distortion",
}
_EXCHANGED = (("rx", "cy"), ("ry", "cx"), ("rx", "ty"), ("ry", "tx"), ("log_focal", "tz"), ("log_focal", "k1"))
"""Numbers that move the image of a narrow lens, or of a scene of one depth, almost alike."""
_SAME = 0.8
"""Correlation from which on two numbers stand for each other: knowing one would make the other 1.7 times as sure."""
_NOTHING_LEARNT = 0.8  # share of the first standard deviation that is left where the images say next to nothing
_WORTH_KNOWING = 0.8
"""Share of the turn's standard error that is left with the principal point known, below which that is said."""
_TURN = [PARAMETERS.index(name) for name in ("rx", "ry", "rz")]
_CENTRE = [PARAMETERS.index(name) for name in ("cx", "cy")]


def turn_deg(rig: RigEstimate) -> float:
    """Angle between the directions of the two cameras, about any axis [degrees]."""
    trace = float(np.trace(rig.visible_to_thermal[:3, :3]))
    return float(np.degrees(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))))


def turn_error_deg(rig: RigEstimate) -> float:
    """Standard error of the turn about all axes together [degrees]; NaN where it is not known."""
    errors = rig.standard_errors
    return float(np.degrees(np.sqrt(sum(errors.get(name, np.nan) ** 2 for name in ("rx", "ry", "rz")))))


def rig_lines(rig: RigEstimate, metres_per_unit: float | None) -> tuple[str, ...]:
    """Say in two short lines what was found; of a rig that is given or not determined its explanation."""
    if not rig.determined or not np.isfinite(rig.projection_sigma_px):
        return (rig.explanation,)
    focal_px = rig.thermal_camera.fl_x
    focal = with_error(focal_px, rig.standard_errors.get("log_focal", np.nan) * focal_px, 1)
    turn = with_error(turn_deg(rig), turn_error_deg(rig), 2)
    distance = float(np.linalg.norm(rig.visible_to_thermal[:3, 3]))
    apart = f"{distance:.3g} units" if metres_per_unit is None else f"{100.0 * distance * metres_per_unit:.1f} cm"
    return (
        f"turned by {turn} degrees, {apart} apart, focal length {focal} pixels",
        f"points fall within {rig.projection_sigma_px:.2f} thermal pixels (standard error); the page says more",
    )


def why_turn_is_unsure(rig: RigEstimate) -> str:
    """Say why the turn is less sure than the places of points; empty where it is not, or nothing was estimated."""
    error_deg = turn_error_deg(rig)
    alone_px = np.radians(error_deg) * rig.thermal_camera.fl_x
    # Only a rig from comparing the images has a score: neither one that is given, nor from a board, nor the start.
    if not (rig.determined and np.isfinite(rig.score_after) and alone_px > _FAR_LESS_SURE * rig.projection_sigma_px):
        return ""
    return (
        f"The turn is sure to {error_deg:.2f} degrees only, though points fall within {rig.projection_sigma_px:.2f} "
        "thermal pixels: without a ruler or a heated checker board (--board-photos), turn, principal point and shift "
        "stand for each other."
    )


def with_error(value: float, error: float, decimals: int) -> str:
    """Write a number with its standard error, where it has one.

    >>> with_error(70.04, 0.26, 1), with_error(1.0, float("nan"), 2), with_error(1.0, 0.0, 2)
    ('70.0 ± 0.3', '1.00', '1.00')
    """
    plus = f" ± {error:.{decimals}f}" if np.isfinite(error) and error > 0.0 else ""
    return f"{value:.{decimals}f}{plus}"


def uncertainty_text(covariance: FloatArray, sigmas: FloatArray) -> str:
    """Say which of the ten numbers of a rig are not to be trusted alone; empty where all are.

    `covariance` is that of the ten changes (10, 10), `sigmas` their standard deviations before the images were looked
    at, 0 for what is kept fixed.

    >>> uncertainty_text(np.diag(np.full(10, 0.01)), np.ones(10))
    ''
    >>> uncertainty_text(np.diag([0.01] * 9 + [0.81]), np.ones(10))
    'The images say next to nothing about the distortion: it is as unsure as at the start.'
    """
    errors = np.sqrt(np.diag(covariance))
    sentences, pairs = [], []
    for first, second in _EXCHANGED:
        a, b = PARAMETERS.index(first), PARAMETERS.index(second)
        if errors[a] > 0.0 and errors[b] > 0.0 and abs(covariance[a, b]) > _SAME * errors[a] * errors[b]:
            pairs.append(f"{_WORDS[first]} and {_WORDS[second]}")
    if pairs:
        sentences.append(
            f"The images hardly tell apart {'; '.join(pairs)}: where points fall is surer than each of these numbers."
        )
    turn_deg, alone_deg = turn_errors_deg(covariance)
    if alone_deg < _WORTH_KNOWING * turn_deg:
        sentences.append(
            f"The turn is sure to {turn_deg:.2f} degrees; with the principal point known, as a heated board tells it, "
            f"it would be to {alone_deg:.2f}."
        )
    unknown = [
        _WORDS[name]
        for name, error, sigma in zip(PARAMETERS, errors, sigmas)
        if sigma > 0.0 and error > _NOTHING_LEARNT * sigma
    ]
    if unknown:
        rest = "it is as unsure as at the start" if len(unknown) == 1 else "they are as unsure as at the start"
        sentences.append(f"The images say next to nothing about {', '.join(unknown)}: {rest}.")
    return " ".join(sentences)


def turn_errors_deg(covariance: FloatArray) -> tuple[float, float]:
    """Standard error of the turn about all axes together, as it is and were the principal point known [degrees].

    The second is the root of the trace of C_rr - C_rc C_cc^-1 C_cr, the covariance of the turn r given the principal
    point c (the conditional of a normal distribution). A principal point that is kept fixed has zeros in `covariance`.

    >>> covariance = np.diag([1e-4, 0, 0, 0, 0, 0, 0, 0, 1.0, 0])
    >>> covariance[0, 8] = covariance[8, 0] = 0.8e-2
    >>> [round(each, 3) for each in turn_errors_deg(covariance)]
    [0.573, 0.344]
    """
    turn = covariance[np.ix_(_TURN, _TURN)]
    shared = covariance[np.ix_(_TURN, _CENTRE)]
    given = turn - shared @ np.linalg.pinv(covariance[np.ix_(_CENTRE, _CENTRE)], hermitian=True) @ shared.T
    with_it, without = (float(np.degrees(np.sqrt(max(np.trace(each), 0.0)))) for each in (turn, given))
    return with_it, without
