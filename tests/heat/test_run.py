from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.scene_bodies import Z_UP, room, tagged_body, wall
from thermoxels_ns.fem.problem import TimeSteps
from thermoxels_ns.heat.run import patch_warnings, unused_settings
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.heat.scene_fields import InsideAir, OutsideAir
from thermoxels_ns.mesh.tetrahedra import TetMesh

CONCRETE = {"*": CONCRETE}
AIRS = {"inside_air": InsideAir(20.0, "iso-6946-combined"), "outside_air": OutsideAir(0.0, "iso-6946-combined")}


def filled() -> TetMesh:
    """A solid block that stands on the ground: only its underside was not seen."""
    outside = np.ones((5, 5, 5), dtype=bool)
    outside[:, :, 0] = False
    return tagged_body(np.ones((3, 3, 3), dtype=bool), 1.0, outside)


def test_rooms_and_walls_are_trusted() -> None:
    scene = HeatScene(CONCRETE, **AIRS)
    assert patch_warnings(scene, room(), Z_UP) == () and patch_warnings(scene, wall(), Z_UP) == ()


def test_a_filled_body_has_no_rooms() -> None:
    (warning,) = patch_warnings(HeatScene(CONCRETE, **AIRS), filled(), Z_UP)
    assert "of the 9 m² that no photograph saw" in warning and "--interior hollow" in warning and "--patches" in warning


def test_a_room_seen_from_within_is_inside_out() -> None:
    scene = HeatScene(CONCRETE, **AIRS)
    (warning,) = patch_warnings(scene, room(from_within=True), Z_UP)
    assert "faces inwards" in warning and 'patches: ["exterior-*"] to the inside air' in warning
    turned = {name: replace(air, patches=(where,)) for (name, air), where in zip(AIRS.items(), ("ext*", "int*"))}
    assert patch_warnings(HeatScene(CONCRETE, **turned), room(from_within=True), Z_UP) == ()


@pytest.mark.parametrize("up", [(1.0, 0.0, 0.0), (0.0, -3.0, 0.0)])
def test_up_decides_what_an_underside_is(up) -> None:
    """What faces down as the mesh was made is a wall if another direction is up."""
    assert patch_warnings(HeatScene(CONCRETE, **AIRS), filled(), up) == ()


def test_a_start_that_a_steady_state_does_not_know_is_named() -> None:
    (said,) = unused_settings(HeatScene(CONCRETE, initial_c=15.0, **AIRS))
    assert "initial temperature of 15 degrees" in said and "initial changes nothing" in said
    assert unused_settings(HeatScene(CONCRETE, **AIRS)) == ()
    assert unused_settings(HeatScene(CONCRETE, TimeSteps(2, 60.0), initial_c=15.0, **AIRS)) == ()
