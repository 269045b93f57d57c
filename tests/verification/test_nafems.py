"""NAFEMS benchmarks of heat transfer T2, T3 and T4 (The Standard NAFEMS Benchmarks, TNSB rev. 3, 1990)."""

from itertools import pairwise

import numpy as np
import pytest

from tests.support.heat_bodies import box_mesh, nafems_t3
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.runge_kutta import BACKWARD_EULER, SDIRK2, Scheme
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, FixedTemperature, Radiation
from thermoxels_ns.heat.materials import Material


@pytest.mark.parametrize(("conductivity", "exact_k"), [(55.6, 927.0076), (55.563, 926.9707)])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("parts", [1, 7])
def test_t2_radiation_at_the_end_of_a_rod(conductivity, exact_k, order, parts) -> None:
    """0.1 m, one end at 1000 K, the other radiates with emissivity 0.98 to 300 K: target 927.0 K at that end."""
    mesh = box_mesh(np.linspace(0, 0.1, parts + 1), [0, 0.01], [0, 0.01])
    effects = (FixedTemperature(("x0",), 1000.0 - 273.15), Radiation(("x1",), 0.98, 300.0 - 273.15, 5.67e-8))
    problem = HeatProblem(mesh, Material("rod", conductivity, 7850.0, 460.0), effects=effects)
    solution = solve_steady(problem, order=order)
    end_k = solution.temperature_c[mesh.points_m[:, 0] == 0.1] + 273.15
    np.testing.assert_allclose(end_k, exact_k, atol=1e-4)
    assert end_k[0] == pytest.approx(927.0, abs=0.05)


HALF_SECONDS = TimeSteps(64, 0.5)
T3_C = 36.60312
"""Exact temperature at x = 0.08 m after 32 s of T3, a rod with a swinging end; the printed target is 36.60."""


def t3_errors(parts: int, scheme: Scheme = BACKWARD_EULER, time: TimeSteps | AdaptiveSteps = HALF_SECONDS) -> float:
    problem = nafems_t3(parts)
    end = solve_heat(problem, time, scheme=scheme).temperature_c[-1, np.isclose(problem.mesh.points_m[:, 0], 0.08)]
    assert np.ptp(end) < 1e-9
    return float(end[0]) - T3_C


def test_t3_rod_with_a_swinging_end() -> None:
    """The error falls by four with each refinement and is within 0.1 K at 40 elements."""
    errors = [abs(t3_errors(parts, SDIRK2)) for parts in (10, 20, 40)]
    assert errors[2] < 0.1, errors
    assert 3.2 < errors[0] / errors[1] < 4.8 and 3.2 < errors[1] / errors[2] < 4.8, errors


def test_t3_with_backward_euler() -> None:
    """Its first-order error is a known number."""
    assert t3_errors(20, BACKWARD_EULER) == pytest.approx(36.18 - T3_C, abs=0.02)


def test_t3_with_a_tolerance() -> None:
    error, fine = t3_errors(40, time=AdaptiveSteps(32.0, 0.02, outputs=1)), t3_errors(40, SDIRK2, TimeSteps(320, 0.1))
    assert error == pytest.approx(fine, abs=0.02) and abs(error) < 0.1


@pytest.mark.parametrize(("order", "parts", "halved"), [(1, (10, 20, 40), 0.5), (2, (10, 20), 0.3)])
def test_t4_plate_with_convection(order, parts, halved) -> None:
    """0.6 x 1.0 m: 100 C below, insulated left, convection right and above; target 18.3 C at (0.6, 0.2)."""
    errors = []
    for n in parts:
        mesh = box_mesh(np.linspace(0, 0.6, 6 * n // 10 + 1), np.linspace(0, 1, n + 1), [0, 1 / n], temperature_c=50.0)
        effects = (FixedTemperature(("y0",), 100.0), Convection(("x1", "y1"), 750.0, 0.0))
        problem = HeatProblem(mesh, Material("plate", 52.0, 7850.0, 460.0), effects=effects)
        solution = solve_steady(problem, order=order)
        node = np.linalg.norm(mesh.points_m - [0.6, 0.2, 0.0], axis=1).argmin()
        errors.append(abs(float(solution.temperature_c[node]) - 18.25376))
        assert solution.energy_residual < 1e-9
    assert errors[-1] < 0.01 * 18.25376, errors
    # The corner (0.6, 0) is singular: the order stays below 2.
    assert all(fine < halved * coarse for coarse, fine in pairwise(errors)), errors
