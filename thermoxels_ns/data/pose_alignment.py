"""The similarity between two worlds in which the same cameras have poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.feature_rays import FloatArray

_ROUNDS = 20
_FEWEST = 3
"""Cameras from which a similarity is found; fewer cannot outvote a wrong one."""
_STRAY = 5.0
"""Medians of the misfit above which a camera takes no part in the last fit."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """Brings points of one world into another: scale * rotation p + translation."""

    rotation: FloatArray
    """Shape (3, 3)."""
    translation: FloatArray
    """Shape (3,)."""
    scale: float

    def points(self, points: FloatArray) -> FloatArray:
        """Move points, shape (n, 3)."""
        return self.scale * points @ self.rotation.T + self.translation


def align_poses(source: FloatArray, target: FloatArray) -> Similarity | None:
    """Find the similarity that brings cameras of one world to their poses in another.

    The rotation is that between the cameras' axes, so that cameras on one line will do; scale and translation fit the
    centres in the least squares. The half of the cameras that fits worst is left out and the fit repeated until the
    half stays the same (least trimmed squares), so that some wrong poses do not move the others.

    Args:
        source: Camera to world, shape (n, 4, 4).
        target: The same cameras in the same order, with the same axes, shape (n, 4, 4).

    Returns:
        The similarity, however well it fits; None where the cameras are fewer than three or at one place.
    """
    if len(source) < _FEWEST:
        return None
    used = np.ones(len(source), dtype=bool)
    found = None
    for number in range(_ROUNDS):
        found = _fit(source[used], target[used])
        if found is None:
            return None
        misfit = _misfit(found, source, target)
        middle = float(np.sort(misfit)[max(_FEWEST, (len(misfit) + 1) // 2) - 1])
        best = misfit <= max(middle, 1e-12)
        if number and (best == used).all():
            break
        used = best
    used = misfit <= _STRAY * max(middle, 1e-12)
    return _fit(source[used], target[used])


def _fit(source: FloatArray, target: FloatArray) -> Similarity | None:
    # Sum of the rotations from source to target; the nearest rotation to it is their chordal mean.
    turns = np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3])
    left, _, right = np.linalg.svd(turns)
    rotation = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    centres, wanted = source[:, :3, 3] @ rotation.T, target[:, :3, 3]
    middle, wanted_middle = centres.mean(axis=0), wanted.mean(axis=0)
    spread = np.square(centres - middle).sum()
    scale = ((centres - middle) * (wanted - wanted_middle)).sum() / max(spread, 1e-300)
    if not (np.isfinite(scale) and scale > 0.0 and spread > 1e-18 * max(np.square(centres).sum(), 1e-300)):
        return None
    return Similarity(rotation, wanted_middle - scale * middle, float(scale))


def _misfit(found: Similarity, source: FloatArray, target: FloatArray) -> FloatArray:
    """Of each camera: distance between the centres over the spread of all, and angle between the axes [radians]."""
    wanted = target[:, :3, 3]
    spread = np.median(np.linalg.norm(wanted - np.median(wanted, axis=0), axis=1))
    off = np.linalg.norm(found.points(source[:, :3, 3]) - wanted, axis=1) / max(spread, 1e-300)
    turned = found.rotation @ source[:, :3, :3]
    # |A - B| of rotations is 2 sqrt(2) sin(angle / 2).
    chord = np.linalg.norm(turned - target[:, :3, :3], axis=(1, 2))
    return off + 2.0 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0))
