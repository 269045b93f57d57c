from dataclasses import replace

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.mesh.build import MeshOptions, build_mesh
from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid, where_cameras_look
from thermoxels_ns.mesh.tetrahedra import FACET_BOX


def ring(target, radius: float, height: float, count: int = 24, degrees: float = 360.0, focal: float = 150.0) -> Views:
    """Cameras on an arc around the z axis that begins towards +x."""
    angle = np.radians(degrees) * np.arange(count) / count
    eyes = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)))
    return looking_at(target, eyes, focal)


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
    solid = select_solid(field(WIDE, TABLE | OBJECT | wall, ring((0.0, 0.0, 0.3), 1.6, 0.8)), AS_IT_IS)
    assert np.array_equal(solid.cells, TABLE | OBJECT) and np.array_equal(solid.left_out, wall)
    every = select_solid(
        field(WIDE, TABLE | OBJECT | wall, ring((0.0, 0.0, 0.3), 1.6, 0.8)), replace(AS_IT_IS, region="all")
    )
    assert np.array_equal(every.cells, TABLE | OBJECT | wall)


def test_a_ground_that_runs_on_ends_about_where_cameras_stood():
    ground = box(WIDE, (-9.0, -9.0, -0.5), (9.0, 9.0, 0.0))
    solid = select_solid(field(WIDE, ground | OBJECT, ring((0.0, 0.0, 0.3), 2.0, 1.0)), AS_IT_IS)
    assert (solid.cells >= OBJECT).all()
    away = np.hypot(*WIDE.cell_centres()[..., :2].transpose(3, 0, 1, 2))
    assert (solid.cells == ground | OBJECT)[away < 1.5].all() and not solid.cells[away > 3.5].any()
    assert (solid.cells | solid.left_out == ground | OBJECT).all()


def test_a_room_photographed_from_inside_stays_whole():
    lattice = Lattice.covering((-0.4, -0.4, -0.4), (5.4, 4.4, 2.9), 48)
    room = ~box(lattice, (0.0, 0.0, 0.0), (5.0, 4.0, 2.5))
    angle = 2.0 * np.pi * np.arange(24) / 24
    eyes = np.column_stack((2.5 + 1.2 * np.cos(angle), 2.0 + 1.0 * np.sin(angle), np.full(24, 1.4)))
    aims = np.column_stack((2.5 - 4.0 * np.cos(angle), 2.0 - 4.0 * np.sin(angle), np.full(24, 1.2)))
    views = [looking_at(aim, eye) for aim, eye in zip(aims, eyes)]
    views = Views(*(np.concatenate(part) for part in zip(*(vars(view).values() for view in views))))
    solid = select_solid(field(lattice, room, views), AS_IT_IS)
    inner = room & box(lattice, (-0.15, -0.15, -0.15), (5.15, 4.15, 2.65))
    assert np.mean(solid.cells[inner]) > 0.97


def test_cameras_that_look_at_nothing_leave_nothing_out():
    assert where_cameras_look(OBJECT, WIDE, looking_at((9.0, 0.0, 9.0), (4.0, 0.0, 4.0))).all()
    assert np.array_equal(select_solid(field(WIDE, OBJECT, None), AS_IT_IS).cells, OBJECT)


TURNED = np.array([[0.0, -2.0, 0.0, 10.0], [2.0, 0.0, 0.0, 20.0], [0.0, 0.0, 2.0, 30.0]])
"""From the lattice to input poses: a quarter turn around z, twice as large, and a shift."""


def test_a_box_and_a_point_are_in_the_coordinates_of_the_input_poses():
    snapshot = field(WIDE, TABLE | OBJECT, ring((0.0, 0.0, 0.3), 1.6, 0.8))
    # x of the lattice from -0.9 to 0 is y of the input from 18.2 to 20.
    half = replace(AS_IT_IS, region_box=(0.0, 18.0, 29.0, 20.0, 20.0, 40.0))
    solid = select_solid(snapshot, half, world_to_input=TURNED)
    left = WIDE.cell_centres()[..., 0] < 0.0
    assert np.array_equal(solid.cells, (TABLE | OBJECT) & left) and np.array_equal(
        solid.left_out, (TABLE | OBJECT) & ~left
    )
    near = replace(AS_IT_IS, region_near=(10.0, 20.0, 30.0, 1.0))
    ball = np.linalg.norm(WIDE.cell_centres(), axis=-1) < 0.5
    assert np.array_equal(select_solid(snapshot, near, world_to_input=TURNED).cells, (TABLE | OBJECT) & ball)


@pytest.mark.parametrize(
    "asked", [{"region_box": (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)}, {"region_near": (0.0, 0.0, 0.0, 1.0)}]
)
def test_a_region_without_solid_says_where_it_lies_and_the_remedy_works(asked):
    snapshot = field(WIDE, OBJECT, None)
    with pytest.raises(
        MeshError, match=f"^{next(iter(asked))}: expected .* from 9.2.* to .*, got none in 0 0 0 1"
    ) as found:
        select_solid(snapshot, replace(AS_IT_IS, **asked), world_to_input=TURNED)
    remedy = str(found.value).split("--region-box ")[1].split(",")[0]
    values = tuple(float(word) for word in remedy.split())
    solid = select_solid(snapshot, replace(AS_IT_IS, region_box=values), world_to_input=TURNED)
    assert np.array_equal(solid.cells, OBJECT)


def test_a_hollow_house_that_a_box_halves_is_filled_up_to_the_box():
    """What is left out still hides the inside from the cameras, so the half is as full as the whole would be."""
    shell = OBJECT & ~box(WIDE, (-0.2, -0.1, 0.2), (0.2, 0.1, 0.7))
    snapshot = field(WIDE, shell, ring((0.0, 0.0, 0.3), 1.6, 0.8))
    selection = SolidSelection(close_gaps=0, region_box=(-5.0, -5.0, -1.0, 0.0, 5.0, 3.0))
    left = WIDE.cell_centres()[..., 0] < 0.0
    assert np.array_equal(select_solid(snapshot, selection).cells, OBJECT & left)


@pytest.mark.parametrize("boundary", ["conforming", "voxel"])
def test_where_the_region_ends_the_boundary_is_cut(boundary):
    snapshot = field(WIDE, TABLE | OBJECT, ring((0.0, 0.0, 0.3), 1.6, 0.8))
    selection = SolidSelection(close_gaps=0, region_box=(-5.0, -5.0, -1.0, 0.0, 5.0, 3.0))
    mesh = build_mesh(snapshot, selection, np.eye(4), MeshOptions(boundary)).mesh
    at = mesh.points_m[mesh.facets].mean(axis=1)
    assert mesh.boundary is not None
    plane = (np.abs(at[:, 0]) < 0.6 * WIDE.voxel_size) & (mesh.boundary.normal[:, 0] > 0.9)
    cut = mesh.facet_tags == FACET_BOX
    assert plane.any() and cut[plane].all() and not cut[np.abs(at[:, 0]) > WIDE.voxel_size].any()
    assert mesh.boundary.patch_names[mesh.boundary.patch[cut][0]] == "cut"
