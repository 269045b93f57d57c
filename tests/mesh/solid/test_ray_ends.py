import numpy as np
import pytest

from thermoxels_ns.core.snapshot import RayEvidence
from thermoxels_ns.mesh.solid.ray_ends import distance_to_ends, ends_in_voxels, without_front

SHAPE = (12, 6, 6)
Y, Z = (values.ravel() for values in np.meshgrid(np.arange(24) / 4 + 0.1, np.arange(24) / 4 + 0.1))


def kept_of(cells: np.ndarray, evidence: RayEvidence) -> np.ndarray:
    return without_front(cells, evidence, distance_to_ends(evidence, cells.shape))


def rays(*surfaces: tuple[float, float]) -> RayEvidence:
    """576 rays along x that end at each x of `surfaces`, in the direction of its sign."""
    ends = [np.column_stack((np.full_like(Y, x), Y, Z)) for x, _ in surfaces]
    directions = [np.tile([sign, 0.0, 0.0], (len(Y), 1)) for _, sign in surfaces]
    arrays = (np.concatenate(each).astype(np.float32) for each in (ends, directions))
    return RayEvidence(np.zeros(SHAPE, np.float32), np.ones(len(Y) * len(surfaces), np.float32), *arrays)


@pytest.mark.parametrize("place", np.arange(3.05, 5.0, 0.1))
def test_a_body_ends_within_half_a_voxel_of_where_rays_end(place):
    """Whichever voxels in front were solid: all that hold a piece of the surface, or one layer more."""
    for first in (int(place), int(place) - 1):
        cells = np.zeros(SHAPE, bool)
        cells[first:] = True
        kept = kept_of(cells, rays((place, 1.0)))
        assert kept[:, 1:5, 1:5].any(axis=(1, 2)).tolist() == (np.arange(12) + 0.5 >= place - 1e-6).tolist()
    distance = distance_to_ends(rays((place, 1.0)), SHAPE)[int(place), 1:5, 1:5]
    np.testing.assert_allclose(distance, place - int(place) - 0.5, atol=1e-5)


@pytest.mark.parametrize(("left", "right"), [(5.6, 5.65), (5.7, 5.6), (5.9, 5.95), (5.1, 5.05)])
def test_a_sheet_thinner_than_a_voxel_stays_where_it_is_seen_from_both_sides(left, right):
    cells = np.zeros(SHAPE, bool)
    cells[5] = True
    assert np.array_equal(kept_of(cells, rays((left, 1.0), (right, -1.0))), cells)


def test_what_no_ray_reaches_stays_and_what_lies_outside_of_the_lattice_tells_nothing():
    cells = np.ones(SHAPE, bool)
    kept = kept_of(cells, rays((3.2, 1.0), (40.0, 1.0), (-7.0, -1.0)))
    assert kept[5:].all() and kept[0].all()  # farther than the reach from any end
    counts = ends_in_voxels(rays((3.2, 1.0), (40.0, 1.0)), SHAPE)
    assert counts.sum() == len(Y) and counts[3].sum() == len(Y)


def test_a_region_that_holds_nothing_but_the_front_stays():
    cells = np.zeros(SHAPE, bool)
    cells[3] = True
    assert np.array_equal(kept_of(cells, rays((4.7, 1.0))), cells)
