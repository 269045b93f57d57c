import dataclasses
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.support.epw_file import write_epw
from tests.support.heat_bodies import CONCRETE, box_mesh, places_on, room
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.fem.forms import ConvectionForm, effect_forms
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, Varying, values_at
from thermoxels_ns.fem.selection import Places
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.space import Space
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import (
    STEFAN_BOLTZMANN_W_M2K4,
    AbsorbedSolar,
    Convection,
    Effect,
    FixedTemperature,
    GroundContact,
    HeatFlux,
    InternalHeat,
    Radiation,
)
from thermoxels_ns.heat.materials import material
from thermoxels_ns.heat.scene import HeatScene, heat_scene_names, load_heat_scene
from thermoxels_ns.mesh.tetrahedra import TetMesh

SMALL = 'materials: {"*": concrete}\nsteady: true\n'


def scene(tmp_path: Path, text: str) -> HeatScene:
    path = tmp_path / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return load_heat_scene(path)


@pytest.mark.parametrize("name", heat_scene_names())
def test_each_builds_a_problem_by_name_and_by_path(name: str) -> None:
    mesh, found = room(), load_heat_scene(name)
    problem = found.problem(mesh)
    assert bool(problem.effects) == (name != "concrete") and {*problem.materials.values()} == {material("concrete")}
    assert found.description
    np.testing.assert_array_equal(problem.start_c, mesh.temperature_c)
    again = load_heat_scene(str(configs_folder() / f"scene-{name}.yaml"))
    assert again == found


def test_the_original_s_transient_case() -> None:
    found = load_heat_scene("original")
    assert found.time == TimeSteps(10, 60.0)
    inside, outside, radiation, solar = found.effects(room())
    assert inside == Convection(("interior-*",), 8.0, 30.0)
    assert (outside.patches, outside.air_c) == (("exterior-*",), 10.0)
    assert outside.coefficient_w_m2k == pytest.approx(18.6 * 5.56**0.605)
    assert radiation == Radiation(("exterior-*",), 0.85, 10.0, 5.67e-8)
    assert solar == AbsorbedSolar(("exterior-*",), 0.6, 1000.0)


def test_all_effects() -> None:
    found = load_heat_scene("all-effects")
    assert found.time == AdaptiveSteps(86400.0, 0.05, 24)
    kinds = {type(effect) for effect in found.effects(room())}
    assert kinds == {Convection, Radiation, AbsorbedSolar, GroundContact, HeatFlux, InternalHeat, FixedTemperature}
    # It shows every key but one, and that one in a comment.
    written = yaml.safe_load((configs_folder() / "scene-all-effects.yaml").read_text(encoding="utf-8"))
    keys = {field.name for field in dataclasses.fields(HeatScene)} - {"initial_c"} | {"initial"}
    assert keys - set(written) == {"convection"}


def test_what_a_file_may_say(tmp_path) -> None:
    """Numbers may have units as in conditions of an audit, a comma, or the form 1e1, which yaml takes for a text."""
    found = scene(
        tmp_path,
        """
materials:
  "*": brick
  slab:
    conductivity_w_mk: 0,8 W/(m K)
    density_kg_m3: 1500 kg/m3
    specific_heat_j_kgk: 0.9 kJ/(kg K)
time: {duration_s: 24 h}
initial: {temperature_c: 288.15 K}
convection:
  - {patches: [interior-up, stairs], coefficient_w_m2k: 7.7, air_c: 15}
outside_air: {air_c: "-5,5 °C", coefficient: iso-6946-convection, wind_m_s: 3.6 km/h}
ground: {surface_c: 1e1, reflectance: 20 %}
surfaces: [{emissivity: 90 %, absorptivity: 0.6}]
sun: {towards: [0, -1, 1], direct_w_m2: 500 W/m2, diffuse_w_m2: 80}
adiabatic: []
""",
    )
    assert (found.outside_air.air_c, found.outside_air.wind_m_s) == (-5.5, pytest.approx(1.0))
    assert (found.time, found.initial_c) == (AdaptiveSteps(86400.0), pytest.approx(15.0))
    assert (found.ground.surface_c, found.ground.reflectance, found.surfaces[0].emissivity) == (10.0, 0.2, 0.9)
    made = found.materials["slab"]
    assert (made.conductivity_w_mk, made.density_kg_m3, made.specific_heat_j_kgk) == (0.8, 1500.0, 900.0)
    assert (made.name, made.heat_capacity_j_m3k) == ("slab", 1.35e6)
    assert found.convection[0].where == ("interior-up", "stairs")
    assert found.sun is not None and found.sun.towards == (0.0, -1.0, 1.0)
    assert found.adiabatic == ()


