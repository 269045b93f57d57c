from dataclasses import replace

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence, Views
from thermoxels_ns.mesh.build import build_mesh
from thermoxels_ns.mesh.solid.voxels import SolidCells, SolidSelection, SolidStep, select_solid, where_cameras_look
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, facet_normals


def ring(radius: float = 1.6, height: float = 0.8) -> Views:
    """24 cameras around the z axis."""
    angle = 2.0 * np.pi * np.arange(24) / 24
    eyes = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), np.full(24, height)))
    return looking_at((0.0, 0.0, 0.3), eyes, focal=150.0)


def box(lattice: Lattice, low, high) -> np.ndarray:
    centres = lattice.cell_centres()
    return np.all((centres > low) & (centres < high), axis=-1)


def field(lattice: Lattice, cells: np.ndarray, views: Views | None) -> GridSnapshot:
    ones = np.ones(lattice.shape, dtype=np.float32)
    return GridSnapshot(lattice, ones, 20.0 * ones, ones, voxel_density=50.0 * cells.astype(np.float32), views=views)


WIDE = Lattice.covering((-5.0, -5.0, -0.5), (5.0, 5.0, 3.0), 64)
TABLE = box(WIDE, (-0.9, -0.9, -0.2), (0.9, 0.9, 0.0))
OBJECT = box(WIDE, (-0.4, -0.3, 0.0), (0.4, 0.3, 0.9))
AS_IT_IS = SolidSelection(close_gaps=0, interior="hollow")


def test_an_object_stays_with_its_table_and_the_wall_behind_goes():
    wall = box(WIDE, (-4.9, 4.4, -0.5), (4.9, 4.9, 3.0))
    solid = select_solid(field(WIDE, TABLE | OBJECT | wall, ring()), AS_IT_IS)
    assert np.array_equal(solid.cells, TABLE | OBJECT) and np.array_equal(solid.left_out, wall)


def test_a_ground_that_runs_on_ends_about_where_cameras_stood():
    ground = box(WIDE, (-9.0, -9.0, -0.5), (9.0, 9.0, 0.0))
    solid = select_solid(field(WIDE, ground | OBJECT, ring(2.0, 1.0)), AS_IT_IS)
    assert (solid.cells >= OBJECT).all()
    away = np.hypot(*WIDE.cell_centres()[..., :2].transpose(3, 0, 1, 2))
    assert (solid.cells == ground | OBJECT)[away < 1.5].all() and not solid.cells[away > 3.5].any()


def test_a_room_photographed_from_inside_stays_whole():
    lattice = Lattice.covering((-0.4, -0.4, -0.4), (5.4, 4.4, 2.9), 48)
    room = ~box(lattice, (0.0, 0.0, 0.0), (5.0, 4.0, 2.5))
    angle = 2.0 * np.pi * np.arange(24) / 24
    eyes = np.column_stack((2.5 + 1.2 * np.cos(angle), 2.0 + 1.0 * np.sin(angle), np.full(24, 1.4)))
    aims = np.column_stack((2.5 - 4.0 * np.cos(angle), 2.0 - 4.0 * np.sin(angle), np.full(24, 1.2)))
    solid = select_solid(field(lattice, room, looking_at(aims, eyes)), AS_IT_IS)
    inner = room & box(lattice, (-0.15, -0.15, -0.15), (5.15, 4.15, 2.65))
    assert np.mean(solid.cells[inner]) > 0.97


def test_cameras_that_look_at_nothing_leave_nothing_out():
    assert where_cameras_look(OBJECT, WIDE, looking_at((9.0, 0.0, 9.0), (4.0, 0.0, 4.0))).all()
    assert np.array_equal(select_solid(field(WIDE, OBJECT, None), AS_IT_IS).cells, OBJECT)


TURNED = np.array([[0.0, -2.0, 0.0, 10.0], [2.0, 0.0, 0.0, 20.0], [0.0, 0.0, 2.0, 30.0]])
"""From the lattice to input poses: a quarter turn around z, twice as large, and a shift."""


