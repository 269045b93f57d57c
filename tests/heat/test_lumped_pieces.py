"""Pieces of one temperature each: exact where radiation is absent, and an end to every computation."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.effects import Convection, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.fem.materials import Material
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.heat import lumped_pieces
from thermoxels_ns.heat.lumped_body import lumped_body
from thermoxels_ns.heat.lumped_pieces import PieceEquations, TooHardError, follow_pieces

COPPER = Material("copper", 380.0, 8900.0, 380.0)
NEXT_TO_NOTHING = Material("next to nothing", 380.0, 1e-6, 1e-6)


def cube():
    x = planes(0.0, 0.02, step=0.005)
    return box_mesh(x, x, x, temperature_c=20.0)


@pytest.mark.parametrize(
    "effect", [HeatFlux(("*",), -5000.0), InternalHeat(("*",), -2e6)], ids=["flux", "internal heat"]
)
def test_what_cools_below_absolute_zero_is_left_to_the_full_equations(effect) -> None:
    problem, time = HeatProblem(cube(), COPPER, effects=(effect,)), TimeSteps(10, 600.0)
    lumped = lumped_body(problem, time, 0.5)
    assert lumped.solution is None and "below absolute zero" in lumped.reason
    with pytest.raises(HeatError, match="below absolute zero"):
        solve_heat(problem, time)


@pytest.mark.parametrize(
    ("material", "effects", "seconds", "end_c"),
    [
        (COPPER, (Convection(("*",), 10.0, 0.0),), 1e12, 0.0),
        (NEXT_TO_NOTHING, (Convection(("*",), 1.0, 0.0),), 60.0, 0.0),
        (COPPER, (Convection(("*",), 10.0, 0.0), HeatFlux(("*",), 100.0)), 1e14, 10.0),
        (NEXT_TO_NOTHING, (Radiation(("*",), 1.0, -270.15),), 60.0, -270.15),
        (COPPER, (Radiation(("*",), 0.9, 100.0), Convection(("*",), 10.0, 100.0)), 1e12, 100.0),
    ],
)
def test_an_end_is_found_however_long_it_takes_to_get_there(material, effects, seconds, end_c) -> None:
    """Steps that are 1e9 times as long as the body takes to get there."""
    lumped = lumped_body(HeatProblem(cube(), material, effects=effects), TimeSteps(10, seconds), np.inf)
    assert lumped.solution is not None, lumped.reason
    np.testing.assert_allclose(lumped.solution.temperature_c[1:], end_c, atol=1e-5)
    assert lumped.solution.energy_residual < 1e-9
    assert lumped.solution.energy_residual_of_spread < 1e-9


def test_mean_flows_of_short_and_long_intervals_are_exact() -> None:
    """C T' = h A (air - T): the heat of an interval is C times the change of the temperature."""
    for decay in (1e-12, 1e-3, 0.0199, 0.0201, 1.0, 50.0, 1e9):
        equations = PieceEquations(*(np.array([part]) for part in (2.0, 30.0, 3.0, 0.0, 0.0)), 290.0)
        seconds = decay * 2.0 / 3.0
        history = follow_pieces(equations, np.array([4.0]), np.array([0.0, seconds]))
        change_j, flowed_j = 2.0 * (history.relative_k[1, 0] - 4.0), (30.0 - 3.0 * history.mean_k[0, 0]) * seconds
        assert flowed_j == pytest.approx(change_j, rel=1e-14, abs=4e-15 + 4e-16 * 30.0 * seconds), decay
        assert history.relative_k[1, 0] == pytest.approx(4.0 - 6.0 * np.expm1(-decay), rel=1e-15)


