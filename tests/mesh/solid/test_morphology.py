import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import Delaunay

from thermoxels_ns.core.lattice import CORNER_OFFSETS
from thermoxels_ns.mesh.solid.morphology import close_gaps, connected, convex_hull, face_connected, fill_enclosed


@pytest.mark.parametrize("share", [0.03, 0.3, 0.7])
def test_closing_fills_what_a_cube_of_empty_voxels_does_not_reach(share):
    by = 2
    cells = np.random.default_rng(0).random((13, 11, 9)) < share
    # Beyond the border the border voxels repeat, far enough for every cube that touches the lattice.
    wide = np.pad(cells, 2 * by, mode="edge")
    cube = np.ones((2 * by + 1,) * 3)
    fits = np.asarray(ndimage.binary_erosion(~wide, cube, border_value=1))
    reached = np.asarray(ndimage.binary_dilation(fits, cube), dtype=bool)
    expected = ~reached[2 * by : -2 * by, 2 * by : -2 * by, 2 * by : -2 * by]
    closed = close_gaps(cells, by)
    assert (closed >= cells).all() and (closed >= expected).all()
    inner = (slice(2 * by, -2 * by),) * 3
    assert np.array_equal(closed[inner], expected[inner])


def test_a_checkerboard_is_closed_but_for_corners_that_go_on_empty_outside():
    cells = np.indices((6, 6, 6)).sum(axis=0) % 2 == 0
    assert connected(cells).max() == 1 and face_connected(cells).max() == 108
    left = np.argwhere(~close_gaps(cells, 1))
    assert len(left) == 4 and np.isin(left, [0, 5]).all()
    assert fill_enclosed(cells)[1:-1, 1:-1, 1:-1].all()


@pytest.mark.parametrize("seed", range(6))
def test_hull_holds_the_voxel_centres_that_a_triangulation_of_the_corners_holds(seed):
    cells = np.random.default_rng(seed).random((12, 9, 10)) < 0.01
    cells[6, 4, 5] = True
    corners = (np.argwhere(cells)[:, None] + CORNER_OFFSETS).reshape(-1, 3)
    centres = np.stack(np.meshgrid(*map(np.arange, cells.shape), indexing="ij"), axis=-1) + 0.5
    assert np.array_equal(convex_hull(cells), Delaunay(corners).find_simplex(centres) >= 0)
