"""Even steps are those of the general stepper, and their error is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.error_budget import mean_flows_w
from thermoxels_ns.fem.even_steps import EvenSteps
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.schemes import SDIRK2
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.effects import Convection, FixedTemperature, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material

CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)
STEEL = Material("steel", 35.0, 7200.0, 440.5)
ANY_K = 1e9


def rod(parts: int = 10) -> HeatProblem:
    mesh = box_mesh(np.linspace(0, 0.1, parts + 1), [0, 0.01], [0, 0.01], temperature_c=0.0)
    swing = Varying(lambda places, time_s: 100.0 * np.sin(np.pi * time_s / 40.0))
    return HeatProblem(mesh, STEEL, effects=(FixedTemperature(("x0",), 0.0), FixedTemperature(("x1",), swing)))


def cube(*effects) -> HeatProblem:
    axis = np.linspace(0.0, 0.3, 5)
    return HeatProblem(box_mesh(axis, axis, axis, temperature_c=60.0), CONCRETE, effects=effects)


def two_pieces() -> HeatProblem:
    """One piece in wind and one that is insulated and warmed from inside, both warmer at one end."""
    mesh = box_mesh(
        np.linspace(0.0, 0.5, 6),
        [0.0, 0.1],
        [0.0, 0.1],
        temperature_c=lambda points: 20.0 + 100.0 * points[:, 0],
        keep=lambda p: np.abs(p[..., 0] - 0.25) > 0.05,
        regions={"left": lambda p: p[..., 0] < 0.25, "right": lambda p: p[..., 0] > 0.25},
    )
    return HeatProblem(
        mesh,
        {"left": CONCRETE, "right": CONCRETE},
        effects=(Convection(("x0",), 25.0, 5.0), InternalHeat(("right",), 500.0)),
    )


def suddenly_hot(parts: int) -> HeatProblem:
    mesh = box_mesh(np.linspace(0, 1.2, parts + 1), [0, 0.2], [0, 0.2], temperature_c=4.0)
    return HeatProblem(mesh, CONCRETE, effects=(FixedTemperature(("x0",), 100.0),))


CASES = {
    "rod": (rod, 32.0),
    "cube": (lambda: cube(Convection(("*",), 25.0, 0.0)), 3600.0),
    "two pieces": (two_pieces, 7200.0),
    "insulated": (lambda: replace(two_pieces(), effects=()), 7200.0),
}


@pytest.mark.parametrize("name", CASES)
def test_they_are_the_steps_of_the_general_stepper(name) -> None:
    make, duration_s = CASES[name]
    problem = make()
    even = EvenSteps(HeatSystem(problem), AdaptiveSteps(duration_s, ANY_K), ANY_K)
    solution, same = even.solution(), solve_heat(problem, TimeSteps(10, duration_s / 10), scheme=SDIRK2)
    assert even.found and solution is not None
    size_k = float(np.ptp(same.temperature_c))
    np.testing.assert_allclose(solution.temperature_c, same.temperature_c, atol=1e-8 * size_k)
    np.testing.assert_allclose(even.temperature_c, same.temperature_c, atol=1e-8 * size_k)
    assert solution.energy_residual_of_spread < 1e-9 and solution.steps == 10
    flows_w, expected_w = mean_flows_w(solution), mean_flows_w(same)
    size_w = max(map(abs, expected_w.values()), default=0.0)
    assert flows_w == pytest.approx(expected_w, abs=1e-7 * size_w)
    assert even.mean_flows_w() == pytest.approx(expected_w, abs=1e-7 * size_w)
    for heat, other in zip(solution.effects, same.effects):
        np.testing.assert_allclose(heat.group_heat_w, other.group_heat_w, atol=1e-7 * float(np.abs(other.heat_w).max()))


@pytest.mark.parametrize(
    ("make", "duration_s", "allowed_k"),
    [
        (rod, 32.0, 0.3),
        (rod, 32.0, 0.06),
        (lambda: rod(40), 32.0, 0.3),
        (lambda: suddenly_hot(13), 36_000.0, 0.5),
        (lambda: suddenly_hot(52), 36_000.0, 0.2),
        (lambda: cube(Convection(("*",), 25.0, 0.0)), 36_000.0, 0.2),
        (two_pieces, 7200.0, 0.05),
    ],
)
def test_their_error_is_known_and_allowed(make, duration_s, allowed_k) -> None:
    problem = make()
    even = EvenSteps(HeatSystem(problem), AdaptiveSteps(duration_s, allowed_k), allowed_k)
    solution = even.solution()
    assert solution is not None
    exact = solve_heat(problem, TimeSteps(320, duration_s / 320), scheme=SDIRK2).temperature_c[::32]
    true_k, estimate_k = float(np.abs(solution.temperature_c - exact).max()), float(np.abs(even.errors_k()).max())
    assert estimate_k <= allowed_k and solution.time_error_k == estimate_k
    assert true_k <= allowed_k
    assert 1 / 1.5 < estimate_k / true_k < 3.0, (estimate_k, true_k)


@pytest.mark.parametrize("parts", [10, 20])
@pytest.mark.parametrize("allowed_k", [0.3, 0.06])
def test_their_error_is_known_with_its_sign_where_a_temperature_swings(parts, allowed_k) -> None:
    problem = rod(parts)
    even = EvenSteps(HeatSystem(problem), AdaptiveSteps(32.0, allowed_k), allowed_k)
    exact = solve_heat(problem, TimeSteps(640, 0.05), scheme=SDIRK2).temperature_c[::64]
    true_k, estimate_k = (even.temperature_c - exact)[1:], -even.errors_k()[1:]
    assert even.found
    sizes = np.linalg.norm(estimate_k, axis=1), np.linalg.norm(true_k, axis=1)
    cosines = np.sum(true_k * estimate_k, axis=1) / (sizes[0] * sizes[1])
    assert cosines.min() > 0.9, cosines
    ratios = np.abs(estimate_k).max(axis=1) / np.abs(true_k).max(axis=1)
    assert ratios.min() > 0.6 and ratios.max() < 1.7, ratios


def test_only_a_sudden_start_takes_short_steps() -> None:
    times: list[tuple[float, int]] = []
    problem = suddenly_hot(52)
    time = AdaptiveSteps(36_000.0, 0.2)
    even = EvenSteps(HeatSystem(problem), time, 0.2, progress=lambda share, steps: times.append((share, steps)))
    counts = np.diff([0, *(steps for _, steps in times)])
    assert counts[0] >= 4 and counts[-1] == 1 and np.all(np.diff(counts) <= 0), counts
    assert [share for share, _ in times] == pytest.approx(np.arange(1, 11) / 10)
    looked_at: list[float] = []

    def starts_well(temperature_c: np.ndarray, error_k: float) -> bool:
        assert temperature_c.shape == (len(problem.mesh.points_m),) and temperature_c.max() == pytest.approx(100.0)
        looked_at.append(error_k)
        return error_k <= 0.2

    start = EvenSteps(HeatSystem(problem), time, ANY_K, starts_well=starts_well)
    assert start.start_error_k == looked_at[-1] <= 0.2 < looked_at[0] and even.found
    assert np.abs(start.errors_k()).max() >= np.abs(even.errors_k()).max()


def test_what_jumps_over_the_range_is_taken_again_with_shorter_steps() -> None:
    """One long step after a sudden start overshoots."""
    problem = cube(Convection(("*",), 25.0, 0.0))
    even = EvenSteps(HeatSystem(problem), AdaptiveSteps(360_000.0, 1e-3), ANY_K)
    assert even.found and even.temperature_c.min() < -0.1
    solution = even.solution()
    assert solution is not None and solution.steps > 10
    assert solution.temperature_c.min() > -1e-4 and solution.temperature_c.max() <= 60.0
    np.testing.assert_array_equal(even.temperature_c, solution.temperature_c)
    assert solution.time_error_k == np.abs(even.errors_k()).max()


@pytest.mark.parametrize("duration_s", [700_000.0, 36_000_000.0])
def test_where_many_steps_jump_over_the_range_there_is_no_solution(duration_s) -> None:
    """Adaptive steps then take safe ones: of 32 steps in the first interval or of thousands none would jump."""
    problem = cube(Convection(("*",), 25.0, 0.0))
    even = EvenSteps(HeatSystem(problem), AdaptiveSteps(duration_s, 1e-3), ANY_K)
    assert even.found and even.temperature_c.min() < -0.1
    assert even.solution() is None


def test_iterations_of_all_steps_of_an_interval_are_counted() -> None:
    """Where steps are equal from interval to interval, so is the work: half as many steps take about half of it."""
    problem, time = two_pieces(), AdaptiveSteps(72_000.0, ANY_K)
    few, many = (EvenSteps(HeatSystem(problem), time, 0.0, lambda *_: True, count).solution() for count in (1, 8))
    assert few is not None and many is not None
    assert few.steps == 10 and many.steps > 10
    taken = np.array(many.iterations), np.array(few.iterations)
    assert taken[1].min() >= 1 and taken[0].min() >= 1 and taken[0][0] > taken[1][0]
    for solution in (few, many):
        most = int(solution.status.split(" iterations at most")[0].split()[-1])
        assert solution.iterations.max() >= most >= solution.iterations.sum() / solution.steps > 0.0


@pytest.mark.parametrize("start_c", [10.0, 20.0])
def test_a_day_of_outdoor_air_suits_them(start_c) -> None:
    """A thin wall follows the air, and where that turns, steps whose error is allowed take it beyond the air."""
    mesh = box_mesh(np.linspace(0.0, 0.02, 5), [0.0, 0.1], [0.0, 0.1], temperature_c=start_c)
    air = Varying(lambda places, time_s: 10.0 + 8.0 * np.sin(2.0 * np.pi * time_s / 86_400.0))
    problem = HeatProblem(mesh, CONCRETE, effects=(Convection(("*",), 25.0, air),))
    even = EvenSteps(HeatSystem(problem), AdaptiveSteps(86_400.0, 0.05, outputs=20), 0.03)
    assert even.temperature_c[1:].max() > 18.0 + 1e-3
    solution = even.solution()
    assert solution is not None and 20 < solution.steps < 80
    assert solution.temperature_c.min() > 2.0 - 1e-4 and solution.temperature_c[1:].max() < 18.0 + 1e-4
    exact = solve_heat(problem, TimeSteps(320, 270.0), scheme=SDIRK2).temperature_c[::16]
    true_k = float(np.abs(solution.temperature_c - exact).max())
    assert true_k <= 0.03 and 1 / 1.5 < solution.time_error_k / true_k < 3.0, (solution.time_error_k, true_k)
    assert solution.energy_residual_of_spread < 1e-9


@pytest.mark.parametrize(
    "effect",
    [
        Radiation(("x0",), 0.9, 20.0),
        Convection(("x0",), Varying(lambda places, time_s: 10.0 + np.sin(time_s)), 0.0),
    ],
)
def test_they_do_not_suit_what_changes_the_matrix(effect) -> None:
    assert not EvenSteps(HeatSystem(cube(effect)), AdaptiveSteps(3600.0), ANY_K).found


def test_they_are_as_short_as_effects_ask_for() -> None:
    def air(resolution_s: float) -> Convection:
        return Convection(("x0",), 10.0, Varying(lambda places, time_s: 10.0, resolution_s=resolution_s))

    for resolution_s, steps in ((360.0, 10), (100.0, 40), (1.0, None)):
        even = EvenSteps(HeatSystem(cube(air(resolution_s))), AdaptiveSteps(3600.0), ANY_K)
        solution = even.solution() if even.found else None
        assert (None if solution is None else solution.steps) == steps
