"""Which voxels are solid."""

from __future__ import annotations

import numpy as np
import pytest

from thermoxels_ns.errors import MeshError
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.mesh.solid import SolidSelection, close_gaps, fill_enclosed, select_solid
from thermoxels_ns.snapshot import GridSnapshot


def cells_along_x(values: list[float]) -> np.ndarray:
    """Corner densities of a row of voxels whose centres have the given densities: alternate layers solve the mean."""
    layers = [0.0]
    for value in values:
        layers.append(2.0 * value - layers[-1])
    return np.broadcast_to(np.array(layers, dtype=np.float32)[:, None, None], (len(layers), 2, 2))


def test_density_of_a_voxel_is_the_mean_of_its_corners(snapshot_of):
    density = np.zeros((2, 2, 2))
    density[0, 0, 0] = 8.0
    assert select_solid(snapshot_of(density), SolidSelection(close_gaps=0, density_threshold=1.0)).cells.all()
    with pytest.raises(MeshError, match=r"1\.001.*highest density at a voxel centre is 1\."):
        select_solid(snapshot_of(density), SolidSelection(close_gaps=0, density_threshold=1.001))


@pytest.mark.parametrize("percentile", [50.0, 75.0, 90.0, 99.0])
def test_percentile_keeps_the_densest_share_of_all_voxels(snapshot_of, percentile):
    density = np.random.default_rng(0).random((11, 11, 11))
    snapshot = snapshot_of(density)
    solid = select_solid(snapshot, SolidSelection(close_gaps=0, density_percentile=percentile, smallest_body=0.0))
    centre = snapshot.lattice.corner_to_cell_mean(snapshot.density)
    assert solid.cells.sum() == pytest.approx(1000 * (1 - percentile / 100), abs=1)
    assert centre[solid.cells].min() > centre[~solid.cells].max()
    assert centre[solid.cells].min() >= solid.threshold > centre[~solid.cells].max()


def test_percentile_zero_keeps_every_voxel_with_density(snapshot_of):
    density = 1.0 + np.random.default_rng(0).random((5, 5, 5))
    assert select_solid(snapshot_of(density), SolidSelection(close_gaps=0, density_percentile=0.0)).cells.all()


def test_threshold_overrides_percentile(snapshot_of):
    snapshot = snapshot_of(cells_along_x([1, 2, 3, 4]))
    solid = select_solid(snapshot, SolidSelection(close_gaps=0, density_percentile=99.0, density_threshold=2.0))
    assert solid.cells[:, 0, 0].tolist() == [False, True, True, True]
    assert solid.threshold == 2.0


def test_zero_density_is_never_solid(snapshot_of):
    snapshot = snapshot_of(cells_along_x([0, 0, 0, 5]))
    for selection in (SolidSelection(close_gaps=0, density_percentile=0.0), SolidSelection(density_threshold=0.0)):
        assert select_solid(snapshot, selection).cells[:, 0, 0].tolist() == [False, False, False, True]


def test_ties_at_the_start_value_do_not_fill_the_box(snapshot_of):
    # 19 of 20 voxels still have the density training starts with: the 90th percentile is that value.
    snapshot = snapshot_of(cells_along_x([0.25] * 19 + [7.0]))
    solid = select_solid(snapshot, SolidSelection(close_gaps=0, density_percentile=90.0))
    assert np.flatnonzero(solid.cells).tolist() == [19]


def test_ties_at_the_top_are_all_kept(snapshot_of):
    snapshot = snapshot_of(cells_along_x([0.0] * 7 + [7.0] * 3))
    solid = select_solid(snapshot, SolidSelection(close_gaps=0, density_percentile=90.0))
    assert np.flatnonzero(solid.cells).tolist() == [7, 8, 9]


@pytest.mark.parametrize("percentile", [1.0, 90.0, 100.0])
def test_constant_density_is_refused(snapshot_of, percentile):
    with pytest.raises(MeshError, match=r"same density 0\.1 in all 27 voxels.*--density-threshold"):
        select_solid(snapshot_of(np.full((4, 4, 4), 0.1)), SolidSelection(close_gaps=0, density_percentile=percentile))


def test_empty_names_threshold_maximum_and_remedy(snapshot_of):
    with pytest.raises(MeshError, match=r"threshold 9.*highest density.*is 3\..*--density-threshold"):
        select_solid(snapshot_of(np.full((3, 3, 3), 3.0)), SolidSelection(close_gaps=0, density_threshold=9.0))
    with pytest.raises(MeshError, match="none of 8; the highest density"):
        select_solid(snapshot_of(np.zeros((3, 3, 3))), SolidSelection(close_gaps=0, density_percentile=90.0))


