from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_matrices import assemble
from tests.support.heat_meshes import SIDES, box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.runge_kutta import Step
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.time_loop import HeatBalance, solve_heat
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, Radiation
from thermoxels_ns.heat.sky import moving_sun
from thermoxels_ns.mesh.tetrahedra import TetMesh

PAPER = TimeSteps(10, 60.0)


def heat_content(mesh: TetMesh, material, temperature_c: np.ndarray) -> np.ndarray:
    """Integral of rho c T, T in kelvin, by the volumes of the tetrahedra: knows nothing of the solver's matrices."""
    edges = mesh.points_m[mesh.tets[:, 1:]] - mesh.points_m[mesh.tets[:, :1]]
    volumes = np.linalg.det(edges) / 6.0
    means = (temperature_c[..., mesh.tets] + 273.15).mean(axis=-1)
    return material.heat_capacity_j_m3k * means @ volumes


@pytest.mark.parametrize("step_seconds", [1e-2, 60.0, 1e9])
def test_heat_is_conserved(random_body, concrete, step_seconds) -> None:
    solution = solve_heat(HeatProblem(random_body, concrete), TimeSteps(10, step_seconds))
    content = heat_content(random_body, concrete, solution.temperature_c)
    assert np.abs(content / content[0] - 1.0).max() < 1e-12
    assert solution.energy_residual < 1e-14
    assert solution.energy_residual_of_spread < 1e-12
    np.testing.assert_allclose(solution.heat_content_j, content, rtol=1e-12)
    assert np.ptp(solution.temperature_c[-1]) < np.ptp(solution.temperature_c[0])  # heat did move


def test_every_step_satisfies_the_equations(random_body, concrete) -> None:
    """M (T1 - T0) / dt + K T1 = 0 at every node, independently of how the step was solved."""
    matrices = assemble(random_body, concrete)
    solution = solve_heat(HeatProblem(random_body, concrete), PAPER)
    for before, after in zip(solution.temperature_c, solution.temperature_c[1:]):
        conducted = matrices.stiffness_w_k @ after
        balance = matrices.mass_j_k @ (after - before) / 60.0 + conducted
        assert np.abs(balance).max() < 1e-10 * np.abs(conducted).max()


def test_a_long_step_levels_the_temperature_at_the_mean(random_body, concrete) -> None:
    solution = solve_heat(HeatProblem(random_body, concrete), TimeSteps(1, 1e12))
    mass = assemble(random_body, concrete).nodal_mass_j_k
    np.testing.assert_allclose(solution.temperature_c[-1], mass @ random_body.temperature_c / mass.sum(), atol=1e-5)


@pytest.mark.parametrize("temperature_c", [-273.15, -40.0, 0.1, 20.0, 1500.3])
def test_uniform_temperature_does_not_change_at_all(random_body, concrete, temperature_c) -> None:
    start = np.full(len(random_body.points_m), temperature_c)
    solution = solve_heat(HeatProblem(random_body, concrete, start), PAPER)
    np.testing.assert_array_equal(solution.temperature_c, temperature_c)
    assert solution.energy_residual == 0.0 and solution.energy_residual_of_spread == 0.0


def test_failure_to_converge_raises(random_body, concrete, monkeypatch) -> None:
    monkeypatch.setattr("thermoxels_ns.fem.implicit_equation.MOST_UNBALANCED", 0.0)
    with pytest.raises(HeatError, match=r"Step 1 of 10 failed.*are not balanced"):
        solve_heat(HeatProblem(random_body, concrete), PAPER)


def test_states_that_do_not_fit_into_memory_are_refused(random_body, concrete, monkeypatch) -> None:
    nodes = len(random_body.points_m)
    monkeypatch.setattr("thermoxels_ns.fem.time_loop.MAX_STATE_BYTES", 11 * nodes * 8)
    assert len(solve_heat(HeatProblem(random_body, concrete), PAPER).times_s) == 11
    with pytest.raises(
        HeatError, match=rf"12 times x {nodes} nodes x 8 bytes = {12 * nodes * 8} .*Take at most 10 steps,"
    ):
        solve_heat(HeatProblem(random_body, concrete), TimeSteps(11, 60.0))


@pytest.mark.parametrize("outputs", [1, 10])
def test_a_body_at_rest_in_the_dark_still_sees_the_sun_rise(concrete, outputs: int) -> None:
    """Nothing flows at midnight; a step as long as an interval would end at midnight again."""
    mesh = box_mesh(*(planes(0.0, 0.2, step=0.1) for _ in range(3)))
    mesh = replace(mesh, temperature_c=np.full(len(mesh.points_m), 5.0))
    sun = AbsorbedSolar(SIDES, 0.7, moving_sun(datetime(2026, 1, 10, tzinfo=timezone.utc), 47.0, 0.0, (0.0, 1.0, 0.0)))
    problem = HeatProblem(mesh, concrete, effects=(Convection(SIDES, 10.0, 5.0), sun))
    days = solve_heat(problem, AdaptiveSteps(4 * 86400.0, outputs=outputs))
    assert days.steps >= 96  # one an hour at least
    fine = solve_heat(problem, TimeSteps(4 * 24 * 12, 300.0))
    mean_w = {heat.effect.split(" on ")[0]: float(heat.heat_w.mean()) for heat in days.effects}
    fine_w = {heat.effect.split(" on ")[0]: float(heat.heat_w.mean()) for heat in fine.effects}
    assert (
        mean_w["absorbed solar"] == pytest.approx(fine_w["absorbed solar"], rel=0.02) and mean_w["absorbed solar"] > 1.0
    )
    coarse = solve_heat(problem, TimeSteps(4, 86400.0))
    assert "Steps of 86400 s are longer than the 3600 s by which effects" in coarse.status
    assert "longer than" not in fine.status


def test_heat_that_nothing_accounts_for_is_told_beside_what_is_stored() -> None:
    """A body that warms by 0.1 K without a flow, beside differences from its mean of 6 K over half of its mass."""
    mesh = box_mesh([0.0, 0.5, 1.0], [0.0, 1.0], [0.0, 1.0], temperature_c=lambda p: 12.0 * (p[:, 0] - 0.5))
    system = HeatSystem(HeatProblem(mesh, CONCRETE))
    states = np.stack([system.start_k, system.start_k + 0.1])
    balance = HeatBalance(system, states.copy(), np.array([0.0, 60.0]))
    step = Step(states[1], np.zeros(0), 1, 0, np.nan, True, "")
    balance.add(step, 60.0, ends_interval=True)
    found = balance.close("", adaptive=False)
    assert found.energy_residual_of_spread == pytest.approx(0.1 / 3.0, rel=1e-9)
    assert found.energy_residual == pytest.approx(0.1 / 273.15, rel=1e-9)


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
