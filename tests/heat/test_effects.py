from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, box_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.forms import ConvectionForm, effect_forms
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps, Varying
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
from thermoxels_ns.mesh.tetrahedra import TetMesh

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