AIR = SMALL + "outside_air: {air_c: 0, coefficient: iso-6946-combined}\n"
SUNNY = (
    SMALL + "surfaces: [{absorptivity: 0.5}]\n"
    "sun: {start: 2025-06-21T12:00:00+02:00, latitude_deg: 47, longitude_deg: 8, north: [0, 1, 0], clear_sky: meinel}\n"
)


_VALUES = ("1", "*a", "*b", "*c", "*d")
BOMB = "".join(f"{own}: &{own} [{', '.join([value] * 20)}]\n" for own, value in zip("abcde", _VALUES))
STEPS = SMALL.replace("steady: true", "time: {}")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("steady: true\n", "the key materials"),
        (SMALL.replace("true", "maybe"), "steady"),
        (SMALL.replace("concrete", "concret"), "material: .*Did you mean concrete"),
        (SMALL.replace("concrete", "{conductivity_w_mk: 0, density_kg_m3: 1, specific_heat_j_kgk: 1}"),
         r"materials: \*: conductivity_w_mk"),
        (SMALL + "initial: warm\n", "initial"),
        (SMALL + "outside: {air_c: 0}\n", r"got outside. Did you mean outside_air\?"),
        (AIR.replace("air_c", "air_k"), r"outside_air: .* got air_k. Did you mean air_c\?"),
        (AIR.replace("air_c: 0", f"air_c: 1{'0' * 400}"), "outside_air: air_c"),
        (AIR.replace("air_c: 0", "air_c: 0 +- 1 C"), "outside_air: air_c: .*without a range.* Write 0 C"),
        (AIR.replace("air_c: 0", "air_c: 0,5 C"), "got 5 C. Within braces"),
        (AIR.replace("air_c: 0", "air_c: 0 W"), "outside_air: air_c: .*with its unit, C"),
        (AIR.replace("air_c: 0", "air_c: true"), "outside_air: air_c"),
        (AIR.replace("iso-6946-combined", "windy"), "outside_air: coefficient"),
        (SMALL + "heat_flux: [{patches: [cut], flux_w_m2: 1}, {patches: [cut]}]\n", "heat_flux entry 2: .*flux_w_m2"),
        (SMALL + "ground_contact: [{patches: [cut], ground_c: 9, resistance_m2k_w: 0}]\n",
         r"ground_contact entry 1: resistance_m2k_w"),
        (SUNNY.replace("+02:00", ""), "sun: start"),
        (STEPS.replace("{}", "{steps: 1}"), "time: expected the key step_seconds"),
        (STEPS.replace("{}", "{tolerance_k: 1}"), "time: expected the key duration_s"),
        (STEPS.replace("{}", "{steps: 1, duration_s: 9}"), "time: .*got duration_s"),
        (STEPS.replace("{}", "{hours: 1}"), "time: expected keys out of .* got hours"),
        (STEPS.replace("{}", "{duration_s: 0}"), "time: duration_s"),
        (SMALL + "a: &a [*a]", "Circular"),
        (SMALL + BOMB, "entries"),
    ],
)  # fmt: skip
def test_wrong_files_are_refused(tmp_path, text: str, named: str) -> None:
    with pytest.raises(HeatError, match=f"(?m)^mine.yaml: .*{named}"):
        scene(tmp_path, text)