def test_a_box_and_a_point_are_in_the_coordinates_of_the_input_poses():
    snapshot = field(WIDE, TABLE | OBJECT, ring())
    # x of the lattice from -0.9 to 0 is y of the input from 18.2 to 20.
    half = replace(AS_IT_IS, region_box=(0.0, 18.0, 29.0, 20.0, 20.0, 40.0))
    solid = select_solid(snapshot, half, world_to_input=TURNED)
    left = WIDE.cell_centres()[..., 0] < 0.0
    assert np.array_equal(solid.cells, (TABLE | OBJECT) & left)
    assert np.array_equal(solid.left_out, (TABLE | OBJECT) & ~left)
    near = replace(AS_IT_IS, region_near=(10.0, 20.0, 30.0, 1.0))
    ball = np.linalg.norm(WIDE.cell_centres(), axis=-1) < 0.5
    assert np.array_equal(select_solid(snapshot, near, world_to_input=TURNED).cells, (TABLE | OBJECT) & ball)


@pytest.mark.parametrize(
    "asked", [{"region_box": (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)}, {"region_near": (0.0, 0.0, 0.0, 1.0)}]
)
def test_a_region_without_solid_says_where_it_lies_and_the_remedy_works(asked):
    snapshot = field(WIDE, OBJECT, None)
    with pytest.raises(MeshError, match=f"^{next(iter(asked))}: expected") as found:
        select_solid(snapshot, replace(AS_IT_IS, **asked), world_to_input=TURNED)
    remedy = str(found.value).split("--region-box ")[1].split(",")[0]
    values = tuple(float(word) for word in remedy.split())
    solid = select_solid(snapshot, replace(AS_IT_IS, region_box=values), world_to_input=TURNED)
    assert np.array_equal(solid.cells, OBJECT)


def test_the_solid_ends_where_rays_end_unless_the_user_chose_its_density():
    """Rays along x end at 6.7, in the first layer of a block, and at 2.7, in one of a lump that is then too small."""
    lattice = Lattice((0.0, 0.0, 0.0), 1.0, (21, 21, 21))
    block, lump = box(lattice, (6.0, 5.0, 5.0), (13.0, 15.0, 15.0)), box(lattice, (2.0, 1.0, 1.0), (4.0, 3.0, 3.0))
    across = np.arange(0.25, 20.0, 0.5)
    y, z = (values.ravel() for values in np.meshgrid(across, across))
    met = [((y > low) & (y < high) & (z > low) & (z < high), place) for low, high, place in ((5, 15, 6.7), (1, 3, 2.7))]
    ends = np.concatenate([np.column_stack((np.full(hit.sum(), place), y[hit], z[hit])) for hit, place in met])
    along = np.tile([1.0, 0.0, 0.0], (len(ends), 1))
    of_rays = (values.astype(np.float32) for values in (np.full(len(ends), 50.0), ends, along))
    whole = field(lattice, block | lump, None)
    snapshot = replace(whole, evidence=RayEvidence(*of_rays))
    solid = select_solid(snapshot, AS_IT_IS)
    first = box(lattice, (6.0, 0.0, 0.0), (7.0, 20.0, 20.0))
    assert np.array_equal(solid.cells, block & ~first) and solid.distance is not None
    assert solid.distance[6, 10, 10] == pytest.approx(0.2) and np.isnan(solid.distance[15, 10, 10])
    mesh = build_mesh(snapshot, AS_IT_IS, np.eye(4), "conforming").mesh
    x, y, z = mesh.points_m[np.unique(mesh.facets)].T
    front = x[(x < 8.0) & (np.abs(y - 10.0) < 3.0) & (np.abs(z - 10.0) < 3.0)]
    assert len(front) > 9 and front == pytest.approx(np.full(len(front), 6.7), abs=0.1)
    seen = replace(snapshot, views=looking_at((10.0, 10.0, 10.0), (-40.0, 10.0, 10.0)))
    wall = select_solid(seen, replace(AS_IT_IS, wall_thickness=9.0)).cells
    assert np.flatnonzero(wall[:, 10, 10]).tolist() == list(range(7, 16))  # as thick as asked from where rays end on
    asked = select_solid(snapshot, replace(AS_IT_IS, density_threshold=10.0))
    assert np.array_equal(asked.cells, block | lump) and asked.distance is None


