from dataclasses import replace
from datetime import datetime, timezone
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, SIDES, box_mesh, planes
from tests.support.stuffed_shapes import body
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, Varying, tabulated
from thermoxels_ns.fem.solution import SteadySolution, mean_flows_w
from thermoxels_ns.fem.tolerance import LEAVE_OUT_BELOW
from thermoxels_ns.heat import solving as heat_solving
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.heat.scene_fields import Sun
from thermoxels_ns.heat.solving import Goals, solve_problem


def test_progress_is_told_now_and_then(monkeypatch) -> None:
    now_s, said = [0.0], []
    monkeypatch.setattr(heat_solving, "clock", SimpleNamespace(perf_counter=lambda: now_s[0]))
    progress = heat_solving._progress(said.append)
    for step in range(1, 11):
        now_s[0] += 3.0
        progress(0.1 * step, step)
    assert said == ["40.00% of the time after 4 steps.", "80.00% of the time after 8 steps."]


AIRS = Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, 0.0)
CONFORMING = body()
"""A slab cut from voxels at 30 degrees, with obtuse angles as exports have."""


def solved(problem: HeatProblem, time: heat_solving.Time = None, **goals: Any) -> heat_solving.SolvedProblem:
    return heat_solving.solve_problem(problem, time, heat_solving.Goals(**goals))


def test_equal_steps_say_what_error_they_make() -> None:
    found = solved(HeatProblem(CONFORMING, CONCRETE, effects=AIRS), TimeSteps(4, 3600.0)).solution
    assert "The steps make an error of about" in found.status and np.isfinite(found.time_error_k)


BY_STRENGTH = {
    "sun": lambda strength: AbsorbedSolar(("x1",), 0.6, 500.0 * strength),
    "wind": lambda strength: Convection(("x1",), 20.0 * strength, -5.0),
    "sky": lambda strength: Radiation(("*",), 0.9 * strength, -30.0),
    "source": lambda strength: InternalHeat(("*",), 1000.0 * strength),
}


@pytest.mark.parametrize("time", [None, TimeSteps(5, 36_000.0), AdaptiveSteps(36_000.0, 0.5, outputs=2)], ids=str)
@pytest.mark.parametrize("name", BY_STRENGTH)
def test_what_is_left_out_brings_little_and_what_brings_more_is_built(name, time) -> None:
    """On a conforming mesh, from far too little to far too much to be left out."""
    left_out = []
    for strength in (1e-6, 1e-3, 1.0):
        problem = HeatProblem(CONFORMING, CONCRETE, effects=(*AIRS, BY_STRENGTH[name](strength)))
        found, whole = solved(problem, time), solved(problem, time, leave_out_below=0.0)
        left_out.append(len(found.left_out))
        flows, all_flows = mean_flows_w(found.solution), mean_flows_w(whole.solution)
        through_w = 0.5 * sum(map(abs, all_flows.values()))
        for effect, flow in all_flows.items():
            assert abs(flows.get(effect, 0.0) - flow) <= LEAVE_OUT_BELOW * through_w
        for entry in found.left_out:
            assert abs(all_flows[entry.effect]) <= entry.heat_w * 1.001
            assert entry.share <= LEAVE_OUT_BELOW
    assert left_out == sorted(left_out, reverse=True) and left_out[0] == 1 and left_out[-1] == 0


def tight_wall(flux: float | Varying) -> HeatProblem:
    """A wall of U = 0.1 W/(m2 K) between airs of 20 and 0 degrees, with a flux on its outer face."""
    mesh = box_mesh(planes(0.0, 0.34, step=0.034), [0.0, 0.1], [0.0, 0.1], temperature_c=20.0)
    return HeatProblem(mesh, Material("wool", 0.035, 30.0, 1000.0), effects=(*AIRS, HeatFlux(("x1",), flux)))


