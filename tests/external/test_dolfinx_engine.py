"""`thermoxels heat --engine dolfinx` beside our own solver: the same temperatures and heat flows."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import STEEL, building_corner, graded, make_body
from thermoxels_ns.commands.heat import Heat, run_heat
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, Varying
from thermoxels_ns.fem.solution import Solution, mean_flows_w
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.dolfinx_engine import PYTHON, DolfinxEngine
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, FixedTemperature, InternalHeat, Radiation
from thermoxels_ns.heat.solving import Goals, solve_problem
from thermoxels_ns.mesh.files.formats import write_mesh

pytestmark = pytest.mark.external
FOUR_HOURS = TimeSteps(4, 3600.0)
NIGHTFALL = Varying(lambda places, time_s: 12.0 - 2.0 * time_s / 3600.0)
NOON = Varying(lambda places, time_s: 300.0 * max(0.0, 1.0 - time_s / 7200.0))


@pytest.fixture(params=[1, 2])
def engine(request, fenicsx_python, monkeypatch) -> DolfinxEngine:
    if request.param > 1 and shutil.which("mpirun") is None:
        pytest.skip("mpirun is not installed; on Debian and Ubuntu it is in the package openmpi-bin")
    monkeypatch.setenv(PYTHON, fenicsx_python)
    return DolfinxEngine(request.param)


def agree(theirs: Solution, ours: Solution) -> None:
    """To a millionth of the heat that flows, and of the range of temperatures."""
    span = float(np.ptp(ours.temperature_c))
    assert np.abs(theirs.temperature_c - ours.temperature_c).max() < 1e-6 * span
    flows, expected = mean_flows_w(theirs), mean_flows_w(ours)
    assert flows.keys() == expected.keys()
    most = max(map(abs, expected.values()))
    assert list(flows.values()) == pytest.approx(list(expected.values()), abs=1e-6 * most)


def test_ISO_10211_case_3(engine) -> None:
    problem = building_corner(lambda *knots: graded(*knots, finest=0.05, growth=1.3, coarsest=0.2))
    theirs = solve_steady(problem, engine=engine)
    agree(theirs, solve_steady(problem))
    assert theirs.iterations == 0, "solved by our own solver"


def all_effects(problem: HeatProblem) -> HeatProblem:
    one, *others = (
        name for n, name in enumerate(problem.mesh.boundary.patch_names) if n in problem.mesh.boundary.patch
    )
    effects = (
        FixedTemperature((one,), 20.0),
        Convection(tuple(others), 12.0, NIGHTFALL),
        Radiation(tuple(others), 0.9, -20.0),
        AbsorbedSolar(tuple(others), 0.6, NOON),
        InternalHeat(("*",), 30.0),
    )
    return replace(problem, effects=effects)


def test_all_effects_in_a_steady_state_and_through_time(engine, heat_problem) -> None:
    """Radiation makes it nonlinear; air and sun change from step to step."""
    problem = all_effects(heat_problem)
    agree(solve_steady(problem, engine=engine), solve_steady(problem))
    ours = solve_heat(problem, FOUR_HOURS)
    theirs = solve_heat(problem, FOUR_HOURS, engine=engine)
    agree(theirs, ours)
    assert theirs.energy_residual < 1e-8 and not theirs.iterations.any()


@pytest.mark.parametrize("engine", [2], indirect=True)
def test_a_body_that_DOLFINx_would_tear_is_refused_or_solved(engine, random_body) -> None:
    """Its voxels touch by edges alone in two places, at which DOLFINx does not always divide it among processes."""
    problem = HeatProblem(random_body, STEEL)
    try:
        theirs = solve_heat(problem, FOUR_HOURS, engine=engine)
    except HeatError as problem_found:
        assert "tears between processes" in str(problem_found)
    else:
        agree(theirs, solve_heat(problem, FOUR_HOURS))


@pytest.mark.parametrize(("fixed", "time"), [(True, None), (True, 40), (False, 40)])
def test_bodies_that_become_level(engine, fixed, time) -> None:
    """Nothing flows in the end, so that nothing but round-off is left to balance."""
    effects, rng = (FixedTemperature(("*",), 20.0),) * fixed, np.random.default_rng(7)
    body = make_body(np.ones((6, 5, 4), bool), 0.05, lambda points: rng.uniform(-15.0, 45.0, len(points)))
    problem = HeatProblem(body, STEEL, effects=effects)
    if time is None:
        found = solve_steady(problem, engine=engine).temperature_c
    else:
        found = solve_heat(problem, TimeSteps(time, 86400.0), engine=engine).temperature_c[-1]
    assert np.ptp(found) < 1e-6 and (not fixed or found.mean() == pytest.approx(20.0))


@pytest.mark.parametrize("engine", [2], indirect=True)
def test_the_command_writes_the_same_answers(engine, heat_problem, tmp_path) -> None:
    write_mesh(tmp_path / "mesh.vtu", heat_problem.mesh)
    body = {"conductivity_w_mk": 1.7, "density_kg_m3": 2200, "specific_heat_j_kgk": 880}
    air = {"patches": ["*"], "air_c": -5.0, "coefficient_w_m2k": 25.0}
    time = {"steps": 3, "step_seconds": 600}
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        json.dumps({"materials": {"*": body}, "outside_air": air, "time": time, "initial": {"temperature_c": 15}})
    )
    flows = []
    for name in ("own", "dolfinx"):
        options = Heat(
            tmp_path / "mesh.vtu",
            str(scene),
            tmp_path / name,
            engine=name,
            ranks=2 if name == "dolfinx" else 1,
            pictures=False,
        )
        said = list[str]()
        run_heat(options, said.append)
        flows.append(json.loads((tmp_path / name / "answers.json").read_text())["effects"][0]["heat_w"])
        assert any(line.startswith("DOLFINx: 2 processes") for line in said) == (name == "dolfinx")
    assert flows[1] == pytest.approx(flows[0], rel=1e-6)


def test_less_than_one_process_is_refused() -> None:
    with pytest.raises(HeatError, match="ranks"):
        DolfinxEngine(0)


@pytest.mark.parametrize(("time", "goals"), [(AdaptiveSteps(3600.0), Goals()), (None, Goals(flow_tolerance=0.01))])
def test_what_the_engine_cannot_do_is_refused(heat_problem, time, goals) -> None:
    with pytest.raises(HeatError, match=r"^engine"):
        solve_problem(heat_problem, time, goals, engine=DolfinxEngine())


def test_without_DOLFINx_one_line_says_what_to_install(heat_problem, monkeypatch) -> None:
    monkeypatch.setenv(PYTHON, "/nowhere/python3")
    with pytest.raises(HeatError, match="python3-dolfinx"):
        solve_heat(heat_problem, FOUR_HOURS, engine=DolfinxEngine())


@pytest.mark.parametrize("engine", [2], indirect=True)
def test_a_program_that_fails_is_an_error_that_shows_why(engine, heat_problem, monkeypatch) -> None:
    import thermoxels_ns.heat.dolfinx_engine as module

    monkeypatch.setattr(module, "write_problem", lambda *three: None)
    with pytest.raises(HeatError, match=r"problem\.json"):
        solve_heat(heat_problem, FOUR_HOURS, engine=engine)
