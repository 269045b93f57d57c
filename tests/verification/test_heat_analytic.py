import math

import numpy as np
import pytest
from scipy.linalg import eigh

from tests.support.heat_bodies import CONCRETE, make_body
from tests.support.heat_matrices import assemble
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.time_loop import solve_heat


def test_step_between_two_half_spaces() -> None:
    """Two insulated half bars at 0 and 1 degree: T = erfc(x / (2 sqrt(a t))) / 2 on the cold side.

    erfc(0.05 m, 3600 s) = 0.5294616, erfc(0.10 m, 3600 s) = 0.2085161 for a = 1.7 / (2200 * 880).
    """
    middle = 0.6
    mesh = make_body(np.ones((120, 1, 1), bool), 0.01, lambda p: 0.5 - 0.5 * np.sign(np.round(p[:, 0] - middle, 9)))
    end = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(720, 5.0)).temperature_c[-1]
    for distance, expected in ((0.05, 0.5294616), (0.10, 0.2085161)):
        assert math.erfc(distance / (2 * math.sqrt(CONCRETE.diffusivity_m2_s * 3600))) == pytest.approx(
            expected, abs=1e-7
        )
        nodes = np.isclose(mesh.points_m[:, 0], middle + distance)
        np.testing.assert_allclose(end[nodes], 0.5 * expected, atol=1e-3)


def test_each_mode_decays_exactly_as_backward_euler_says() -> None:
    """An eigenvector of (K, M) shrinks by 1 / (1 + dt lambda) per step and keeps its shape."""
    rng = np.random.default_rng(4)
    mesh = make_body(rng.random((4, 4, 4)) < 0.8, 0.05)
    matrices = assemble(mesh, CONCRETE)
    values, vectors = eigh(matrices.stiffness_w_k.toarray(), matrices.mass_j_k.toarray())
    for number in (len(values) // 4, len(values) - 1):
        mode = vectors[:, number] / np.abs(vectors[:, number]).max()
        dt = 0.7 / values[number]
        states = solve_heat(HeatProblem(mesh, CONCRETE, 20.0 + 10.0 * mode), TimeSteps(5, dt)).temperature_c
        expected = 20.0 + 10.0 * mode * (1.0 / 1.7) ** np.arange(6)[:, None]
        np.testing.assert_allclose(states, expected, atol=1e-9)
