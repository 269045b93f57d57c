from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import SIDES, box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, Quantity, TimeSteps, Varying, tabulated
from thermoxels_ns.fem.runge_kutta import BACKWARD_EULER, SDIRK2
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, HeatFlux, Radiation
from thermoxels_ns.heat.scene_fields import Sun

PAPER = TimeSteps(10, 60.0)
SUN = Sun(datetime(2026, 1, 10, tzinfo=timezone.utc), 47.0, 0.0, (0.0, 1.0, 0.0), clear_sky="meinel")


@pytest.mark.parametrize("temperature_c", [-273.15, -40.0, 0.1, 20.0, 1500.3])
def test_uniform_temperature_does_not_change_at_all(random_body, concrete, temperature_c) -> None:
    start = np.full(len(random_body.points_m), temperature_c)
    solution = solve_heat(HeatProblem(random_body, concrete, start), PAPER)
    np.testing.assert_array_equal(solution.temperature_c, temperature_c)
    assert solution.energy_residual == 0.0


def test_failure_to_converge_raises(random_body, concrete, monkeypatch) -> None:
    monkeypatch.setattr("thermoxels_ns.fem.implicit_equation.MOST_UNBALANCED", 0.0)
    with pytest.raises(HeatError, match=r"The step from 0 s failed.*are not balanced"):
        solve_heat(HeatProblem(random_body, concrete), PAPER)


@pytest.mark.parametrize("outputs", [1, 10])
def test_a_body_at_rest_in_the_dark_still_sees_the_sun_rise(concrete, outputs: int) -> None:
    """Nothing flows at midnight; a step as long as an interval would end at midnight again."""
    mesh = box_mesh(*(planes(0.0, 0.2, step=0.1) for _ in range(3)))
    mesh = replace(mesh, temperature_c=np.full(len(mesh.points_m), 5.0))
    sun = AbsorbedSolar(SIDES, 0.7, SUN.irradiance())
    problem = HeatProblem(mesh, concrete, effects=(Convection(SIDES, 10.0, 5.0), sun))
    days = solve_heat(problem, AdaptiveSteps(4 * 86400.0, outputs=outputs))
    assert days.steps >= 96  # one an hour at least
    fine = solve_heat(problem, TimeSteps(4 * 24 * 12, 300.0))
    mean_w = {heat.effect.split(" on ")[0]: float(heat.heat_w.mean()) for heat in days.effects}
    fine_w = {heat.effect.split(" on ")[0]: float(heat.heat_w.mean()) for heat in fine.effects}
    assert fine_w["absorbed solar"] > 1.0
    assert mean_w["absorbed solar"] == pytest.approx(fine_w["absorbed solar"], rel=0.02)
    coarse = solve_heat(problem, TimeSteps(4, 86400.0))
    assert "Steps of 86400 s are longer than the 3600 s by which effects" in coarse.status
    assert "longer than" not in fine.status


@pytest.mark.parametrize("radiates", [False, True])
def test_equal_steps_tell_their_error(radiates) -> None:
    """A wall in air that swings over a day, with steps of 1200 s: against steps of 75 s."""
    swing = Varying(lambda places, time_s: 10.0 + 8.0 * np.sin(2.0 * np.pi * time_s / 86400.0))
    mesh = box_mesh(planes(0.0, 0.3, step=0.05), [0.0, 0.1], [0.0, 0.1], temperature_c=10.0)
    effects = (Convection(("x1",), 25.0, swing), *([Radiation(("x1",), 0.9, 0.0)] if radiates else []))
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    found = solve_heat(problem, TimeSteps(72, 1200.0), estimate_steps=True)
    exact = solve_heat(problem, TimeSteps(1152, 75.0)).temperature_c[::16]
    true_k = float(np.abs(found.temperature_c - exact).max())
    assert 0.5 < found.time_error_k / true_k < 2.0
    assert f"an error of about {found.time_error_k:.2g} K at most" in found.status
    assert np.isnan(solve_heat(problem, TimeSteps(72, 1200.0)).time_error_k)
    assert "takes two of them" in solve_heat(problem, TimeSteps(1, 1200.0), estimate_steps=True).status


@pytest.mark.parametrize("scheme", [BACKWARD_EULER, SDIRK2])
@pytest.mark.parametrize("step_s", [1e-9, 1e-6, 1e-3])
def test_newton_takes_few_steps_however_short_the_time_step(concrete, scheme, step_s) -> None:
    """Of two plates that do not touch, at 20 and 60 C."""
    x, apart = [0.0, 0.01, 0.02, 0.03], lambda p: np.abs(p[..., 0] - 0.015) > 0.005
    mesh = box_mesh(x, x, x[:2], keep=apart, temperature_c=lambda p: np.where(p[:, 0] > 0.015, 60.0, 20.0))
    problem = HeatProblem(mesh, concrete, effects=(Radiation(("x1",), 0.9, 306.6),))
    solution = solve_heat(problem, TimeSteps(3, step_s), scheme=scheme)
    assert solution.newton_iterations.max() <= 3 * len(scheme.nodes)
    # As long as nothing has changed to speak of, the heat is that of the first moment.
    around, plate = 306.6 + 273.15, 60.0 + 273.15
    heat = 0.9 * 5.670374419e-8 * (around**4 - plate**4) * 0.03 * 0.01
    np.testing.assert_allclose(solution.effects[0].heat_w, heat, rtol=1e-4)


def test_newton_ends_near_a_steady_state_and_after_it(concrete) -> None:
    """Restarts from what is all but steady: the residual begins at round-off and has nowhere to go."""
    effects = (Radiation(("x1",), 0.9, 306.6), Convection(("x0",), 8.0, 10.0))
    mesh = box_mesh(*[np.arange(4) * 0.05] * 3, temperature_c=100.0)
    problem = HeatProblem(mesh, concrete, effects=effects)
    steady = solve_steady(problem).temperature_c
    for away in (0.0, 1e-12, 1e-9, 1e-6):
        near = replace(problem, initial_temperature_c=steady + away * np.sin(np.arange(len(steady))))
        for time in (AdaptiveSteps(1e5, 1e-4, outputs=3), TimeSteps(3, 1e-6), TimeSteps(3, 1e7)):
            solution = solve_heat(near, time)
            assert np.abs(solution.temperature_c[-1] - steady).max() < max(10.0 * away, 1e-8)


HOUR_S = 3600.0
TIMES_S = np.array([0.0, 100.0, 101.0, 102.0, 200.0]) * HOUR_S
FLASH = np.array([0.0, 0.0, 500.0, 0.0, 0.0])


def warmed(flux: Quantity, time: TimeSteps | AdaptiveSteps):
    mesh = box_mesh(np.linspace(0, 0.2, 5), [0, 0.1], [0, 0.1])
    return solve_heat(HeatProblem(mesh, CONCRETE, effects=(HeatFlux(("x1",), flux),)), time)


def test_adaptive_steps_do_not_step_over_a_table() -> None:
    """Two hours of heat in a week: a triangle of 500 W/m2, 1800 kJ/m2 in all."""
    solution = warmed(tabulated(TIMES_S, FLASH), AdaptiveSteps(TIMES_S[-1], 0.5, outputs=1))
    brought_j = float(solution.heat_w[0]) * TIMES_S[-1]
    assert brought_j == pytest.approx(500.0 * HOUR_S * 0.01, rel=0.05)
