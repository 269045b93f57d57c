from dataclasses import replace

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.solid.voxels import SolidCells, SolidSelection, SolidStep, select_solid


def step_of(solid: SolidCells, name: str) -> SolidStep:
    (found,) = (step for step in solid.steps if step.name == name)
    return found


def cells_along_x(values: list[float]) -> np.ndarray:
    """Corner densities of a row of voxels whose centres have the given densities: alternate layers solve the mean."""
    layers = [0.0]
    for value in values:
        layers.append(2.0 * value - layers[-1])
    return np.broadcast_to(np.array(layers, dtype=np.float32)[:, None, None], (len(layers), 2, 2))


@pytest.mark.parametrize("percentile", [50.0, 75.0, 90.0, 99.0])
def test_percentile_keeps_the_densest_share_of_all_voxels(snapshot_of, percentile):
    density = np.random.default_rng(0).random((11, 11, 11))
    snapshot = snapshot_of(density)
    solid = select_solid(snapshot, SolidSelection(close_gaps=0, density_percentile=percentile, region="all"))
    centre = snapshot.lattice.corner_to_cell_mean(snapshot.density)
    assert solid.cells.sum() == pytest.approx(1000 * (1 - percentile / 100), abs=1)
    assert centre[solid.cells].min() > centre[~solid.cells].max()
    assert centre[solid.cells].min() >= solid.threshold > centre[~solid.cells].max()


def test_zero_density_is_never_solid(snapshot_of):
    snapshot = snapshot_of(cells_along_x([0, 0, 0, 5]))
    for selection in (SolidSelection(close_gaps=0, density_percentile=0.0), SolidSelection(density_threshold=0.0)):
        assert select_solid(snapshot, selection).cells[:, 0, 0].tolist() == [False, False, False, True]


def test_empty_names_threshold_maximum_and_remedy(snapshot_of):
    with pytest.raises(MeshError, match=r"threshold 9.*highest density.*is 3\..*--density-threshold"):
        select_solid(snapshot_of(np.full((3, 3, 3), 3.0)), SolidSelection(close_gaps=0, density_threshold=9.0))
    with pytest.raises(MeshError, match="none of 8; the highest density"):
        select_solid(snapshot_of(np.zeros((3, 3, 3))), SolidSelection(close_gaps=0, density_percentile=90.0))


def test_floaters_go_unless_all_is_asked_for(snapshot_of, corner_density):
    cells = np.zeros((14, 10, 10), dtype=bool)
    cells[:10] = True
    cells[12, 3, 3] = True
    snapshot = snapshot_of(corner_density(cells))
    solid = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=1.0))
    assert np.array_equal(solid.cells, cells & (np.arange(14) < 10)[:, None, None])
    assert solid.component_sizes.tolist() == [1000, 1]
    region = step_of(solid, "region")
    assert (region.removed, region.added) == (1, 0) and "1 of 2 bodies in it have less than 1%" in region.remark
    assert np.array_equal(solid.left_out, cells & ~solid.cells) and solid.within.all()
    every = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=1.0, region="all"))
    assert np.array_equal(every.cells, cells) and step_of(every, "region").removed == 0 and not every.left_out.any()


def test_gaps_are_closed_and_wide_ones_are_not(snapshot_of):
    snapshot = snapshot_of(cells_along_x([5, 0, 0, 5, 0, 0, 0, 5]))
    one = select_solid(snapshot, SolidSelection(density_threshold=1.0))
    assert np.flatnonzero(one.cells).tolist() == [0, 1, 2, 3, 7] and step_of(one, "close gaps").added == 2


def test_cavities_are_filled_unless_the_body_is_to_stay_hollow(snapshot_of):
    density = np.ones((8, 8, 8))
    density[3:5, 3:5, 3:5] = 0.0
    snapshot = snapshot_of(density)
    hollow = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=0.4, interior="hollow"))
    filled = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=0.4))
    missing = 7**3 - int(hollow.cells.sum())
    assert missing > 0
    assert filled.cells.all()
    assert step_of(filled, "interior").added == missing
    assert f"{missing} voxels of enclosed cavities are filled; the cameras" in step_of(filled, "interior").remark
    assert [step.name for step in hollow.steps] == ["threshold", "region"]


