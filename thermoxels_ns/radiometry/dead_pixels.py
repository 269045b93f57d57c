"""Pixels of a thermal sensor that are stuck at one value."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

MIN_FRAMES = 5  # fewer frames than this cannot tell a stuck pixel from a quiet one
_WINDOW = 2  # half width of the neighbourhood: 5 x 5, so that a dead column or row is still a minority of it


def find_dead_pixels(stack: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Find pixels that show exactly one value in every frame while their surroundings change.

    A stuck pixel alone is no proof: where the image border always shows the same cold sky, or in a scene of one
    temperature, live pixels are constant too. So three things must hold: the pixel has one finite value in all
    frames; fewer than half of all pixels do; and the median of the 5 x 5 pixels around it differs from its value in
    at least half of the frames. Temperatures (frames, height, width) to (height, width); fewer than 5 frames tell none.
    """
    frames, height, width = stack.shape
    constant = np.isfinite(stack[0]) & (stack == stack[:1]).all(axis=0)
    if frames < MIN_FRAMES or not constant.any() or constant.mean() >= 0.5:
        return np.zeros((height, width), dtype=bool)
    rows, columns = np.nonzero(constant)
    offsets = np.arange(-_WINDOW, _WINDOW + 1)
    near_rows = _mirror(rows[:, None, None] + offsets[None, :, None], height)
    near_columns = _mirror(columns[:, None, None] + offsets[None, None, :], width)
    differs = np.zeros(rows.shape, dtype=np.int64)
    for frame in stack:
        around = np.sort(frame[near_rows, near_columns].reshape(len(rows), -1), axis=1)  # NaN sorts to the end
        finite = np.isfinite(around).sum(axis=1)
        median = around[np.arange(len(rows)), (finite - 1) // 2]
        differs += median != frame[rows, columns]
    dead = np.zeros((height, width), dtype=bool)
    dead[rows, columns] = 2 * differs >= frames
    return dead


def _mirror(index: npt.NDArray[np.int64], length: int) -> npt.NDArray[np.int64]:
    """Reflect indices at both ends (without repeating the end), as far as the image reaches."""
    inside = (length - 1) - np.abs((length - 1) - np.abs(index))
    return np.clip(inside, 0, length - 1)
