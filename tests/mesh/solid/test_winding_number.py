import numpy as np
import pytest

from thermoxels_ns.mesh.solid.interior import winding_number


def box(shape: tuple[int, int, int], lo: tuple[int, int, int], hi: tuple[int, int, int]) -> np.ndarray:
    cells = np.zeros(shape, dtype=bool)
    cells[tuple(slice(a, b) for a, b in zip(lo, hi))] = True
    return cells


def rectangle(half_a: float, half_b: float, away: float) -> float:
    """Winding number of a rectangle at a point above its middle: its solid angle over 4 pi."""
    return np.arctan(half_a * half_b / (away * np.sqrt(half_a**2 + half_b**2 + away**2))) / np.pi


def test_a_cube_without_one_of_its_sides_surrounds_its_middle_five_sixths():
    solid = box((48, 48, 48), (12, 12, 12), (36, 36, 36))
    air = ~solid
    air[12:36, 12:36, :12] = False  # nothing is known of what is below
    found = winding_number(solid, air)
    assert found[23:25, 23:25, 23:25].mean() == pytest.approx(5 / 6, abs=0.02)
    # Below it the missing side is missed as well: with it, all would cancel.
    below = found[23:25, 23:25, 5:7].mean()
    assert below == pytest.approx(rectangle(12, 12, 6), abs=0.04)
    # A film across the hole is where it is one half.
    assert found[23:25, 23:25, 11:13].mean() == pytest.approx(0.5, abs=0.04)
