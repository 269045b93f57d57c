import numpy as np

from tests.support.heat_bodies import CONCRETE, make_body
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.time_loop import solve_heat

LENGTH = 0.8
RATE = 3.0 * CONCRETE.diffusivity_m2_s * (np.pi / LENGTH) ** 2
"""Decay rate of the mode below in an insulated cube, [1 / s]."""


def cosines(points: np.ndarray) -> np.ndarray:
    return 20.0 + 10.0 * np.cos(np.pi * points / LENGTH).prod(axis=1)


def observed_orders(errors: list[float]) -> np.ndarray:
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


def test_second_order_in_space() -> None:
    """Against backward Euler's own decay of the continuous mode, so that only the space error is left."""
    dt, steps, errors = 0.2 / RATE, 5, []
    for n in (4, 8, 16):
        mesh = make_body(np.ones((n, n, n), bool), LENGTH / n, cosines)
        end = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(steps, dt)).temperature_c[-1]
        exact = 20.0 + (mesh.temperature_c - 20.0) / (1.0 + dt * RATE) ** steps
        errors.append(float(np.sqrt(np.mean((end - exact) ** 2))))
    orders = observed_orders(errors)
    assert orders[-1] > 1.85, f"observed orders in h: {orders}, errors {errors}"
