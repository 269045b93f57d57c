"""Where a ray runs in the box: rays that go nowhere, or on for ever, are misses."""

from __future__ import annotations

import numpy as np
import pytest

from thermoxels_ns.render.kernels import Rays, Volume, chord


def chord_of(origin: tuple[float, ...], direction: tuple[float, ...], far: float) -> tuple[float, float]:
    """Entry and exit in the box from -1 to 1, in plain Python."""
    nothing = np.zeros((0, 0))
    volume = Volume(
        np.full(3, -1.0), np.full(3, 1.0), 0.1, np.full(3, 20), *(np.zeros(0, np.int64),) * 3, *(nothing,) * 3, 0
    )
    rays = Rays(np.array([origin]), np.array([direction]), np.zeros(1), np.array([far]), np.full(1, 3, np.uint8))
    return chord.py_func(rays, 0, volume)


@pytest.mark.parametrize(
    ("origin", "direction", "far", "expected"),
    [
        ((-3.0, 0.0, 0.0), (1.0, 0.0, 0.0), np.inf, (2.0, 4.0)),
        ((-3.0, 0.0, 0.0), (1.0, 0.0, 0.0), 3.0, (2.0, 3.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), np.inf, (0.0, 1.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.inf, (0.0, 0.0)),  # inside and without a direction: never out
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 2.0, (0.0, 2.0)),
        ((0.0, 3.0, 0.0), (1.0, 0.0, 0.0), np.inf, (0.0, 0.0)),
        ((-3.0, 0.0, 0.0), (-1.0, 0.0, 0.0), np.inf, (0.0, 0.0)),
        ((-3.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1.0, (0.0, 0.0)),
    ],
)
def test_entry_and_exit(origin, direction, far, expected) -> None:
    assert chord_of(origin, direction, far) == pytest.approx(expected)
