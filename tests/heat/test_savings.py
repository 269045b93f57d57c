"""What leaving effects out saves, from the time of one step of either problem."""

from __future__ import annotations

import pytest

from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.effects import Convection, Radiation
from thermoxels_ns.fem.materials import Material
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.heat import savings

CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)


def problems() -> tuple[HeatProblem, HeatProblem]:
    mesh, air = box_mesh([0.0, 0.1], [0.0, 0.1], [0.0, 0.1]), Convection(("x0",), 8.0, 0.0)
    return HeatProblem(mesh, CONCRETE, effects=(air, Radiation(("x1",), 0.9, 0.0))), HeatProblem(mesh, CONCRETE)


@pytest.mark.parametrize(
    ("seconds", "saved"), [([(1.0, 0.5), (0.4, 0.1)], 0.6 + 10 * 0.4), ([(1.0, 0.1), (1.0, 0.2)], 0)]
)
def test_set_up_and_every_step_count(monkeypatch, seconds, saved) -> None:
    taken = iter(seconds)
    monkeypatch.setattr(savings, "_seconds", lambda *_: next(taken))
    assert savings.seconds_saved(*problems(), TimeSteps(10, 60.0), 10) == pytest.approx(saved)


@pytest.mark.parametrize("time", [TimeSteps(4, 60.0), AdaptiveSteps(600.0)])
def test_steps_of_both_kinds_are_taken(monkeypatch, time) -> None:
    lengths = []
    step = savings.Stepper.step

    def record(self, start_k, time_s, step_s, **keys):
        lengths.append((step_s, keys["estimate"]))
        return step(self, start_k, time_s, step_s, **keys)

    monkeypatch.setattr(savings.Stepper, "step", record)
    assert savings.seconds_saved(*problems(), time, 4) >= 0.0
    assert lengths == [(time.times_s[-1] / 4, isinstance(time, AdaptiveSteps))] * 4