def test_all_mistakes_of_a_file_are_told_at_once(tmp_path) -> None:
    assert scene(tmp_path, AIR).outside_air is not None and scene(tmp_path, SUNNY).sun is not None
    with pytest.raises(HeatError) as caught:
        scene(tmp_path, AIR.replace("air_c: 0", "air_k: 0") + "heat_flux: [{patches: [cut]}]\nup: [0, 0]\n")
    told = str(caught.value).splitlines()
    assert len(told) == 4 and all(line.startswith("mine.yaml: ") for line in told)
    for named in ("up", "outside_air: expected the key air_c", "Did you mean air_c", "heat_flux entry 1"):
        assert sum(named in line for line in told) == 1


def test_unknown_names_and_paths(tmp_path) -> None:
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    for name in ("summer", tmp_path / "summer.yaml", tmp_path / "binary.yaml"):
        with pytest.raises(HeatError, match=r"(heat scene|summer\.yaml|binary\.yaml): expected"):
            load_heat_scene(name)


def with_series(
    tmp_path: Path, content: str, time: str = "time: {duration_s: 36000.0}", series: str = "outside.csv"
) -> HeatScene:
    (tmp_path / "outside.csv").write_text(content, encoding="utf-8")
    text = f"""
materials: {{"*": concrete}}
{time}
initial: {{temperature_c: 10.0}}
inside_air: {{air_c: 20.0, coefficient_w_m2k: 8.0}}
outside_air: {{air_c: 0.0, air_series: {series}, coefficient_w_m2k: 25.0, patches: [exterior-side, exterior-down]}}
surfaces: [{{patches: [exterior-up], emissivity: 0.9}}]
sky: {{below_air_k: 20.0}}
"""
    return scene(tmp_path, text)


def test_air_follows_the_file_beside_the_scene_and_the_sky_follows_the_air(tmp_path) -> None:
    mesh = room()
    found = with_series(tmp_path, "hours,outside_c\n0,-4\n2,6.0\n\n10, 6\n")
    inside, outside, sky = found.effects(mesh)
    assert isinstance(inside, Convection) and inside.air_c == 20.0
    assert isinstance(outside, Convection) and isinstance(sky, Radiation)
    places = places_on(mesh, "exterior-up")
    for hours, air_c in ((0.0, -4.0), (1.0, 1.0), (2.0, 6.0), (20.0, 6.0)):
        assert values_at(outside.air_c, places, 3600.0 * hours) == pytest.approx(air_c)
        assert values_at(sky.surroundings_c, places, 3600.0 * hours) == pytest.approx(air_c - 20.0)
    assert isinstance(outside.air_c, Varying) and outside.air_c.in_time
    assert outside.air_c.resolution_s == 7200.0  # no step is longer than the file's shortest interval


@pytest.mark.parametrize(("year", "day"), [(2026, 0), (2024, 1)])
def test_air_follows_an_epw_file_over_the_end_of_its_year(tmp_path, year, day) -> None:
    """The scene starts at noon of 31 December 2031; the file begins again at New Year. 2024 has one day more."""
    write_epw(tmp_path / "outside.epw", lambda h: 0.001 * h, hours=8760 + 24 * day, first=datetime(year, 1, 1))
    series = "outside.epw, air_start: 2031-12-31T12:00:00+01:00"
    outside = with_series(tmp_path, "", series=series).effects(room())[1]
    for hours, air_c in ((0.0, 8.748 + 0.024 * day), (6.5, 8.7545 + 0.024 * day), (15.0, 0.003)):
        places = Places(np.zeros((1, 3)), np.zeros((1, 3)))
        assert values_at(outside.air_c, places, 3600.0 * hours) == pytest.approx(air_c, abs=1e-3)
    for wrong in ("outside.epw", "outside.csv, air_start: 2031-12-31T12:00:00+01:00"):
        with pytest.raises(HeatError, match="outside_air: air_start: expected a date"):
            with_series(tmp_path, "hours,outside_c\n0,1\n1,2\n", series=wrong)