def test_a_hollow_house_that_a_box_halves_is_filled_up_to_the_box():
    """What is left out still hides the inside from the cameras, so the half is as full as the whole would be."""
    shell = OBJECT & ~box(WIDE, (-0.2, -0.1, 0.2), (0.2, 0.1, 0.7))
    snapshot = field(WIDE, shell, ring())
    selection = SolidSelection(close_gaps=0, region_box=[-5.0, -5.0, -1.0, 0.0, 5.0, 3.0])  # type: ignore[arg-type]
    left = WIDE.cell_centres()[..., 0] < 0.0
    assert np.array_equal(select_solid(snapshot, selection).cells, OBJECT & left)


@pytest.mark.parametrize("boundary", ["conforming", "voxel"])
def test_where_the_region_ends_the_boundary_is_cut(boundary):
    snapshot = field(WIDE, TABLE | OBJECT, ring())
    selection = SolidSelection(close_gaps=0, region_box=(-5.0, -5.0, -1.0, 0.0, 5.0, 3.0))
    mesh = build_mesh(snapshot, selection, np.eye(4), boundary).mesh
    at = mesh.points_m[mesh.facets].mean(axis=1)
    plane = (np.abs(at[:, 0]) < 0.6 * WIDE.voxel_size) & (facet_normals(mesh.points_m, mesh.facets)[:, 0] > 0.9)
    cut = mesh.facet_tags == FACET_BOX
    assert plane.any() and cut[plane].all() and not cut[np.abs(at[:, 0]) > WIDE.voxel_size].any()
    assert mesh.boundary.patch_names[mesh.boundary.patch[cut][0]] == "cut"


def step_of(solid: SolidCells, name: str) -> SolidStep:
    (found,) = (step for step in solid.steps if step.name == name)
    return found


def along_x(snapshot_of, *density: float) -> GridSnapshot:
    """A row of voxels of these densities."""
    snapshot = snapshot_of(np.ones((len(density) + 1, 2, 2)))
    return replace(snapshot, voxel_density=np.array(density, dtype=np.float32)[:, None, None])


@pytest.mark.parametrize("percentile", [50.0, 99.0])
def test_percentile_keeps_the_densest_share_of_all_voxels(snapshot_of, percentile):
    density = np.random.default_rng(0).random((11, 11, 11))
    snapshot = snapshot_of(density)
    solid = select_solid(snapshot, SolidSelection(close_gaps=0, density_percentile=percentile, region="all"))
    centre = snapshot.centre_density()
    assert solid.cells.sum() == pytest.approx(1000 * (1 - percentile / 100), abs=1)
    assert centre[solid.cells].min() >= solid.threshold > centre[~solid.cells].max()


@pytest.mark.parametrize("scale", [1e-30, 1e30, 3e38])
def test_selection_does_not_depend_on_the_scale_of_density(snapshot_of, scale):
    """3e38: the sum of eight corners overflows float32."""
    pattern, selection = np.random.default_rng(3).random((9, 9, 9)), SolidSelection(density_percentile=90.0)
    expected, scaled = (select_solid(snapshot_of(pattern * by), selection) for by in (1.0, scale))
    assert np.isfinite(scaled.threshold) and np.array_equal(scaled.cells, expected.cells)


