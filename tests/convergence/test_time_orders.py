from functools import cache

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, make_body
from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.runge_kutta import BACKWARD_EULER, SDIRK2, Scheme
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, InternalHeat, Radiation

DURATION_S = 4 * 3600.0


def swing(middle: float, size: float) -> Varying:
    return Varying(lambda places, time_s: middle + size * np.sin(2.0 * np.pi * time_s / DURATION_S))


EFFECTS: dict[str, tuple[Effect, ...]] = {
    "air and sun": (Convection(("x0",), 20.0, swing(10.0, 8.0)), HeatFlux(("x1",), swing(100.0, 80.0))),
    "wind": (Convection(("x0",), swing(10.0, 6.0), 5.0), Convection(("x1",), 8.0, 20.0)),
    "sky": (Radiation(("x0",), 0.9, swing(-20.0, 10.0)), Convection(("x1",), 8.0, 20.0)),
    "swinging end": (FixedTemperature(("x0",), swing(20.0, 15.0)), InternalHeat(("*",), swing(50.0, 40.0))),
}


def problem(name: str) -> HeatProblem:
    mesh = box_mesh(
        np.linspace(0, 0.2, 9), [0, 0.02], [0, 0.02], temperature_c=lambda p: 20.0 + 5.0 * np.cos(15 * p[:, 0])
    )
    if name == "swinging end":
        mesh = box_mesh(np.linspace(0, 0.2, 9), [0, 0.02], [0, 0.02])
    return HeatProblem(mesh, CONCRETE, effects=EFFECTS[name])


def end(name: str, scheme: Scheme, steps: int) -> np.ndarray:
    time = TimeSteps(steps, DURATION_S / steps)
    return solve_heat(problem(name), time, scheme=scheme).temperature_c[-1]


@cache
def reference(name: str) -> np.ndarray:
    """Short steps on the same mesh and Richardson's extrapolation, so that only the time error is left."""
    return (4.0 * end(name, SDIRK2, 320) - end(name, SDIRK2, 160)) / 3.0


def observed(name: str, scheme: Scheme) -> tuple[float, list[float]]:
    errors = [float(np.abs(end(name, scheme, steps) - reference(name)).max()) for steps in (20, 40, 80)]
    return float(np.log2(errors[1] / errors[2])), errors


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize(("scheme", "order"), [(BACKWARD_EULER, 1), (SDIRK2, 2)])
def test_orders_in_time(name, scheme, order) -> None:
    found, errors = observed(name, scheme)
    assert abs(found - order) < 0.15, f"observed order {found}, errors {errors}"
    assert errors[0] > errors[1] > errors[2]


def test_adaptive_steps_pay_the_third_root_of_the_tolerance() -> None:
    """The estimate is of third order: a thousandth of the tolerance takes about ten times the steps."""
    steps = [
        solve_heat(problem("wind"), AdaptiveSteps(DURATION_S, tolerance, outputs=1)).steps for tolerance in (1.0, 1e-3)
    ]
    assert 5.0 < steps[1] / steps[0] < 15.0, steps


def test_second_order_in_space() -> None:
    """Against backward Euler's own decay of the continuous mode, so that only the space error is left."""
    length = 0.8
    rate = 3.0 * CONCRETE.diffusivity_m2_s * (np.pi / length) ** 2  # of the mode below in an insulated cube, [1 / s]
    dt, steps, errors = 0.2 / rate, 5, []
    for n in (4, 8, 16):
        cosines = lambda points: 20.0 + 10.0 * np.cos(np.pi * points / length).prod(axis=1)  # noqa: E731
        mesh = make_body(np.ones((n, n, n), bool), length / n, cosines)
        end = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(steps, dt)).temperature_c[-1]
        exact = 20.0 + (mesh.temperature_c - 20.0) / (1.0 + dt * rate) ** steps
        errors.append(float(np.sqrt(np.mean((end - exact) ** 2))))
    assert np.log2(errors[1] / errors[2]) > 1.85, errors
