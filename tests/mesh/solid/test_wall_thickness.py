from dataclasses import astuple

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.interior import wall_behind

N = 24
LATTICE = Lattice((0.0, 0.0, 0.0), 0.5, (N + 1, N + 1, N + 1))
FRONT = [(40.0, 6.0, 6.0), (40.0, 9.0, 4.0), (35.0, 4.0, 7.0)]
BACK = [(-28.0, 6.0, 6.0), (-28.0, 9.0, 4.0)]


def plate(layers: int = 1) -> np.ndarray:
    cells = np.zeros((N, N, N), dtype=bool)
    cells[12 : 12 + layers, 2:22, 2:22] = True
    return cells


@pytest.mark.parametrize("thickness", [1.0, 2.0, 3.4, 5.0, 8.0])
@pytest.mark.parametrize("layers", [1, 2])
def test_a_plate_seen_from_one_side_grows_to_the_thickness_on_the_other(thickness, layers):
    cells = plate(layers)
    added = wall_behind(cells, LATTICE, looking_at((6.0, 6.0, 6.0), FRONT), thickness)
    assert not (added & cells).any()
    middle = (cells | added)[:, 10:14, 10:14]
    thick = middle.sum(axis=0)
    assert (np.abs(thick - max(thickness, layers)) <= 0.51).all()
    assert not added[12 + layers :].any()  # never towards the cameras
    assert added[:12].any() == (thickness >= layers + 0.5)


def test_a_plate_seen_from_both_sides_does_not_grow():
    for eyes in (FRONT + BACK, FRONT[:1] + BACK[:1]):
        added = wall_behind(plate(), LATTICE, looking_at((6.0, 6.0, 6.0), eyes), 6.0)
        assert added[:, 4:20, 4:20].sum() == 0


def test_space_that_cameras_look_through_stays_empty():
    """A second plate shades half of the space behind the first; a camera behind looks through the other half."""
    cells = plate()
    views = looking_at((3.0, 6.0, 6.0), [*FRONT, (-28.0, 6.0, 30.0)])
    added = wall_behind(cells, LATTICE, views, 5.0)
    assert not added.any() or not added[:12, 8:16, 14:20].any()
    cells[2, :, :] = True  # now nothing can be seen between them
    assert wall_behind(cells, LATTICE, views, 5.0)[8:12, 8:16, 8:16].all()


def test_it_does_not_reach_a_shadow_beyond_seen_space():
    """A camera looks along the back of the plate through a slot three voxels wide; nobody looks behind that slot."""
    front = looking_at((6.0, 6.0, 6.0), FRONT[:1])
    slot = looking_at((5.25, 6.0, 6.0), (5.25, -30.0, 6.0), focal=4800.0)
    both = Views(*(np.concatenate(pair) for pair in zip(astuple(front), astuple(slot), strict=True)))
    behind = wall_behind(plate(), LATTICE, front, 6.0)[:, 10:14, 12]
    assert behind[7:12].all()
    assert not wall_behind(plate(), LATTICE, both, 6.0)[:, 10:14, 12].any()
