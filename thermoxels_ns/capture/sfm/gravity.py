"""Which way is up: what the camera measured, or how people hold cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.rig_types import FloatArray

_UP_OF_ORIENTATION = {1: (0, 1), 2: (0, 1), 3: (0, -1), 4: (0, -1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
"""Where the upper edge of the upright picture lies in the stored one (x right, y up), by EXIF's orientation."""
_ROLLED_DEG = 2.0  # how far from level people hold the sides of a picture, standard deviation, [degrees]
_BELIEVED_DEG = 5.0  # standard error up to which the common normal of the cameras' level axes is believed, [degrees]


@dataclass(frozen=True)
class Up:
    """A direction and how it was found."""

    direction: FloatArray  # unit vector in the model's coordinates, shape (3,)
    source: str  # a sentence
    spread_deg: float | None
    """Median angle between it and what single photographs say, [degrees]; None where they say nothing."""


def find_up(
    camera_to_world: FloatArray, gimbal_deg: Sequence[tuple[float, float] | None], orientation: Sequence[int]
) -> Up:
    """Find up from the cameras' own levels, else from how cameras are usually held.

    A camera pitched by p and rolled by r against gravity has up at (-sin r cos p, cos r cos p, -sin p) in its axes
    x right, y up, z back: pitch 0 is level, -90 looks straight down. Without such angles it is assumed that people hold
    the sides of a picture level: up is normal to the cameras' x axes where these turn enough, else the mean of their
    y axes. `gimbal_deg` is pitch and roll per camera [degrees], `orientation` EXIF's per photograph.
    """
    rotations = camera_to_world[:, :3, :3]
    measured = [i for i, angles in enumerate(gimbal_deg) if angles is not None]
    if measured:
        local = []
        for pitch, roll in (map(math.radians, angles) for angles in gimbal_deg if angles is not None):
            # Rolled clockwise as seen from behind, the camera finds up to its left.
            local.append((-math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch), -math.sin(pitch)))
        each = np.einsum("nij,nj->ni", rotations[measured], np.array(local))
        up = _robust_mean(each)
        spread = _median_angle(each, up)
        return Up(up, f"From the pitch and roll that {len(measured)} photographs state.", spread)
    flat = np.array([_UP_OF_ORIENTATION[o] for o in orientation], dtype=np.float64)
    held = np.einsum("nij,nj->ni", rotations[:, :, :2], flat)
    mean = _robust_mean(held)
    level = np.einsum("nij,nj->ni", rotations[:, :, :2], np.stack([flat[:, 1], -flat[:, 0]], axis=1))
    values, vectors = np.linalg.eigh(level.T @ level / len(level))
    turned = math.sqrt(max(float(values[1]), 0.0))  # sine of how far the axes spread, root mean square
    if len(level) >= 3 and _BELIEVED_DEG * math.sqrt(len(level)) * turned > _ROLLED_DEG:
        normal = vectors[:, 0] if vectors[:, 0] @ mean > 0 else -vectors[:, 0]
        if normal @ mean > math.cos(math.radians(45.0)):
            off = np.degrees(np.arcsin(np.clip(np.abs(level @ normal), 0.0, 1.0)))
            return Up(normal, "Assumed: the photographs' sides were held level.", float(np.median(off)))
    return Up(mean, "Assumed: the mean of the photographs' upward directions.", _median_angle(held, mean))


def level_rotation(up: npt.ArrayLike, ahead: npt.ArrayLike) -> FloatArray:
    """Rotation (3, 3) that turns `up` to z and `ahead`, as far as it is level, to y; to any level axis where it is not.

    >>> level_rotation([0, 1, 0], [0, 0, -1]).round(9).tolist()
    [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    """
    z = np.asarray(up, dtype=np.float64)
    z = z / np.linalg.norm(z)
    y = np.asarray(ahead, dtype=np.float64)
    y = y - (y @ z) * z
    if not np.linalg.norm(y) > 1e-6:
        y = np.eye(3)[np.argmin(np.abs(z))]
        y = y - (y @ z) * z
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z]) + 0.0


def _robust_mean(directions: FloatArray) -> FloatArray:
    """Mean direction in which the farther half does not count."""
    mean = directions.sum(axis=0)
    for _ in range(5):
        mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
        nearness = directions @ mean
        mean = directions[nearness >= np.median(nearness)].sum(axis=0)
    return mean / max(float(np.linalg.norm(mean)), 1e-12)


def _median_angle(directions: FloatArray, up: FloatArray) -> float:
    return float(np.degrees(np.median(np.arccos(np.clip(directions @ up, -1.0, 1.0)))))
