import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Places, Quantity, Varying, tabulated
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import HeatFlux

HOUR_S = 3600.0
TIMES_S = [0.0, 100.0 * HOUR_S, 101.0 * HOUR_S, 102.0 * HOUR_S, 200.0 * HOUR_S]
FLASH = [0.0, 0.0, 500.0, 0.0, 0.0]


def warmed(flux: Quantity, time: TimeSteps | AdaptiveSteps):
    mesh = box_mesh(np.linspace(0, 0.2, 5), [0, 0.1], [0, 0.1])
    return solve_heat(HeatProblem(mesh, CONCRETE, effects=(HeatFlux(("x1",), flux),)), time)


def test_a_table_is_straight_from_entry_to_entry_and_held_outside() -> None:
    table, nowhere = tabulated([10.0, 20.0, 50.0], [1.0, 3.0, 0.0]), Places(np.zeros((1, 3)), np.zeros((1, 3)))
    assert [table.function(nowhere, time_s) for time_s in (0.0, 10.0, 15.0, 35.0, 99.0)] == [1.0, 1.0, 2.0, 1.5, 0.0]
    assert table.resolution_s == 10.0 and table.in_time


def test_adaptive_steps_do_not_step_over_a_table() -> None:
    """Two hours of heat in a week: a triangle of 500 W/m2, 1800 kJ/m2 in all."""
    solution = warmed(tabulated(TIMES_S, FLASH), AdaptiveSteps(TIMES_S[-1], 0.5, outputs=1))
    brought_j = float(solution.heat_w[0]) * TIMES_S[-1]
    assert brought_j == pytest.approx(500.0 * HOUR_S * 0.01, rel=0.05)
    assert "Nothing says" not in solution.status


def test_what_may_be_stepped_over_is_said() -> None:
    def flash(_, time_s: float) -> float:
        return float(np.interp(time_s, TIMES_S, FLASH))

    missed = warmed(Varying(flash), AdaptiveSteps(TIMES_S[-1], 0.5, outputs=1))
    assert float(missed.heat_w[0]) == 0.0
    assert "Nothing says how fast heat flux on x1 may change with time" in missed.status
    assert "resolution_s" in missed.status and "tabulated" in missed.status
    seen = warmed(Varying(flash, resolution_s=HOUR_S), AdaptiveSteps(TIMES_S[-1], 0.5, outputs=1))
    assert float(seen.heat_w[0]) > 0.0 and "Nothing says" not in seen.status
