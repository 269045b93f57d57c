from dataclasses import astuple

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import Delaunay

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid import interior as interior_module
from thermoxels_ns.mesh.solid.interior import interior, wall_behind, winding_number
from thermoxels_ns.mesh.solid.morphology import convex_hull

N = 24
LATTICE = Lattice((0.0, 0.0, 0.0), 1.0, (N + 1, N + 1, N + 1))
MIDDLE = (N / 2, N / 2, N / 2)


def box(lo: int, hi: int) -> np.ndarray:
    cells = np.zeros((N, N, N), dtype=bool)
    cells[lo:hi, lo:hi, lo:hi] = True
    return cells


def cup(walls: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A box whose lower side is missing, as photographs from above leave it; and its inside."""
    cells, inside = box(5, 19), box(5 + walls, 19 - walls)
    inside[:, :, 5 : 5 + walls] = inside[:, :, [10]]
    return cells & ~inside, inside


def around(count: int = 12, height: float = 30.0) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return np.column_stack((12 + 60 * np.cos(angle), 12 + 60 * np.sin(angle), np.full(count, height)))


def test_a_closed_cavity_is_inside_with_or_without_cameras():
    shell = box(5, 19) & ~box(7, 17)
    for views in (None, looking_at(MIDDLE, around())):
        found = interior(shell, LATTICE, views, 0)
        assert np.array_equal(found, box(7, 17))


def test_a_cavity_with_a_camera_in_it_is_a_room():
    rooms = box(2, 22) & ~box(3, 10)
    rooms[13:20, 13:20, 13:20] = False  # a second one, without a camera
    inside_one = looking_at((8.0, 8.0, 8.0), [(4.5, 5.0, 6.0), (8.5, 4.0, 6.0)])
    found = interior(rooms, LATTICE, inside_one, 1)
    assert not found[3:10, 3:10, 3:10].any()
    assert found[13:20, 13:20, 13:20].all() and found.sum() == 7**3


def test_a_camera_in_an_alcove_is_in_the_room():
    rooms = box(2, 22) & ~box(6, 14)
    rooms[14:18, 8:10, 8:10] = False
    rooms[:6, 10, 10] = False  # the room has a keyhole, so that only sealing makes it a cavity
    for end in (14.5, 15.5, 17.5):
        found = interior(rooms, LATTICE, looking_at((10.0, 10.0, 10.0), (end, 9.0, 9.0)), 2)
        assert not found.any()


@pytest.mark.parametrize("width", [1, 2, 3, 4, 5])
def test_openings_are_sealed_up_to_twice_the_width(width):
    shell = box(4, 20) & ~box(6, 18)
    shell[4:6, 10 : 10 + width, 10 : 10 + width] = False
    for seal in (1, 2):
        found = interior(shell, LATTICE, None, seal)
        if width > 2 * seal:
            assert not found.any()
        else:
            assert (found | shell)[box(4, 20)].all() and not found[~box(4, 20)].any()
    assert not interior(shell, LATTICE, None, 0).any()


def test_what_the_shell_hides_from_all_cameras_is_inside_even_if_it_is_open_where_none_looks():
    cells, inside = cup()
    found = interior(cells, LATTICE, looking_at(MIDDLE, around()), 0)
    assert np.array_equal(found, inside)  # the shadow below it lies outside of its hull
    assert not interior(cells, LATTICE, None, 2).any()
    into = interior(cells, LATTICE, looking_at(MIDDLE, around(height=-60.0)), 0)  # what cameras look into is not
    assert into[inside].mean() < 0.35 and not into[11:13, 11:13, 5:12].any()
    for corner in ((5, 5), (18, 18)):  # a few strays below do not make it deeper
        cells[(*corner, slice(3, 5))] = True
    assert inside[:, :, 5].any() and not inside[:, :, :5].any()
    assert np.array_equal(interior(cells, LATTICE, looking_at(MIDDLE, around()), 0), found)
    assert convex_hull(cells)[:, :, 3:5].sum() > 10  # what would be filled


def test_a_facade_seen_from_one_side_is_filled_as_deep_as_its_sides_go():
    """Hardly half of what surrounds its inside is seen; with a winding number of 0.5 a quarter of it stays empty."""
    cells, inside = (np.zeros((N, N, N), dtype=bool) for _ in range(2))
    cells[11:19, 4:20, 4:20], inside[11:17, 6:18, 4:18] = True, True
    eyes = [(70.0, y, z) for y in (-60.0, -30.0, 0.0, 12.0, 24.0, 54.0, 84.0) for z in (14.0, 60.0)]
    found = interior(cells & ~inside, LATTICE, looking_at(MIDDLE, eyes), 0)
    assert found[inside].mean() > 0.99 and not found[~inside].any()


def test_a_plate_and_two_bodies_side_by_side_have_no_inside():
    plate = np.zeros((N, N, N), dtype=bool)
    plate[12] = True
    one_side = looking_at(MIDDLE, [(60.0, 12.0, 12.0), (60.0, 20.0, 12.0)])
    assert not interior(plate, LATTICE, one_side, 1).any()
    two = box(3, 8)
    two[14:19, 14:19, 14:19] = True
    found = interior(two, LATTICE, looking_at(MIDDLE, [(-60.0, -60.0, -60.0)]), 1)
    assert not found.any()  # the shadow between them is in neither hull


def test_blocks_give_the_same_inside(monkeypatch):
    """Large lattices are looked at in blocks; no gap opens between the shell and what is filled, in odd places too."""
    views = looking_at(MIDDLE, around())
    cells, inside = cup(3)
    for shift in ((0, 0, 0), (1, 0, 1)):
        shell, expected = np.roll(cells, shift, (0, 1, 2)), np.roll(inside, shift, (0, 1, 2))
        monkeypatch.setattr(interior_module, "LARGEST_PASS", N**3 - 1)
        found = interior(shell, LATTICE, views, 0)
        assert not found[shell].any()
        # Along the open side the hull ends in the middle of a block.
        expected[:, :, : 6 + shift[2]] = found[:, :, : 6 + shift[2]] = False
        assert np.array_equal(found, expected)


def test_the_long_shadow_between_posts_on_a_plate_is_not_their_inside(monkeypatch):
    """It is hidden and within the hull, but next to it there is more air than surface."""
    lattice = Lattice((0.0, 0.0, 0.0), 1.0, (73, 25, 25))
    cells = np.zeros(lattice.cell_shape, dtype=bool)
    cells[2:70, 9:15, :2] = cells[2:5, 9:15, :10] = cells[67:70, 9:15, :10] = True
    views = looking_at((36.0, 12.0, 5.0), [(500.0, y, 6.0) for y in np.linspace(9.0, 15.0, 7)])
    between = (slice(16, 56), slice(9, 15), slice(6, 10))
    assert interior(cells, lattice, views, 0)[between].mean() < 0.05
    monkeypatch.setattr(interior_module, "SHADOW_SURROUNDED", -1.0)
    assert interior(cells, lattice, views, 0)[between].mean() > 0.8


def test_under_a_table_on_legs_there_is_air_if_cameras_see_it():
    table = np.zeros((N, N, N), dtype=bool)
    table[5:19, 5:19, 16:18] = True
    for x in (5, 16):
        for y in (5, 16):
            table[x : x + 3, y : y + 3, 4:16] = True
    eyes = np.vstack((around(16, 8.0), around(8, 40.0)))
    for seal in (0, 1, 2):
        found = interior(table, LATTICE, looking_at(MIDDLE, eyes), seal)
        assert not found.any()


def test_a_courtyard_stays_open_and_the_building_around_it_is_filled():
    building = np.zeros((N, N, N), dtype=bool)
    building[3:21, 3:21, 3:12] = True
    building[8:16, 8:16, 5:] = False
    inside = ndimage.binary_erosion(building)
    turn = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    eyes = np.column_stack((12 + 30 * np.cos(turn), 12 + 30 * np.sin(turn), np.full(20, 80.0)))
    for seal in (0, 1):
        found = interior(building & ~inside, LATTICE, looking_at(MIDDLE, eyes), seal)
        assert inside.sum() > 500 and np.array_equal(found, inside)


FRONT = [(80.0, 12.0, 12.0), (80.0, 18.0, 8.0), (70.0, 8.0, 14.0)]
BACK = [(-56.0, 12.0, 12.0), (-56.0, 18.0, 8.0)]


def plate(layers: int = 1) -> np.ndarray:
    cells = np.zeros((N, N, N), dtype=bool)
    cells[12 : 12 + layers, 2:22, 2:22] = True
    return cells


@pytest.mark.parametrize("thickness", [1.0, 2.0, 3.4, 5.0, 8.0])
@pytest.mark.parametrize("layers", [1, 2])
def test_a_plate_seen_from_one_side_grows_to_the_thickness_on_the_other(thickness, layers):
    cells = plate(layers)
    added = wall_behind(cells, LATTICE, looking_at(MIDDLE, FRONT), thickness)
    assert not (added & cells).any()
    thick = (cells | added)[:, 10:14, 10:14].sum(axis=0)
    assert (np.abs(thick - max(thickness, layers)) <= 0.51).all()
    assert not added[12 + layers :].any()  # never towards the cameras
    assert added[:12].any() == (thickness >= layers + 0.5)


def test_a_plate_seen_from_both_sides_does_not_grow():
    for eyes in (FRONT + BACK, FRONT[:1] + BACK[:1]):
        added = wall_behind(plate(), LATTICE, looking_at(MIDDLE, eyes), 6.0)
        assert added[:, 4:20, 4:20].sum() == 0


def test_space_that_cameras_look_through_stays_empty():
    """A second plate shades half of the space behind the first; a camera behind looks through the other half."""
    cells = plate()
    views = looking_at((6.0, 12.0, 12.0), [*FRONT, (-56.0, 12.0, 60.0)])
    added = wall_behind(cells, LATTICE, views, 5.0)
    assert not added.any() or not added[:12, 8:16, 14:20].any()
    cells[2, :, :] = True  # now nothing can be seen between them
    assert wall_behind(cells, LATTICE, views, 5.0)[8:12, 8:16, 8:16].all()


def test_it_does_not_reach_a_shadow_beyond_seen_space():
    """A camera looks along the back of the plate through a slot three voxels wide; nobody looks behind that slot."""
    front = looking_at(MIDDLE, FRONT[:1])
    slot = looking_at((10.5, 12.0, 12.0), (10.5, -60.0, 12.0), focal=4800.0)
    both = Views(*(np.concatenate(pair) for pair in zip(astuple(front), astuple(slot), strict=True)))
    assert wall_behind(plate(), LATTICE, front, 6.0)[7:12, 10:14, 12].all()
    assert not wall_behind(plate(), LATTICE, both, 6.0)[:, 10:14, 12].any()


@pytest.mark.parametrize("seed", range(3))
def test_a_hull_holds_the_voxels_whose_centres_a_triangulation_of_centres_holds(seed):
    cells = np.random.default_rng(seed).random((12, 9, 10)) < 0.02
    cells[6, 4, 5] = True
    inside = Delaunay(np.argwhere(cells)).find_simplex(np.argwhere(np.ones_like(cells))) >= 0
    assert np.array_equal(convex_hull(cells).ravel(), inside)


@pytest.mark.parametrize("lo", [12, 13])
def test_a_cube_without_one_of_its_sides_surrounds_its_middle_five_sixths(lo):
    solid, cube, middle = np.zeros((48, 48, 48), dtype=bool), slice(lo, lo + 24), slice(lo + 11, lo + 13)
    solid[cube, cube, cube] = True
    air = ~solid
    air[cube, cube, :lo] = False  # nothing is known of what is below
    assert winding_number(solid, air)[middle, middle, middle].mean() == pytest.approx(5 / 6, abs=0.02)