@pytest.fixture
def facade(snapshot_of) -> GridSnapshot:
    """A plate one voxel of 0.5 thick that three cameras see from +x, across the lattice."""
    density = np.zeros((17, 17, 17))
    density[9:11] = 20.0
    eyes = [(30.0, 4.0, 4.0), (30.0, 6.0, 4.0), (30.0, 4.0, 6.0)]
    return replace(snapshot_of(density), views=looking_at((4.0, 4.0, 4.0), eyes))


def test_a_wall_thickness_is_in_metres_and_takes_the_place_of_filling(facade):
    thin = select_solid(facade, SolidSelection(close_gaps=0, density_threshold=15.0))
    assert thin.cells.sum(axis=0).max() == 1
    thick = select_solid(facade, SolidSelection(close_gaps=0, density_threshold=15.0, wall_thickness=0.4), 0.2)
    assert (thick.cells[:, 6:10, 6:10].sum(axis=0) == 4).all() and thick.cells[6:10, 8, 8].all()  # 0.4 m = 4 voxels
    assert [step.name for step in thick.steps] == ["threshold", "region", "wall"]
    wall = step_of(thick, "wall")
    assert wall.added == thick.cells.sum() - thin.cells.sum() and "0.4 m thick (4 voxels)" in wall.remark


def test_a_wall_thickness_needs_a_scale_and_cameras(facade):
    selection = SolidSelection(wall_thickness=0.3)
    with pytest.raises(MeshError, match=r"wall_thickness.*scale is known.*--metres-per-unit"):
        select_solid(facade, selection)
    with pytest.raises(MeshError, match="metres_per_world_unit"):
        select_solid(facade, selection, 0.0)
    with pytest.raises(MeshError, match=r"wall_thickness: expected at most the scene box, .* m, got 50 m"):
        select_solid(facade, SolidSelection(wall_thickness=50.0), 0.2)
    with pytest.raises(MeshError, match=r"wall_thickness.*training cameras.*leave out --wall-thickness"):
        select_solid(replace(facade, views=None), selection, 1.0)


@pytest.mark.parametrize(
    "bad",
    [
        {"density_percentile": -1.0},
        {"density_threshold": -0.1},
        {"voxel_optical_depth": 0.0},
        {"close_gaps": -1},
        {"seal_openings": -1},
        {"region": "some"},
        {"region_box": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0)},
        {"region_box": (0.0, 0.0, float("nan"), 1.0, 1.0, 1.0)},
        {"region_near": (0.0, 0.0, 0.0, 0.0)},
        {"region_near": (0.0, 0.0, float("inf"), 1.0)},
        {"interior": "filled"},
        {"wall_thickness": 0.0},
    ],
)
def test_bad_selection_is_refused(bad):
    with pytest.raises(MeshError, match=f"^{next(iter(bad))}: expected .*, got .*"):
        SolidSelection(**bad)


def test_without_rays_the_default_is_half_an_optical_depth_per_voxel_at_any_resolution():
    """Solid where density x voxel size >= 0.5, so the same field gives the same body on a finer lattice."""
    for voxel in (0.5, 0.125):
        lattice = Lattice((0.0, 0.0, 0.0), voxel, (3, 2, 2))
        density = np.full((3, 2, 2), 0.501 / voxel, dtype=np.float32)
        density[0] = 0.45 / voxel  # the first voxel's centre is at 0.4755
        snapshot = GridSnapshot(lattice, density, np.zeros_like(density), np.ones_like(density))
        assert select_solid(snapshot, SolidSelection(close_gaps=0)).cells[:, 0, 0].tolist() == [False, True]
    with pytest.raises(MeshError, match="lower --voxel-optical-depth"):
        select_solid(snapshot, SolidSelection(close_gaps=0, voxel_optical_depth=0.55))