def test_zero_density_is_never_solid(snapshot_of):
    snapshot = along_x(snapshot_of, 0, 0, 0, 5)
    for selection in (SolidSelection(close_gaps=0, density_percentile=0.0), SolidSelection(density_threshold=0.0)):
        assert select_solid(snapshot, selection).cells[:, 0, 0].tolist() == [False, False, False, True]


def test_empty_names_threshold_maximum_and_remedy(snapshot_of):
    with pytest.raises(MeshError, match=r"threshold 9.*highest density.*is 3\..*--density-threshold"):
        select_solid(snapshot_of(np.full((3, 3, 3), 3.0)), SolidSelection(density_threshold=9.0))
    with pytest.raises(MeshError, match="none of 8"):
        select_solid(snapshot_of(np.zeros((3, 3, 3))), SolidSelection(density_percentile=90.0))


def test_floaters_go_unless_all_is_asked_for(snapshot_of):
    cells = np.zeros((14, 10, 10), dtype=bool)
    cells[:10] = True
    cells[12, 3, 3] = True
    snapshot = replace(snapshot_of(np.ones((15, 11, 11))), voxel_density=cells.astype(np.float32))
    solid = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=1.0))
    assert np.argwhere(solid.left_out).tolist() == [[12, 3, 3]] and np.array_equal(solid.left_out, cells & ~solid.cells)
    assert solid.within.all()
    assert (step_of(solid, "region").removed, step_of(solid, "region").added) == (1, 0)
    every = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=1.0, region="all"))
    assert np.array_equal(every.cells, cells) and step_of(every, "region").removed == 0 and not every.left_out.any()


def test_gaps_are_closed_and_wide_ones_are_not(snapshot_of):
    snapshot = along_x(snapshot_of, 5, 0, 0, 5, 0, 0, 0, 5)
    one = select_solid(snapshot, SolidSelection(density_threshold=1.0))
    assert np.flatnonzero(one.cells).tolist() == [0, 1, 2, 3, 7] and step_of(one, "close gaps").added == 2


def test_cavities_are_filled_unless_the_body_is_to_stay_hollow(snapshot_of):
    density = np.ones((8, 8, 8))
    density[3:5, 3:5, 3:5] = 0.0
    snapshot = snapshot_of(density)
    hollow = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=0.4, interior="hollow"))
    filled = select_solid(snapshot, SolidSelection(close_gaps=0, density_threshold=0.4))
    assert filled.cells.all() and step_of(filled, "interior").added == 7**3 - hollow.cells.sum() > 0
    assert [step.name for step in hollow.steps] == ["threshold", "region"]


@pytest.fixture
def facade(snapshot_of) -> GridSnapshot:
    """A plate one voxel of 0.5 thick that three cameras see from +x, across the lattice."""
    density = np.zeros((17, 17, 17))
    density[9:11] = 20.0
    eyes = [(30.0, 4.0, 4.0), (30.0, 6.0, 4.0), (30.0, 4.0, 6.0)]
    return replace(snapshot_of(density), views=looking_at((4.0, 4.0, 4.0), eyes))


def test_a_wall_thickness_is_in_metres_and_takes_the_place_of_filling(facade):
    assert select_solid(facade, SolidSelection(close_gaps=0, density_threshold=15.0)).cells.sum(axis=0).max() == 1
    thick = select_solid(facade, SolidSelection(close_gaps=0, density_threshold=15.0, wall_thickness=0.4), 0.2)
    assert (thick.cells[:, 6:10, 6:10].sum(axis=0) == 4).all() and thick.cells[6:10, 8, 8].all()  # 0.4 m = 4 voxels
    assert [step.name for step in thick.steps] == ["threshold", "region", "wall"]
    assert "0.4 m thick (4 voxels)" in step_of(thick, "wall").remark


def test_a_wall_thicker_than_the_scene_is_refused(facade):
    with pytest.raises(MeshError, match=r"^wall_thickness"):
        select_solid(facade, SolidSelection(wall_thickness=50.0), 0.2)
