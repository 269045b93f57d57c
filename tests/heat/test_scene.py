from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
import pytest

from tests.support.heat_bodies import places_on, room, wall
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import TimeSteps, values_at
from thermoxels_ns.fem.selection import Places, Selection
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, Effect, GroundContact, Radiation
from thermoxels_ns.heat.materials import material, material_table
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.heat.scene_fields import Ground, InsideAir, OutsideAir, Sky, Sun, Surface
from thermoxels_ns.heat.sky import swinbank_sky_c

ALL = {"*": material("concrete")}
INSIDE = InsideAir(20.0, "iso-6946-combined")
OUTSIDE = OutsideAir(0.0, "iso-6946-combined")
CONVECTION = OutsideAir(0.0, "iso-6946-convection", wind_m_s=4.0)
SUN = Sun(towards=(0.0, 0.0, 3.0), direct_w_m2=800.0)
GROUND = (GroundContact(("exterior-down",), 1.5, 10.0),)


def effects(mesh=None, adiabatic=("*",), **named) -> tuple[Effect, ...]:
    return HeatScene(ALL, adiabatic=adiabatic, **named).effects(mesh or room())


def test_a_mesh_without_temperatures_starts_from_those_of_the_scene() -> None:
    mesh, steady = room(), HeatScene(ALL, outside_air=OUTSIDE, adiabatic=("*",))
    bare, through_time = replace(mesh, temperature_c=np.full(len(mesh.points_m), np.nan)), TimeSteps(1, 60.0)
    with pytest.raises(HeatError, match="initial"):
        replace(steady, time=through_time).problem(bare)
    assert (replace(steady, time=through_time, initial_c=15.0).problem(bare).start_c == 15.0).all()
    found, expected = (solve_steady(steady.problem(each)).temperature_c for each in (bare, mesh))
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize(
    ("air", "h"),
    [
        (OutsideAir(0.0, coefficient_w_m2k=17.0), 17.0),
        (OutsideAir(0.0, "iso-6946-combined"), 25.0),
        (CONVECTION, 20.0),
        (OutsideAir(0.0, "iso-6946-separate", wind_m_s=4.0, emissivity=0.9), 20.0 + 0.9 * 4.6223),
        (OutsideAir(0.0, "thermoxels-original", wind_m_s=0.0), 0.0),
        (OutsideAir(0.0, "thermoxels-original", wind_m_s=5.56), 52.51),
    ],
)
def test_outside_air(air: OutsideAir, h: float) -> None:
    (effect,) = effects(outside_air=air)
    assert effect.coefficient_w_m2k == pytest.approx(h, rel=1e-4)


@pytest.mark.parametrize(
    ("air", "ceiling_wall_floor"),
    [
        (InsideAir(20.0, coefficient_w_m2k=8.0), [8.0, 8.0, 8.0]),
        (InsideAir(20.0, "iso-6946-combined"), [1 / 0.10, 1 / 0.13, 1 / 0.17]),
        (InsideAir(20.0, "iso-6946-combined", heat_flow="out-of-body"), [1 / 0.17, 1 / 0.13, 1 / 0.10]),
        (InsideAir(20.0, "iso-6946-convection"), [5.0, 2.5, 0.7]),
        (InsideAir(20.0, "iso-6946-convection", heat_flow="out-of-body"), [0.7, 2.5, 5.0]),
        (InsideAir(10.0, "iso-6946-separate", emissivity=1.0), [10.149, 7.649, 5.849]),
    ],
)
def test_inside_air_by_orientation(air: InsideAir, ceiling_wall_floor: list[float]) -> None:
    mesh = room()
    (effect,) = effects(mesh, inside_air=air)
    for patch, h in zip(("interior-down", "interior-side", "interior-up"), ceiling_wall_floor):
        places = places_on(mesh, patch)
        assert len(places) == 8 * (4 if patch == "interior-side" else 1)
        np.testing.assert_allclose(values_at(effect.coefficient_w_m2k, places, 0.0), h, rtol=1e-4)


def test_surfaces_radiate_to_sky_and_ground_the_later_entry_holds() -> None:
    mesh = room()
    surfaces = (Surface(emissivity=0.9), Surface(emissivity=0.2, patches=("exterior-up",)))
    found = effects(mesh, outside_air=CONVECTION, sky=Sky(below_air_k=6.0), ground=Ground(5.0), surfaces=surfaces)
    radiation = {effect.patches: effect for effect in found if isinstance(effect, Radiation)}
    assert set(radiation) == {("exterior-up",), ("exterior-side", "exterior-down")}
    assert radiation[("exterior-up",)].emissivity == 0.2
    places = places_on(mesh, "exterior-side", "exterior-down")
    around = values_at(radiation[("exterior-side", "exterior-down")].surroundings_c, places, 0.0) + 273.15
    expected = np.where(places.normals[:, 2] < -0.5, 278.15**4, 0.5 * (278.15**4 + 267.15**4)) ** 0.25
    np.testing.assert_allclose(around, expected)


