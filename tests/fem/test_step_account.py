"""The account of steps: all at once is the same as one after the other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.marching import Taken
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.step_account import StepAccount
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.effects import Convection, HeatFlux
from thermoxels_ns.heat.materials import Material

LENGTHS_S = np.array([1.0, 2.0, 3.0, 0.5, 0.5, 0.5])
INTERVALS = np.array([0, 0, 1, 2, 2, 2])
ITERATIONS = [7, 5, 11, 3, 2, 4]
TIMES_S = np.array([0.0, 3.0, 6.0, 7.5])


def system() -> HeatSystem:
    mesh = box_mesh([0.0, 0.1, 0.2], [0.0, 0.1], [0.0, 0.1], temperature_c=20.0)
    effects = Convection(("x0",), 8.0, 5.0), HeatFlux(("x1",), 30.0)
    return HeatSystem(HeatProblem(mesh, Material("concrete", 1.7, 2200.0, 880.0), effects=effects))


def test_steps_that_are_counted_at_once_are_counted_as_one_by_one() -> None:
    body, rng = system(), np.random.default_rng(0)
    heat_w = rng.normal(size=(len(LENGTHS_S), len(body.groups)))
    states_k = [rng.normal(size=(len(TIMES_S), body.num_nodes))] * 2
    states_k[1] = states_k[0].copy()
    single, together = (StepAccount(body, states, TIMES_S) for states in states_k)
    for n, length_s in enumerate(LENGTHS_S.tolist()):
        ends = n + 1 == len(LENGTHS_S) or INTERVALS[n + 1] > INTERVALS[n]
        step: Any = SimpleNamespace(
            group_heat_w=heat_w[n],
            iterations=ITERATIONS[n],
            newton_iterations=0,
            error_k=0.0,
            relative_k=states_k[0][INTERVALS[n] + 1].copy(),
        )
        single.add(Taken(step, length_s, ends))
    together.add_all(INTERVALS, LENGTHS_S, heat_w, ITERATIONS)
    assert (together.steps, together.followed_s) == (single.steps, single.followed_s) == (6, 7.5)
    assert together.success(None) == single.success(None) == "All 6 steps converged, in 11 iterations at most."
    one, other = (account.close("done", True, adaptive=False) for account in (single, together))
    assert one.iterations.tolist() == other.iterations.tolist() == [12, 11, 9]
    np.testing.assert_array_equal(one.temperature_c, other.temperature_c)
    for first, second in zip(one.effects, other.effects, strict=True):
        np.testing.assert_allclose(second.group_heat_w, first.group_heat_w, rtol=1e-14)
    assert other.energy_residual == one.energy_residual > 0.0
    np.testing.assert_allclose(other.energy_residual_of_spread, one.energy_residual_of_spread, rtol=1e-14)
