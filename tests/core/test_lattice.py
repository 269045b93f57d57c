import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.lattice import Lattice

LATTICE = Lattice((-1.0, 0.25, 3.0), 0.5, (4, 3, 5))


@given(st.lists(st.floats(-50, 50), min_size=3, max_size=3))
def test_index_and_world_are_inverse(index):
    np.testing.assert_allclose(LATTICE.world_to_index(LATTICE.index_to_world(index)), index, atol=1e-9)


def test_corners_and_centres_sit_where_the_house_says():
    corners = LATTICE.corner_positions()
    np.testing.assert_array_equal(corners[2, 1, 4], [-1 + 2 * 0.5, 0.25 + 0.5, 3 + 4 * 0.5])
    np.testing.assert_array_equal(corners[-1, -1, -1], LATTICE.hi)
    np.testing.assert_array_equal(LATTICE.cell_centres()[0, 0, 0], [-0.75, 0.5, 3.25])
    assert LATTICE.num_corners == 60 and LATTICE.cell_shape == (3, 2, 4)
    slope = np.array([1.0, -2.0, 0.5])  # the mean of a linear field is its value at the centre
    np.testing.assert_allclose(LATTICE.corner_to_cell_mean(corners @ slope), LATTICE.cell_centres() @ slope)


@given(
    st.lists(st.floats(-10, 10), min_size=3, max_size=3),
    st.lists(st.floats(0.01, 20), min_size=3, max_size=3),
    st.integers(1, 200),
)
def test_covering_covers_and_wastes_less_than_a_voxel(lo, size, resolution):
    box_lo = np.array(lo)
    box_hi = box_lo + np.array(size)
    lattice = Lattice.covering(box_lo, box_hi, resolution)
    slack = 1e-5 * lattice.voxel_size
    assert np.all(np.array(lattice.lo) <= box_lo + slack) and np.all(np.array(lattice.hi) >= box_hi - slack)
    assert max(lattice.cell_shape) == resolution
    assert np.all(np.array(lattice.hi) - lattice.lo - (box_hi - box_lo) < lattice.voxel_size + slack)


@pytest.mark.parametrize(
    "lo, hi, resolution",
    [((0, 0, 0), (1, 0, 1), 8), ((0, 0, 0), (1, np.nan, 1), 8), ((0, 0, 0), (1, 1, 1), 0), ((1, 1, 1), (0, 0, 0), 8)],
)
def test_boxes_of_no_size_are_refused(lo, hi, resolution):
    with pytest.raises(ThermoxelsError, match="scene box: expected three finite sides"):
        Lattice.covering(lo, hi, resolution)