@pytest.mark.parametrize(
    ("sky", "sky_c"),
    [(Sky(temperature_c=-30.0), -30.0), (Sky(below_air_k=6.0), -6.0), (Sky(model="swinbank"), swinbank_sky_c(0.0))],
)
def test_sky_alone(sky: Sky, sky_c: float) -> None:
    _, radiation = effects(outside_air=CONVECTION, sky=sky, surfaces=(Surface(emissivity=0.9),))
    assert radiation.surroundings_c == sky_c


def test_sunlight_on_surfaces_that_absorb() -> None:
    mesh = room()
    surfaces = (Surface(absorptivity=0.6), Surface(absorptivity=0.3, patches=("*-side",)))
    found = effects(mesh, sun=SUN, ground=Ground(reflectance=0.5), surfaces=surfaces)
    assert [(effect.absorptivity, effect.patches) for effect in found if isinstance(effect, AbsorbedSolar)] == [
        (0.6, ("exterior-up", "exterior-down")),
        # Sunlight stays outside although the surface inside has an absorptivity.
        (0.3, ("exterior-side",)),
    ]
    for effect, parts in zip(found, ({"exterior-up": 800.0, "exterior-down": 400.0}, {"exterior-side": 200.0})):
        for patch, expected in parts.items():
            np.testing.assert_allclose(values_at(effect.irradiance_w_m2, places_on(mesh, patch), 0.0), expected)


def test_every_patch_is_spoken_of() -> None:
    with pytest.raises(HeatError, match=r"interior-up \(3.33 %") as caught:
        effects(adiabatic=("cut",), outside_air=OUTSIDE)
    assert "adiabatic: [cut, interior-up, interior-side, interior-down]" in str(caught.value)
    assert len(effects(adiabatic=("cut",), outside_air=OUTSIDE, inside_air=INSIDE)) == 2
    # A patch without surface may be forgotten.
    assert len(effects(wall(), adiabatic=("cut",), outside_air=OUTSIDE, inside_air=INSIDE)) == 2
    with pytest.raises(HeatError, match=r"cut \(13.3 %"):
        effects(adiabatic=(), outside_air=OUTSIDE, inside_air=INSIDE)


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ({"inside_air": INSIDE, "radiation": (Radiation(("interior-up",), 0.9, 20.0),)}, "inside_air: .*radiation"),
        ({"outside_air": OUTSIDE, "ground_contact": GROUND}, "outside_air: .*ground_contact entry 1 on exterior-down"),
        (
            {"convection": (Convection(("interior-*",), 8.0, 20.0), Convection(("*-up",), 8.0, 20.0))},
            "convection entry 1: .*convection entry 2 on interior-up",
        ),
        (
            {"ground_contact": GROUND, "sun": SUN, "surfaces": (Surface(absorptivity=0.6),)},
            "sun: expected contact with the ground alone",
        ),
    ],
)
def test_nothing_is_counted_twice(named, message: str) -> None:
    with pytest.raises(HeatError, match=message):
        effects(**named)


def test_the_sky_may_share_a_view_with_other_surroundings() -> None:
    """A wall sees the sky by its tilt, and a house across the street by a view factor that the user gives."""
    found = effects(
        sky=Sky(temperature_c=0.0),
        surfaces=(Surface(emissivity=0.9),),
        radiation=(Radiation(("exterior-side",), 0.2, 10.0),),
    )
    assert len(found) == 2


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ({"sky": Sky(temperature_c=0.0)}, "surfaces: emissivity"),
        ({"sun": SUN}, "surfaces: absorptivity"),
        ({"surfaces": (Surface(emissivity=0.9),)}, "surfaces: emissivity"),
        ({"ground": Ground(reflectance=0.2)}, "ground: reflectance"),
        ({"up": (0.0, 0.0, 0.0)}, "up"),
        ({"materials": {}}, "materials"),
    ],
)
def test_what_belongs_together(named, message: str) -> None:
    with pytest.raises(HeatError, match=f"^{message}: expected"):
        HeatScene(**{"materials": ALL, **named})


def test_patches_that_the_mesh_does_not_have_are_named() -> None:
    with pytest.raises(HeatError, match=r"outside_air: patches: .* got 'roof'"):
        effects(outside_air=replace(OUTSIDE, patches=("roof",)))
    with pytest.raises(HeatError, match="surfaces entry 2: patches"):
        effects(sun=SUN, surfaces=(Surface(absorptivity=0.6), Surface(absorptivity=0.6, patches=("roof",))))
    untagged = replace(room(), boundary=None)
    with pytest.raises(HeatError, match=r"outside_air: patches: .* got 'exterior-"):
        effects(untagged, outside_air=OUTSIDE)
    assert len(effects(untagged, outside_air=replace(OUTSIDE, patches=("*",)))) == 1


def test_patch_names_with_the_letters_of_patterns() -> None:
    mesh = room()
    names = tuple(f"{name} [*]" for name in mesh.boundary.patch_names)
    mesh = replace(mesh, boundary=replace(mesh.boundary, patch_names=names))
    roofs = (Surface(absorptivity=0.6, patches=("*-up*",)),)
    (effect,) = effects(mesh, sun=replace(SUN, patches=("*",)), surfaces=roofs)
    selection = Selection(mesh)
    assert set(selection.facet_patch[selection.facets(effect.patches)]) == {0, 3}