def test_radiation_alone_cools_as_the_third_root_says() -> None:
    """T^-3 - T0^-3 = 3 sigma eps A t / C, to 3 K; the mean of T^4 is the heat that left."""
    capacity, strength = 5.0, 2e-9
    emitted = strength * lumped_pieces.HOT_K**4
    equations = PieceEquations(*(np.array([part]) for part in (capacity, 0.0, 0.0, 0.0, emitted)), 300.0)
    times_s = np.array([0.0, 1.0, 1e3, 1e6, 1e8])
    history = follow_pieces(equations, np.array([700.0]), times_s)
    exact_k = (1000.0**-3 + 3.0 * strength * times_s / capacity) ** (-1.0 / 3.0)
    np.testing.assert_allclose(history.relative_k[:, 0] + 300.0, exact_k, rtol=1e-7)
    left_j = strength * (history.radiating_k[:, 0] + 300.0) ** 4 * np.diff(times_s)
    np.testing.assert_allclose(left_j, -capacity * np.diff(history.relative_k[:, 0]), rtol=1e-9)


def test_a_black_piece_that_only_takes_radiation_in_is_warmed_by_it() -> None:
    """10 W into 5 J / K for 3 s."""
    equations = PieceEquations(*(np.array([part]) for part in (5.0, 0.0, 0.0, 10.0, 0.0)), 300.0)
    history = follow_pieces(equations, np.zeros(1), np.array([0.0, 3.0]))
    assert history.relative_k[1, 0] == pytest.approx(6.0, rel=1e-8) and history.mean_k[0, 0] == pytest.approx(3.0)


def test_a_guess_below_absolute_zero_comes_back() -> None:
    """Emission has the sign of the temperature there, or what a solver tries would run away from zero."""
    equations = PieceEquations(*(np.array([part]) for part in (1.0, 0.0, 0.0, 0.0, 1e6)), 300.0)
    history = follow_pieces(equations, np.array([-310.0]), np.array([0.0, 1.0, 10.0]))
    assert -310.0 < history.relative_k[1, 0] < history.relative_k[2, 0] <= -300.0


def test_pieces_with_and_without_radiation_do_not_disturb_each_other() -> None:
    rng = np.random.default_rng(0)
    parts = rng.uniform(1.0, 5.0, (4, 7))
    emitted = np.where(np.arange(7) % 2, rng.uniform(1.0, 5.0, 7), 0.0)
    start_k, times_s = rng.uniform(-50.0, 50.0, 7), np.array([0.0, 0.5, 2.0, 9.0])
    parts[3] *= emitted > 0.0
    together = follow_pieces(PieceEquations(*parts, emitted, 290.0), start_k, times_s)
    for piece in range(7):
        one = [np.array([part]) for part in (*parts[:, piece], emitted[piece])]
        alone = follow_pieces(PieceEquations(*one, 290.0), start_k[[piece]], times_s)
        np.testing.assert_allclose(together.relative_k[:, [piece]], alone.relative_k, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(together.radiating_k[:, [piece]], alone.radiating_k, rtol=1e-7, atol=1e-6)


def test_what_cannot_be_integrated_is_no_lumped_body(monkeypatch) -> None:
    monkeypatch.setattr(lumped_pieces, "_MOST_RATES", 5)
    problem = HeatProblem(cube(), COPPER, effects=(Radiation(("*",), 0.9, 100.0),))
    lumped = lumped_body(problem, TimeSteps(2, 1e4), np.inf)
    assert lumped.solution is None and "could not be integrated" in lumped.reason
    with pytest.raises(TooHardError):
        follow_pieces(PieceEquations(*np.ones((5, 1)), 290.0), np.zeros(1), np.array([0.0, 1e4]))


def test_the_time_of_many_pieces_grows_with_their_number(monkeypatch) -> None:
    """One evaluation per step for all pieces together, whose matrices stay sparse: 2000 take no more of them."""
    counts = []
    inner = lumped_pieces.solve_ivp

    def count(rate, *positional, **named):
        found = inner(rate, *positional, **named)
        counts.append(found.nfev)
        return found

    monkeypatch.setattr(lumped_pieces, "solve_ivp", count)
    for pieces in (1, 2000):
        follow_pieces(PieceEquations(*np.ones((5, pieces)), 290.0), np.zeros(pieces), np.array([0.0, 10.0]))
    assert counts[1] <= counts[0] + 2