@pytest.mark.parametrize("time", [None, TimeSteps(10, 1e6)])
def test_what_matters_beside_the_heat_that_really_flows_is_taken_in_again(time) -> None:
    """0.2 W/m2 are little beside what two airs could bring, but 2 W/m2 are all that flows through the wall."""
    lines: list[str] = []
    found = heat_solving.solve_problem(tight_wall(0.2), time, heat_solving.Goals(), lines.append)
    assert found.left_out == () and len(found.solution.effects) == 3
    assert any("solved again with heat flux on x1 (up to 0.002 W)" in line for line in lines)
    little = solved(tight_wall(0.005), time)
    assert [entry.effect for entry in little.left_out] == ["heat flux on x1"]
    assert little.left_out[0].heat_w == pytest.approx(0.005 * 0.01)
    assert little.left_out[0].share == pytest.approx(0.005 / 2.0, rel=0.05)


def test_together_they_keep_within_the_share() -> None:
    """Two fluxes of 0.3 % of the heat each are too much together."""
    wall = tight_wall(0.006)
    found = solved(replace(wall, effects=(*AIRS, HeatFlux(("x1",), 0.006), HeatFlux(("x0",), 0.006))))
    assert found.left_out == () and len(found.solution.effects) == 4


def test_beside_a_tolerance_all_that_brings_heat_is_built() -> None:
    idle = Convection(("x1",), 0.0, -50.0)
    problem = replace(tight_wall(1e-6), effects=(*tight_wall(1e-6).effects, idle))
    found = solved(problem, flow_tolerance=0.05)
    assert [entry.heat_w for entry in found.left_out] == [0.0] and len(found.solution.effects) == 3


@pytest.mark.parametrize("time", [TimeSteps(300, 0.1), AdaptiveSteps(36_000.0)])
def test_what_changes_with_time_is_always_built(time) -> None:
    pulse = Varying(lambda _, t: 2000.0 if 7.6 < t < 7.8 else 0.0)
    problem = replace(tight_wall(0.0), effects=(*AIRS, AbsorbedSolar(SIDES, 0.7, pulse)))
    assert solved(problem, time).left_out == ()


def test_beside_what_changes_with_time_nothing_is_left_out() -> None:
    """A pane in the sun is back at the room's temperature at each midnight, the only times kept: no heat flows then."""
    pane = box_mesh(planes(0.0, 0.006, step=0.003), planes(0.0, 1.0, step=0.25), planes(0.0, 1.0, step=0.25))
    hours = np.arange(73.0)
    day = tabulated(3600.0 * hours, 20.0 + 5.0 * (1.0 - np.cos(2.0 * np.pi * hours / 24.0)))
    june = datetime(2026, 6, 21, tzinfo=timezone.utc)
    sun = Sun(june, 50.0, 0.0, (-1.0, 0.0, 0.0), clear_sky="meinel").irradiance()
    effects = (Convection(("x1",), 7.7, 20.0), Convection(("x0",), 25.0, day), AbsorbedSolar(("x0",), 0.7, sun))
    problem = HeatProblem(pane, CONCRETE, np.full(len(pane.points_m), 20.0), effects)
    found = solve_problem(problem, AdaptiveSteps(72 * 3600.0, 0.1, outputs=3), Goals(), lambda _: None)
    room_w = float(np.mean(found.solution.effects[0].heat_w))
    assert found.left_out == () and room_w < -30.0


def test_the_only_exchange_of_a_steady_body_stays() -> None:
    """Air as warm as the body brings no heat, but without it there is no steady state."""
    lone = replace(tight_wall(0.0), effects=(Convection(("x0",), 5.0, 20.0),))
    assert solved(lone).left_out == () and len(solved(lone, TimeSteps(3, 60.0)).left_out) == 1


def test_what_fixes_temperatures_stays() -> None:
    """A flux onto a fixed surface changes no temperature, but its heat counts."""
    fixed = FixedTemperature(("x0",), 20.0)
    problem = replace(tight_wall(0.0), effects=(fixed, HeatFlux(("x0",), 1e6)))
    assert solved(problem, TimeSteps(3, 60.0)).left_out == ()


def test_a_mesh_error_is_estimated_without_a_tolerance_if_there_is_room() -> None:
    for memory_gb, known in ((4.0, True), (1e-3, False)):
        solution = solved(HeatProblem(CONFORMING, CONCRETE, effects=AIRS), memory_gb=memory_gb).solution
        assert isinstance(solution, SteadySolution) and (solution.error is not None) is known