def test_materials_by_region() -> None:
    mesh = room()
    two = replace(mesh, region=(mesh.points_m[mesh.tets].mean(axis=1)[:, 2] < 1.0).astype(np.int64))
    brick, concrete = material("brick"), material("concrete")
    scene = HeatScene({"*": brick, "slab": concrete}, adiabatic=("*",))
    assert scene.problem(two).material == {"solid": brick, "slab": concrete}
    assert scene.problem(mesh).materials == {"solid": brick}
    assert HeatScene({"solid": brick, "slab": brick}, adiabatic=("*",)).problem(two).materials == {
        "solid": brick,
        "slab": brick,
    }
    with pytest.raises(HeatError, match=r"materials: .* got 'roof'"):
        HeatScene({"roof": brick}, adiabatic=("*",)).problem(mesh)
    with pytest.raises(HeatError, match=r"materials: .* got none for solid"):
        HeatScene({"slab": brick}, adiabatic=("*",)).problem(two)


def test_start_and_up() -> None:
    mesh = room()
    scene = HeatScene(ALL, adiabatic=("*",))
    np.testing.assert_array_equal(scene.problem(mesh).start_c, mesh.temperature_c)
    assert scene.problem(mesh).up == (0.0, 0.0, 1.0)
    assert scene.problem(mesh, up=(0.0, 2.0, 0.0)).up == (0.0, 1.0, 0.0)
    assert replace(scene, up=(3.0, 0.0, 0.0)).problem(mesh, up=(0.0, 1.0, 0.0)).up == (1.0, 0.0, 0.0)


NOON = datetime(2025, 6, 21, 12, tzinfo=timezone.utc)
PLACE = {"latitude_deg": 47.0, "longitude_deg": 8.0, "north": (0.0, 1.0, 0.0)}


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: InsideAir(20.0), "coefficient or coefficient_w_m2k"),
        (lambda: InsideAir(20.0, "iso-6946-combined", 8.0), "coefficient or coefficient_w_m2k"),
        (lambda: InsideAir(20.0, "iso-6946-separate"), "emissivity"),
        (lambda: InsideAir(20.0, "iso-6946-combined", patches=()), "patches"),
        (lambda: InsideAir(-300.0, "iso-6946-combined"), "air_c"),
        (lambda: InsideAir(float("nan"), "iso-6946-combined"), "air_c"),
        (lambda: Surface(), "expected emissivity, absorptivity"),
        (lambda: Surface(emissivity=1.5), "emissivity"),
        (lambda: Sky(below_air_k=-6.0), "below_air_k"),
        (lambda: Sun(start=NOON, clear_sky="meinel"), "start"),
        (lambda: Sun(start=NOON, **PLACE), "clear_sky or direct_w_m2"),
        (lambda: Sun(start=NOON, **{**PLACE, "north": (0.0, 0.0, 0.0)}, clear_sky="meinel"), "north"),
        (lambda: Sun(towards=(0.0, 0.0, 1.0), latitude_deg=47.0, direct_w_m2=800.0), "latitude_deg"),
    ],
)
def test_sections_say_what_is_wrong(make, named: str) -> None:
    with pytest.raises(HeatError, match=f"^{named}"):
        make()


def test_horizontal_reaches_to_30_degrees() -> None:
    angle = np.radians([-31, -30, -29, 29, 30, 31])
    normals = np.stack([np.cos(angle), np.zeros(6), np.sin(angle)], axis=1)
    coefficient = InsideAir(20.0, "iso-6946-convection", heat_flow="out-of-body").convection().coefficient_w_m2k
    found = coefficient.function(Places(np.zeros((6, 3)), normals, (0.0, 0.0, 1.0)), 0.0)
    assert np.asarray(found).tolist() == [0.7, 2.5, 2.5, 2.5, 2.5, 5.0]


def test_every_row_is_a_material_with_a_source() -> None:
    table = material_table()
    assert len(table) >= 25
    assert list(table) == [material(name).name for name in table]
    assert all(len(row.source) > 10 for row in table.values())
    # Light solids are little more than still air, 0.026 W/(m K), metals conduct best, all else lies between.
    assert all(10 < row.density_kg_m3 < 12000 for row in table.values())
    metals = {"aluminium", "copper", "steel", "stainless-steel", "lead", "zinc"}
    for name, row in table.items():
        low, high = (10.0, 400.0) if name in metals else (0.02, 0.08) if row.density_kg_m3 <= 250.0 else (0.05, 4.0)
        assert low <= row.conductivity_w_mk <= high, name
    assert all(100 < row.specific_heat_j_kgk < 2000 for row in table.values())
    published = {"concrete": (1.7, 2200.0, 880.0), "aluminium": (160.0, 2800.0, 880.0)}
    published |= {"softwood": (0.13, 500.0, 1600.0), "mineral-wool": (0.035, 20.0, 1030.0)}
    for name, figures in published.items():
        found = table[name]
        assert (found.conductivity_w_mk, found.density_kg_m3, found.specific_heat_j_kgk) == figures