@pytest.mark.parametrize(
    ("series", "named"),
    [
        ("hours,inside_c\n0,1\n1,2\n", "outside_air: air_series: .*expected a column outside_c"),
        ("time,air\n0,1\n", "air_series: .*outside.csv"),
        ("", "air_series"),
        ("hours,outside_c\n0,cold\n1,2\n", "air_series"),
        ("hours,outside_c\n0,1,2\n1,2,3\n", "air_series"),
        ("hours,outside_c\n0,1\n", "air_series: .*outside.csv"),
        ("hours,outside_c\n0,1\n1,-300\n", "air_series: .*outside.csv: expected temperatures"),
    ],
)
def test_a_series_that_cannot_be_used_is_refused(tmp_path, series, named) -> None:
    with pytest.raises(HeatError, match=named):
        with_series(tmp_path, series).effects(room())


def test_a_series_needs_a_file_and_time(tmp_path) -> None:
    with pytest.raises(HeatError, match="outside_air: air_series: expected time"):
        with_series(tmp_path, "hours,outside_c\n0,1\n1,2\n", time="steady: true")
    found = with_series(tmp_path, "hours,outside_c\n0,1\n1,2\n")
    (tmp_path / "outside.csv").unlink()
    with pytest.raises(HeatError, match=r"air_series: .*outside\.csv: expected"):
        found.effects(room())


AREA_X, VOLUME = 0.3 * 0.2, 0.4 * 0.3 * 0.2


@pytest.fixture
def box() -> TetMesh:
    return box_mesh(np.linspace(0, 0.4, 5), np.linspace(0, 0.3, 4), np.linspace(0, 0.2, 3))


def at_once(mesh: TetMesh, material, *effects: Effect) -> HeatSolution:
    """A step so short that no temperature changes: heat flows are those of the start."""
    return solve_heat(HeatProblem(mesh, material, effects=effects), TimeSteps(1, 1e-6))


@pytest.mark.parametrize(
    ("effect", "watts"),
    [
        (HeatFlux(("x0",), 100.0), 100.0 * AREA_X),
        (HeatFlux(("x0",), -100.0), -100.0 * AREA_X),
        (Convection(("x0",), 8.0, 30.0), 8.0 * 10.0 * AREA_X),
        (Convection(("x0",), 8.0, 5.0), -8.0 * 15.0 * AREA_X),
        (Radiation(("x0",), 0.9, 40.0), 0.9 * STEFAN_BOLTZMANN_W_M2K4 * (313.15**4 - 293.15**4) * AREA_X),
        (Radiation(("x0",), 0.9, -40.0), 0.9 * STEFAN_BOLTZMANN_W_M2K4 * (233.15**4 - 293.15**4) * AREA_X),
        (Radiation(("x0",), 1.0, -273.15, 5.67e-8), -5.67e-8 * 293.15**4 * AREA_X),
        (AbsorbedSolar(("x0",), 0.6, 800.0), 0.6 * 800.0 * AREA_X),
        (GroundContact(("x0",), 2.5, 10.0), (10.0 - 20.0) / 2.5 * AREA_X),
        (InternalHeat(("solid",), 50.0), 50.0 * VOLUME),
        (InternalHeat(("*",), -50.0), -50.0 * VOLUME),
    ],
    ids=lambda value: value.label if isinstance(value, Effect) else "",
)
def test_positive_is_into_the_body(box, effect, watts) -> None:
    problem = HeatProblem(box, CONCRETE, effects=(effect,))
    solution = solve_heat(problem, TimeSteps(1, 1e-6))
    assert solution.effects[0].heat_w[0] == pytest.approx(watts, rel=1e-6)
    assert solution.heat_w[0] == pytest.approx(watts, rel=1e-6)
    longer = solve_heat(problem, TimeSteps(1, 60.0))
    mean_change = (longer.temperature_c[1] - 20.0).mean()
    assert np.sign(mean_change) == np.sign(watts)


