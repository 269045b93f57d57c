from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, Z_UP, box_mesh, mesh_from, planes, room, tagged_body, wall
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, TimeSteps
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, HeatFlux
from thermoxels_ns.heat.run import (
    air_warnings,
    body_warnings,
    inner_surface_warnings,
    patch_warnings,
    place_probes,
    run_scene,
    shell_warnings,
)
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.heat.scene_fields import OUTSIDE, InsideAir, OutsideAir
from thermoxels_ns.heat.solving import Goals
from thermoxels_ns.mesh.tetrahedra import TetMesh

CONCRETE = {"*": CONCRETE}
AIRS = {"inside_air": InsideAir(20.0, "iso-6946-combined"), "outside_air": OutsideAir(0.0, "iso-6946-combined")}


def filled() -> TetMesh:
    """A solid block that stands on the ground: only its underside was not seen."""
    outside = np.ones((5, 5, 5), dtype=bool)
    outside[:, :, 0] = False
    return tagged_body(np.ones((3, 3, 3), dtype=bool), 1.0, outside)


@pytest.mark.parametrize("up", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
def test_a_filled_body_has_no_rooms_and_rooms_and_walls_are_trusted(up) -> None:
    """What faces down as the mesh was made is a wall if another direction is up."""
    scene = HeatScene(CONCRETE, **AIRS)
    assert patch_warnings(scene, room(), Z_UP) == patch_warnings(scene, wall(), Z_UP) == ()
    assert patch_warnings(scene, filled(), up) == ()
    (warning,) = patch_warnings(scene, filled(), Z_UP)
    assert "of the 9 m² that no photograph saw" in warning and "--interior hollow" in warning and "--patches" in warning


def test_a_room_seen_from_within_is_inside_out() -> None:
    scene = HeatScene(CONCRETE, **AIRS)
    (warning,) = patch_warnings(scene, room(from_within=True), Z_UP)
    assert "faces inwards" in warning and 'patches: ["exterior-*"] to the inside air' in warning
    turned = {name: replace(air, patches=(where,)) for (name, air), where in zip(AIRS.items(), ("ext*", "int*"))}
    assert patch_warnings(HeatScene(CONCRETE, **turned), room(from_within=True), Z_UP) == ()


def test_the_rim_of_a_hole_is_no_spot_of_the_inner_surface() -> None:
    """A plate whose inner and outer patch meet at an edge: the edge is named, and no temperature factor is its."""
    mesh = box_mesh(planes(0.0, 0.2, step=0.1), planes(0.0, 2.0, step=0.25), planes(0.0, 2.0, step=0.25))
    airs = {
        "inside_air": InsideAir(20.0, coefficient_w_m2k=8.0, patches=("x0",)),
        "outside_air": OutsideAir(0.0, coefficient_w_m2k=25.0, patches=("x1", "y0")),
    }
    scene = HeatScene(CONCRETE, adiabatic=("y1", "z0", "z1"), **airs)
    run = run_scene(scene, mesh, Goals())
    (warning,) = [one for one in run.warnings if "rims of holes" in one]
    assert warning.startswith("9 of the 81 nodes of the inner surface")
    edge = (mesh.points_m[:, 0] == 0.0) & (mesh.points_m[:, 1] == 0.0)
    assert run.wall is not None and run.wall.coldest.point_m[1] == 0.25
    assert run.wall.temperature_factor > run.solution.temperature_c[edge].max() / 20.0 + 0.1
    apart = replace(scene, outside_air=replace(airs["outside_air"], patches=("x1",)), adiabatic=("y*", "z*"))
    assert inner_surface_warnings(apart, mesh, Z_UP) == ((), ())


def test_a_room_without_a_floor_is_named() -> None:
    scene = HeatScene(CONCRETE, **AIRS)
    assert inner_surface_warnings(scene, room(), Z_UP) == ((), ())
    missing = with_named_patch(room(), "interior-up", "floor")
    cellar = replace(scene, adiabatic=("floor",))  # no air touches it, and yet it is a floor
    assert inner_surface_warnings(cellar, missing, Z_UP) == ((), ())
    air = scene.outside_air
    outside = replace(scene, outside_air=replace(air, patches=(*air.patches, "floor")))
    warnings, _ = inner_surface_warnings(outside, missing, Z_UP)
    assert any("a floor of 0 m²: most of the floor is missing" in warning for warning in warnings)


def with_named_patch(mesh: TetMesh, of: str, name: str) -> TetMesh:
    """The mesh with a patch of another name, as a user's rules give it; photographs show what is exterior."""
    tags, patterns = mesh.boundary, np.array(mesh.boundary.patch_names)
    patch = np.where(patterns[tags.patch] == of, len(patterns), tags.patch)
    seen = np.char.startswith(patterns[tags.patch], "exterior")
    return replace(mesh, boundary=replace(tags, patch=patch, patch_names=(*patterns, name), seen=seen))


@pytest.mark.parametrize("of", ["exterior-side", "interior-side"])
def test_airs_act_on_the_named_patches_of_their_side(of) -> None:
    """A named patch changes nothing, but where another entry of the scene names it."""
    scene, named = HeatScene(CONCRETE, **AIRS), with_named_patch(room(), of, "front")
    plain, found = (run_scene(scene, mesh, Goals()).wall for mesh in (room(), named))
    assert plain is not None and found is not None and found.heat_w == pytest.approx(plain.heat_w, rel=1e-12)
    own = replace(scene, convection=(Convection(("front",), 8.0, 0.0),))
    assert "front" not in (*own.on(named).inside_air.patches, *own.on(named).outside_air.patches)
    assert run_scene(own, named, Goals()).warnings == ()
    shone = replace(scene, absorbed_solar=(AbsorbedSolar(OUTSIDE, 0.6, 100.0),))
    assert ("front" in shone.on(named).absorbed_solar[0].patches) == of.startswith("exterior")


@pytest.mark.parametrize(("u", "met"), [(0.5, True), (4.5, False)])
def test_a_layer_makes_up_for_what_an_audit_found(u, met) -> None:
    """A wall of 0.2 m: 1 / U = Rsi + 0.2 / 1.7 + layer + Rse, but no layer takes resistance away."""
    mesh, scene = wall(), HeatScene(CONCRETE, **AIRS)
    run = run_scene(scene, mesh, Goals(), behind_m2k_w={"exterior-side": 1.0 / u - 0.04})
    (layer,), least = run.layers, 0.13 + 0.2 / CONCRETE["*"].conductivity_w_mk
    assert layer.body_m2k_w == pytest.approx(least, rel=1e-9) and run.wall is not None
    assert run.wall.u_value_w_m2k == pytest.approx(u if met else 1.0 / (least + 0.04), rel=1e-6)
    assert any("exterior-side" in one for one in run.warnings) == (not met)


def test_a_layer_needs_rooms_and_nothing_but_air() -> None:
    for scene, mesh in (
        (HeatScene(CONCRETE, **AIRS), filled()),
        (HeatScene(CONCRETE, **AIRS, heat_flux=(HeatFlux(("cut",), 1.0),)), room()),
    ):
        with pytest.raises(HeatError, match=r"^--from-audit: expected"):
            run_scene(scene, mesh, Goals(), behind_m2k_w={"roof": 1.0})


@pytest.mark.parametrize(("volume", "said"), [(30.0, False), (60.0, True)])
def test_walls_that_came_out_thicker_than_asked_are_named(volume, said) -> None:
    """2 V / A of 200 m2 of surface is 0.3 or 0.6 m."""
    export = {"options": {"wall_thickness": 0.3}, "mesh": {"volume": volume, "area": 200.0}}
    warnings = shell_warnings(HeatScene(CONCRETE, **AIRS), export)
    assert [("0.3 m thick" in one and "0.6 m on average" in one) for one in warnings] == [True] * said


@pytest.mark.parametrize("time", [TimeSteps(2, 3600.0), AdaptiveSteps(7200.0)])
def test_a_series_that_ends_before_the_run_is_named(tmp_path, time) -> None:
    path = tmp_path / "air.csv"
    path.write_text("hours,outside_c\n0,10\n1,12\n")
    airs = {"outside_air": OutsideAir(10.0, "iso-6946-combined", air_series=str(path))}
    (warning,) = air_warnings(HeatScene(CONCRETE, time, **airs))
    scene = HeatScene(CONCRETE, time, adiabatic=("interior*", "cut"), **airs)
    assert warning in run_scene(scene, room(), Goals()).warnings
    assert "outside_air is from 0 to 1 hours" in warning and "from 0 to 2 hours" in warning
    assert air_warnings(HeatScene(CONCRETE, TimeSteps(60, 60.0), **airs)) == ()


def test_air_that_was_given_in_kelvin_is_named() -> None:
    airs = {"inside_air": InsideAir(293.15, "iso-6946-combined"), "outside_air": AIRS["outside_air"]}
    (warning,) = air_warnings(HeatScene(CONCRETE, **airs))
    assert warning in run_scene(HeatScene(CONCRETE, **airs), room(), Goals()).warnings
    assert "The air of inside_air has 293.15 degrees Celsius" in warning and "give air_c: 20." in warning
    assert air_warnings(HeatScene(CONCRETE, **AIRS)) == ()


def both(first: TetMesh, second: TetMesh) -> TetMesh:
    """Two meshes in one, without merging nodes; tags are left out."""
    count = len(first.points_m)
    shifts = dict.fromkeys(("points_m", "temperature_c", "observed", "facet_tags", "region"), 0)
    arrays = {
        name: np.concatenate([getattr(first, name), getattr(second, name) + shift])
        for name, shift in {**shifts, "tets": count, "facets": count}.items()
    }
    return replace(first, boundary=None, **arrays)


@pytest.mark.parametrize(("shift_m", "overlap", "twins"), [(0.0, True, False), (0.03, True, False), (0.4, False, True)])
def test_bodies_that_lie_in_each_other_or_touch_without_shared_nodes_are_named(shift_m, overlap, twins) -> None:
    axis = planes(0.0, 0.4, step=0.1)
    first = box_mesh(axis, axis, axis)
    second = replace(first, points_m=first.points_m + np.array([shift_m, 0.0, 0.0]))
    (warning,) = body_warnings(both(first, second))
    assert ("overlap" in warning) is overlap and ("nodes of the mesh lie at the place" in warning) is twins
    apart = replace(second, points_m=second.points_m + 1.0)
    assert body_warnings(first) == () and body_warnings(both(first, apart)) == ()


def test_parts_that_touch_without_shared_nodes_are_solved_and_said_to_exchange_nothing() -> None:
    """Air on the one end warms the one box, air on the other end cools the other one, and no heat flows."""
    axis = planes(0.0, 0.4, step=0.1)
    first = box_mesh(axis, axis, axis, temperature_c=15.0)
    second = replace(first, points_m=first.points_m + np.array([0.4, 0.0, 0.0]))
    tags = first.boundary
    patch = np.concatenate([np.where(tags.patch == inner, 2, tags.patch) for inner in (1, 0)])
    mesh = replace(both(first, second), boundary=replace(tags, patch=patch, seen=np.concatenate([tags.seen] * 2)))
    airs = Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, 0.0)
    run = run_scene(HeatScene(CONCRETE, convection=airs, adiabatic=("y*", "z*")), mesh, Goals())
    assert "flat" not in run.solution.status
    assert any("25 nodes of the mesh lie at the place of another one" in warning for warning in run.warnings)
    assert sorted({round(float(end), 6) for end in run.solution.temperature_c}) == [0.0, 20.0]


