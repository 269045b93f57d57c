"""Camera rings of a random scene, as close as the whole scene allows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from thermoxels_ns.synthetic.camera_rings import CameraRing
from thermoxels_ns.synthetic.solids import Box

_PICTURE_ASPECT = 0.75
_RIM = 0.95
_AZIMUTHS = 73
_AIMS = 9
_ELEVATIONS_DEG = {
    2: ((10.0, 20.0), (38.0, 50.0)),
    3: ((7.0, 15.0), (24.0, 36.0), (46.0, 60.0)),
}
_FARTHEST_SHARE = 1.10

FloatArray = npt.NDArray[np.float64]


def random_rings(
    draw: np.random.Generator, boxes: Sequence[Box], focal_share: float, arc_deg: tuple[float, float]
) -> tuple[CameraRing, ...]:
    """Draw two or three rings, or arcs, around some boxes.

    Args:
        draw: Source of the choices.
        boxes: Lower and upper corners of what every picture shows [m].
        focal_share: Focal length over the image width, for a 4:3 image.
        arc_deg: Azimuth where the arcs begin and their length; 360 closes them [degrees].

    Returns:
        Rings from the lowest to the highest, at most a tenth farther than the nearest at which all boxes show.
    """
    corners = _corners(boxes)
    lo, hi = corners.min(axis=0), corners.max(axis=0)
    middle, aims = 0.5 * (lo + hi), np.linspace(max(lo[2], 0.0), 0.6 * hi[2], _AIMS)
    elevations = _ELEVATIONS_DEG[3 if draw.random() < 0.75 else 2]
    rings = []
    for low, high in elevations:
        elevation = math.radians(draw.uniform(low, high))
        aim_z, distance = min(
            (_nearest(corners - (middle[0], middle[1], aim), elevation, focal_share, arc_deg), round(float(aim), 4))
            for aim in aims
        )[::-1]
        distance *= draw.uniform(1.0, _FARTHEST_SHARE)
        radius, height = distance * math.cos(elevation), aim_z + distance * math.sin(elevation)
        aim = (round(float(middle[0]), 4), round(float(middle[1]), 4), aim_z)
        rings.append(CameraRing(aim, round(radius, 4), round(height, 4), *arc_deg))
    return tuple(rings)


def _corners(boxes: Sequence[Box]) -> FloatArray:
    """All corners of boxes, shape (8 n, 3)."""
    ends = np.asarray(boxes, dtype=np.float64)
    which = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
    return ends[:, which, np.arange(3)].reshape(-1, 3)


def _nearest(relative: FloatArray, elevation: float, focal_share: float, arc_deg: tuple[float, float]) -> float:
    """Least distance from the origin at which an arc of cameras that look at it has all points (n, 3) in the picture.

    A point is in it if its distances from the view axis, sideways and upwards, are within the picture's half width and
    half height at the point's depth: beside <= half (distance - nearer), and likewise above.
    """
    azimuth = np.radians(arc_deg[0] + arc_deg[1] * np.linspace(0.0, 1.0, _AZIMUTHS))
    back = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(_AZIMUTHS, math.tan(elevation))], axis=1)
    back *= math.cos(elevation)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(_AZIMUTHS)], axis=1)
    beside, above = np.abs(relative @ right.T), np.abs(relative @ np.cross(back, right).T)
    half = 0.5 * _RIM / focal_share
    return float((relative @ back.T + np.maximum(beside, above / _PICTURE_ASPECT) / half).max())
