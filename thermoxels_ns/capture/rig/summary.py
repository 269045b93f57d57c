"""What was found of a rig, in a few words: two short lines while the capture runs, one sentence on its page."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.capture.stage_types import RigEstimate

_FAR_LESS_SURE = 2.0
"""Times the standard error of a point's place that the turn alone would move it, from which on that is explained."""


def turn_deg(rig: RigEstimate) -> float:
    """Angle between the directions of the two cameras, about any axis [degrees]."""
    trace = float(np.trace(rig.visible_to_thermal[:3, :3]))
    return float(np.degrees(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))))


def turn_error_deg(rig: RigEstimate) -> float:
    """Standard error of the turn about all axes together [degrees]; NaN where it is not known."""
    errors = rig.standard_errors
    return float(np.degrees(np.sqrt(sum(errors.get(name, np.nan) ** 2 for name in ("rx", "ry", "rz")))))


def found_in_images(rig: RigEstimate) -> bool:
    """Whether the rig comes from comparing the images: neither given, nor from pictures of a board, nor the start."""
    return rig.determined and bool(np.isfinite(rig.score_after))


def rig_lines(rig: RigEstimate, metres_per_unit: float | None) -> tuple[str, ...]:
    """Say in short what was found.

    Args:
        rig: The rig, lengths in units of the scene.
        metres_per_unit: Scale of the scene; None: it has none.

    Returns:
        Two short lines; of a rig that is given or not determined its explanation.
    """
    if not rig.determined or not np.isfinite(rig.projection_sigma_px):
        return (rig.explanation,)
    focal_px = rig.thermal_camera.fl_x
    focal = with_error(focal_px, rig.standard_errors.get("log_focal", np.nan) * focal_px, 1)
    turn = with_error(turn_deg(rig), turn_error_deg(rig), 2)
    return (
        f"turned by {turn} degrees, {apart(rig, metres_per_unit)} apart, focal length {focal} pixels",
        f"points fall within {rig.projection_sigma_px:.2f} thermal pixels (standard error); the page says more",
    )


def apart(rig: RigEstimate, metres_per_unit: float | None) -> str:
    """Distance between the two lenses, in centimetres where the scale is known."""
    distance = float(np.linalg.norm(rig.visible_to_thermal[:3, 3]))
    if metres_per_unit is None:
        return f"{distance:.3g} units"
    return f"{100.0 * distance * metres_per_unit:.1f} cm"


def why_turn_is_unsure(rig: RigEstimate) -> str:
    """Say why the turn is less sure than the places of points; empty where it is not, or nothing was estimated."""
    error_deg = turn_error_deg(rig)
    alone_px = np.radians(error_deg) * rig.thermal_camera.fl_x
    if not found_in_images(rig) or not alone_px > _FAR_LESS_SURE * rig.projection_sigma_px:
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