def test_a_star_is_the_whole_boundary_also_without_tags(box) -> None:
    area = 2 * (0.4 * 0.3 + 0.4 * 0.2 + 0.3 * 0.2)
    for mesh in (box, replace(box, boundary=None)):
        assert at_once(mesh, CONCRETE, HeatFlux(("*",), 10.0)).heat_w[0] == pytest.approx(10.0 * area, rel=1e-9)


def test_functions_are_told_where_they_are(box) -> None:
    seen = {}

    def flux(places, time_s):
        seen[time_s] = places
        return 100.0 * places.normals @ np.array(places.up)

    problem = HeatProblem(box, CONCRETE, effects=(HeatFlux(("z0", "z1"), Varying(flux)),), up=(0, 0, 2.0))
    heat = solve_heat(problem, TimeSteps(2, 30.0)).effects[0]
    np.testing.assert_allclose(heat.group_heat_w, np.outer([1, 1], [-12.0, 12.0]), rtol=1e-12)
    assert set(seen) == {0.0, 30.0, 60.0}  # at the start, what pushes temperatures out of their range counts too
    places = seen[30.0]
    assert np.isin(np.round(places.points_m[:, 2], 12), [0.0, 0.2]).all() and len(places) == len(places.normals) == 48


def test_two_temperatures_at_one_node_are_refused(box) -> None:
    clash = (FixedTemperature(("x0",), 5.0), FixedTemperature(("y0",), 7.0))
    with pytest.raises(HeatError, match=r"5 C from .* on x0 and 7 C from .* on y0"):
        at_once(box, CONCRETE, *clash)
    same = at_once(box, CONCRETE, FixedTemperature(("x0",), 5.0), FixedTemperature(("y0",), 5.0))
    one = at_once(box, CONCRETE, FixedTemperature(("x0", "y0"), 5.0))
    np.testing.assert_allclose([part.heat_w[0] for part in same.effects], one.effects[0].group_heat_w[0], rtol=1e-9)


EVERY = {
    "fixed": FixedTemperature(("x0",), 10.0),
    "convection": Convection(("x1",), 8.0, 5.0),
    "flux": HeatFlux(("y0",), 20.0),
    "radiation": Radiation(("y1",), 0.9, -10.0),
    "source": InternalHeat(("*",), 100.0),
}
"""One effect for each kind of form."""


@pytest.mark.parametrize("absent", EVERY)
def test_an_absent_effect_and_one_without_triangles_have_no_form(box, absent) -> None:
    nowhere = Convection(("other",), 8.0, 5.0), Radiation(("other",), 0.9, 5.0)
    effects = (*nowhere, *(effect for kind, effect in EVERY.items() if kind != absent))
    problem = HeatProblem(box, CONCRETE, effects=effects)
    kinds = [form.kind for form in effect_forms(problem, Space(problem.selection), 0.0)]
    assert sorted(kinds) == sorted(set(EVERY) - {absent})
    assert not any(heat.heat_w.any() for heat in at_once(box, CONCRETE, *effects).effects[:2])


def test_what_is_constant_is_assembled_once(box, monkeypatch) -> None:
    calls, matrix, load = list[str](), ConvectionForm.convection_matrix, ConvectionForm.load
    monkeypatch.setattr(ConvectionForm, "convection_matrix", lambda *a: calls.append("matrix") or matrix(*a))
    monkeypatch.setattr(ConvectionForm, "load", lambda *a: calls.append("load") or load(*a))
    solve_heat(HeatProblem(box, CONCRETE, effects=(EVERY["convection"],)), TimeSteps(20, 60.0))
    assert sorted(calls) == ["load", "matrix"]