def linear(points: np.ndarray) -> np.ndarray:
    return 3.0 + points @ np.array([2.0, -5.0, 0.5])


@pytest.fixture(scope="module")
def box():
    return box_mesh(planes(0.0, 1.0, step=0.25), planes(0.0, 0.5, step=0.25), [-1.0, 0.0], temperature_c=linear)


def test_a_linear_field_is_interpolated_exactly_everywhere(box) -> None:
    """Also at nodes, on edges, faces and the surface."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform([0, 0, -1], [1, 0.5, 0], (200, 3)), box.points_m, [[0.125, 0.0, -0.3]]])
    probes = place_probes(box, points)
    np.testing.assert_allclose(probes @ box.temperature_c, linear(points), atol=1e-12)
    assert np.all(probes.data >= 0.0) and np.allclose(probes.sum(axis=1), 1.0, rtol=1e-14)


@pytest.mark.parametrize(
    ("points", "name"),
    [
        ([(0.5, 0.25, -0.5), (0.5, 0.5 + 1e-6, -0.5)], "probe 2"),
        ([(0.5, 0.25, -0.5), (7.0, 8.0, 9.0)], "probe 2"),
        ((0.5, 0.25, -0.5), "probes"),
        ([[np.nan, 0.0, 0.0]], "probes"),
    ],
)
def test_points_outside_and_what_is_no_point_are_refused(box, points, name) -> None:
    with pytest.raises(HeatError, match=f"^{name}: expected"):
        place_probes(box, points)


def test_a_point_just_beyond_a_slanted_face_is_outside() -> None:
    """It lies within the box around the tetrahedron."""
    corner = np.vstack([np.zeros(3), np.eye(3)])
    tet = mesh_from(corner, np.array([[0, 1, 2, 3]]), lambda p: np.arange(4.0))
    on_it = np.full(3, 1.0 / 3.0)
    assert (place_probes(tet, [on_it]) @ tet.temperature_c)[0] == pytest.approx(2.0)
    with pytest.raises(HeatError, match=r"^probe 1: expected"):
        place_probes(tet, [on_it + 1e-5])
