from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import tabulated
from thermoxels_ns.heat import solving as heat_solving
from thermoxels_ns.heat.effects import Convection, HeatFlux
from thermoxels_ns.heat.materials import Material


class Clock:
    """Stands still until it is told to go on."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def perf_counter(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(heat_solving, "clock", clock)
    return clock


def said(clock: Clock, steps: list[tuple[float, float, int]]) -> list[str]:
    """What is said of steps: seconds that each took, the share of the time that is then done, and their number."""
    lines: list[str] = []
    progress = heat_solving._Progress(lines.append)
    for seconds, share, number in steps:
        clock.now_s += seconds
        progress(share, number)
    return lines


def test_the_next_solution_begins_when_the_last_one_has_ended(clock) -> None:
    """As to a tolerance, where one solution follows another."""
    first = [(0.9, 0.1 * step, step) for step in range(1, 11)]
    assert said(clock, [*first, (2.0, 0.1, 1), (10.0, 0.5, 2)]) == [
        "The first step took 2.0 s, for 10% of the time.",
        "50% of the time after 2 steps; about 12 s left.",
    ]


def test_what_is_left_is_told_by_the_last_steps(clock) -> None:
    """Ever longer steps: at the pace from the start on it would be 160 s where 44 s are left."""
    assert said(clock, [(10.0, share, step) for step, share in enumerate((1e-4, 1e-3, 0.02, 0.2), 1)]) == [
        "The first step took 10.0 s, for 0.01% of the time.",
        "0.1% of the time after 2 steps; about 3.1 h left.",
        "2% of the time after 3 steps; about 9 min left.",
        "20% of the time after 4 steps; about 44 s left.",
    ]


def feebly_warmed(depth_m: float = 0.3) -> HeatProblem:
    """A wall between two airs, warmed by 0.05 W/m2, which 25 W/(m2 K) turn into at most 2 mK."""
    mesh = box_mesh(planes(0.0, depth_m, step=depth_m / 6), [0.0, 0.1], [0.0, 0.1], temperature_c=20.0)
    effects = Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, 0.0), HeatFlux(("x1",), 0.05)
    return HeatProblem(mesh, CONCRETE, effects=effects)


def solved(problem: HeatProblem, **goals: Any) -> heat_solving.SolvedProblem:
    return heat_solving.solve_problem(problem, None, heat_solving.Goals(**goals))


def test_what_is_left_out_counts_against_the_tolerance(monkeypatch) -> None:
    """0.05 W/m2 take 2 mK of 50 mK: the solver may err by the other 48, and the estimate holds both."""
    given: list[Any] = []
    inner = heat_solving.solve_to_tolerance

    def remember(problem, tolerance, **named):
        given.append(tolerance)
        return inner(problem, tolerance, **named)

    monkeypatch.setattr(heat_solving, "solve_to_tolerance", remember)
    found = solved(feebly_warmed(), tolerance_k=0.05).accuracy
    assert found is not None and found.left_out_k == pytest.approx(0.002, rel=1e-6)
    assert given[0].temperature_k == pytest.approx(0.048, rel=1e-6)
    assert found.left_out_k < found.estimated_k <= 0.05 and found.met
    everything = solved(feebly_warmed(), tolerance_k=0.05, leave_out_below_k=0.0).accuracy
    assert everything is not None and everything.left_out_k == 0.0 and given[1].temperature_k == 0.05


@pytest.mark.parametrize(
    ("tolerance_k", "share", "given", "expected"),
    [
        *((None, None, None, 0.01), (0.05, None, None, 0.01), (0.5, None, None, 0.1)),
        *((None, 0.01, None, 0.0), (0.5, 0.01, None, 0.0), (0.5, 0.01, 0.2, 0.2), (None, None, 0.0, 0.0)),
    ],
)
def test_what_may_be_left_out_unless_it_is_said(tolerance_k, share, given, expected) -> None:
    goals = heat_solving.Goals(tolerance_k=tolerance_k, flow_tolerance=share, leave_out_below_k=given)
    assert goals.left_out_k == pytest.approx(expected) and np.isfinite(expected)


def tight_wall(flux_w_m2: float) -> HeatProblem:
    """A wall of U = 0.1 W/(m2 K) between airs of 20 and 0 degrees, with a flux on its outer face."""
    mesh = box_mesh(planes(0.0, 0.34, step=0.034), [0.0, 0.1], [0.0, 0.1], temperature_c=20.0)
    effects = Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, 0.0), HeatFlux(("x1",), flux_w_m2)
    return HeatProblem(mesh, Material("wool", 0.035, 30.0, 1000.0), effects=effects)


@pytest.mark.parametrize("time", [None, TimeSteps(10, 1e6)])
def test_what_matters_to_heat_flows_is_built_however_little_it_warms(time) -> None:
    """0.2 W/m2 warm a face with 25 W/(m2 K) by 0.008 K, but 2 W/m2 are all that flows through the wall."""
    lines: list[str] = []
    found = heat_solving.solve_problem(tight_wall(0.2), time, heat_solving.Goals(), lines.append)
    assert found.screening.left_out == () and len(found.solution.effects) == 3
    assert found.screening.kept[2].reason == "it matters to heat flows"
    assert any("solved again" in line and "--leave-out-below-k 0.01" in line for line in lines)
    in_kelvin = heat_solving.solve_problem(tight_wall(0.2), time, heat_solving.Goals(leave_out_below_k=0.01))
    assert len(in_kelvin.screening.left_out) == 1, "if kelvins are asked for, they count alone"
    outside_w = [float(np.mean(each.solution.effects[1].heat_w)) for each in (found, in_kelvin)]
    assert outside_w[0] / outside_w[1] > 1.05
    little = heat_solving.solve_problem(tight_wall(0.01), time, heat_solving.Goals())
    assert [entry.effect for entry in little.screening.left_out] == ["heat flux on x1"]
    assert little.screening.bound_w == pytest.approx(0.01 * 0.01)


def test_nothing_that_brings_heat_is_left_out_beside_a_tolerance_of_heat_flows() -> None:
    found = solved(tight_wall(0.01), flow_tolerance=0.05, leave_out_below_k=0.1)
    assert found.screening.left_out == ()


def test_to_a_tolerance_effects_are_looked_at_as_steps_are_taken(monkeypatch) -> None:
    """Steps are then chosen by their error: what happens between the scene's own steps counts."""
    pulse = tabulated([0.0, 600.0, 1200.0, 1800.0], [0.0, 500.0, 0.0, 0.0])
    problem = replace(tight_wall(0.0), effects=(HeatFlux(("x1",), pulse),))
    asked: list[Any] = []

    def remember(kept, tolerance, **named):
        asked.append(kept)
        raise HeatError("enough")

    monkeypatch.setattr(heat_solving, "solve_to_tolerance", remember)
    with pytest.raises(HeatError, match="enough"):
        heat_solving.solve_problem(problem, TimeSteps(1, 1800.0), heat_solving.Goals(tolerance_k=0.5))
    assert asked[0].effects == problem.effects


def test_a_body_on_which_nothing_acts_is_said_to_be_insulated() -> None:
    lines: dict[int, list[str]] = {0: [], 1: []}
    for count, said_of in lines.items():
        effects = (HeatFlux(("x1",), 5.0),) * count
        heat_solving.solve_problem(
            replace(tight_wall(0.0), effects=effects), TimeSteps(1, 60.0), heat_solving.Goals(), said_of.append
        )
    assert [any("Nothing acts" in line for line in said_of) for said_of in lines.values()] == [True, False]
