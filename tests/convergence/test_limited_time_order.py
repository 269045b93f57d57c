import re

import numpy as np
import pytest

from tests.support.obtuse_bodies import AT_THE_BOUNDS, CONCRETE, body
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import FixedTemperature

STEPS = (8, 16, 32)


@pytest.mark.parametrize(
    ("shape", "fourier"), [("torus", 0.003), ("slab at 30 degrees", 0.003), ("cylinder", 0.001), (AT_THE_BOUNDS, 0.012)]
)
def test_backward_euler_stays_first_order_where_the_limiter_acts(shape, fourier) -> None:
    """One half is warmed from 20 to 40 C, smoothly, and so soon that its heat has not come far into the other half.

    That is where the mesh resolves least; the limiter acts in half of the steps at least. Its own short steps are
    what they are compared with.
    """
    mesh = body(shape)
    duration_s = fourier * float(np.ptp(mesh.points_m[:, 0])) ** 2 / CONCRETE.diffusivity_m2_s
    warming = Varying(lambda _, time_s: 20.0 + 20.0 * np.sin(0.5 * np.pi * time_s / duration_s) ** 2)
    problem = HeatProblem(mesh, CONCRETE, effects=(FixedTemperature(("x0",), warming),))

    def end(steps: int) -> tuple[np.ndarray, float]:
        solution = solve_heat(problem, TimeSteps(steps, duration_s / steps))
        limited = re.search(r"In (\d+), obtuse angles", solution.status)
        return solution.temperature_c[-1], int(limited[1]) / steps if limited else 0.0

    exact, share = end(512)
    found = [end(steps) for steps in STEPS]
    errors = [float(np.abs(temperature_c - exact).max()) for temperature_c, _ in found]
    order = float(np.log2(errors[0] / errors[-1]) / np.log2(STEPS[-1] / STEPS[0]))
    assert min(share, *(part for _, part in found)) >= 0.5
    assert 0.9 < order < 1.2, f"order {order:.2f}, errors {errors}"