def test_largest_component_and_what_was_removed(snapshot_of):
    snapshot = snapshot_of(cells_along_x([5, 0, 5, 5, 5, 0, 5, 5]))
    largest = SolidSelection(close_gaps=0, density_threshold=1.0, largest_component=True)
    solid = select_solid(snapshot, largest)
    assert np.flatnonzero(solid.cells).tolist() == [2, 3, 4]
    assert solid.component_sizes.tolist() == [3, 2, 1]
    assert (solid.num_removed, solid.num_added) == (3, 0)
    every = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=1.0, largest_component=False))
    assert np.flatnonzero(every.cells).tolist() == [0, 2, 3, 4, 6, 7]
    assert every.num_removed == 0
    not_small = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=1.0, smallest_body=0.5))
    assert np.flatnonzero(not_small.cells).tolist() == [2, 3, 4, 6, 7] and not_small.num_removed == 1


def test_gaps_are_closed_and_wide_ones_are_not(snapshot_of):
    snapshot = snapshot_of(cells_along_x([5, 0, 0, 5, 0, 0, 0, 5]))
    one = select_solid(snapshot, SolidSelection(density_threshold=1.0))
    assert np.flatnonzero(one.cells).tolist() == [0, 1, 2, 3, 7] and one.num_closed == 2
    wall = np.ones((9, 9, 1), dtype=bool)
    wall[2, 3] = wall[5, 6] = False
    assert close_gaps(wall, 1).all() and close_gaps(wall, 0) is wall
    room = np.ones((9, 9, 9), dtype=bool)
    room[2:7, 2:7, 2:7] = False
    kept = close_gaps(room, 1)
    assert kept[2:7, 2:7, 2:7].sum() < 125 and not kept[3:6, 3:6, 3:6].any() and (kept >= room).all()


def test_voxels_that_touch_by_edge_or_corner_only_are_different_bodies(snapshot_of, corner_density):
    # At threshold 1 only voxels with all eight corners set are solid.
    for offset in ([1, 1, 0], [1, 1, 1]):
        cells = np.zeros((2, 2, 2), dtype=bool)
        cells[0, 0, 0] = cells[tuple(offset)] = True
        largest = SolidSelection(close_gaps=0, density_threshold=1.0, largest_component=True)
        solid = select_solid(snapshot_of(corner_density(cells)), largest)
        assert solid.component_sizes.tolist() == [1, 1]
        assert np.argwhere(solid.cells).tolist() == [[0, 0, 0]]


def test_cavities_are_filled_only_on_request(snapshot_of):
    density = np.ones((8, 8, 8))
    density[3:5, 3:5, 3:5] = 0.0
    snapshot = snapshot_of(density)
    hollow = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=0.4))
    filled = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=0.4, fill_cavities=True))
    missing = 7**3 - int(hollow.cells.sum())
    assert missing > 0
    assert filled.cells.all()
    assert filled.num_added == missing


def test_fill_enclosed_leaves_what_leads_outside():
    cells = np.ones((5, 5, 5), dtype=bool)
    cells[2, 2, 2] = False
    cells[0, 0, 0] = False
    expected = np.ones((5, 5, 5), dtype=bool)
    expected[0, 0, 0] = False
    assert np.array_equal(fill_enclosed(cells), expected)
    cells[2, 2, 3:] = False
    expected[2, 2, 2:] = False
    assert np.array_equal(fill_enclosed(cells), expected)


def test_a_cavity_that_opens_over_an_edge_only_is_enclosed():
    cells = np.ones((3, 3, 3), dtype=bool)
    cells[1, 1, 1] = cells[0, 0, 1] = False
    assert np.argwhere(~fill_enclosed(cells)).tolist() == [[0, 0, 1]]


def test_fill_enclosed_of_nothing_is_nothing():
    assert not fill_enclosed(np.zeros((3, 2, 1), dtype=bool)).any()


@pytest.mark.parametrize(
    "bad", [{"density_percentile": -1.0}, {"density_percentile": np.nan}, {"density_threshold": -0.1}]
)
def test_bad_selection_is_refused(bad):
    with pytest.raises(MeshError, match=next(iter(bad))):
        SolidSelection(close_gaps=0, **bad)


def test_default_is_half_an_optical_depth_per_voxel_at_any_resolution():
    """Solid where density x voxel size >= 0.5, so the same field gives the same body on a finer lattice."""
    for voxel in (0.5, 0.125):
        lattice = Lattice((0.0, 0.0, 0.0), voxel, (3, 2, 2))
        density = np.full((3, 2, 2), 0.501 / voxel, dtype=np.float32)
        density[0] = 0.45 / voxel  # the first voxel's centre is at 0.4755
        snapshot = GridSnapshot(lattice, density, np.zeros_like(density), np.ones_like(density))
        assert select_solid(snapshot, SolidSelection(close_gaps=0)).cells[:, 0, 0].tolist() == [False, True]
    with pytest.raises(MeshError, match="lower --voxel-optical-depth"):
        select_solid(snapshot, SolidSelection(close_gaps=0, voxel_optical_depth=0.55))
