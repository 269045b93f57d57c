"""Cameras for tests that look at a point."""

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.snapshot import Views


def looking_at(target: npt.ArrayLike, eyes: npt.ArrayLike, focal: float = 100.0, size: int = 200) -> Views:
    """Square pinhole cameras at given places, turned to one point or each to its own; 90 degrees wide unless told."""
    eyes, poses = np.atleast_2d(np.asarray(eyes, dtype=np.float64)), []
    for eye, at in zip(eyes, np.broadcast_to(target, eyes.shape)):
        back = eye - at
        back /= np.linalg.norm(back)
        up = np.array([0.0, 0.0, 1.0]) if abs(back[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
        right = np.cross(up, back)
        right /= np.linalg.norm(right)
        poses.append(np.column_stack((right, np.cross(back, right), back, eye)))
    both = np.ones((len(poses), 2))
    return Views(np.array(poses), focal * both, 0.5 * size * both, (size * both).astype(np.int64))
