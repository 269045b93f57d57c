"""Steady states that leave the range of what surrounds the body beside jumps say so."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import SIDES, box_mesh
from tests.support.obtuse_bodies import CONCRETE, body
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.steady import OVERSHOOT_K, solve_steady
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux

LOW, HIGH = -30.0, 90.0
STRONG = Convection(("x1",), 1e5, LOW)
HOT_SPOTS = Varying(
    lambda places, _: np.where(np.sin(places.points_m @ np.array([93.0, 171.0, 249.0])) > 0.6, HIGH, LOW),
    in_time=False,
)
"""Hot spots that the mesh does not resolve."""


def problem(shape: str, contrast: float, *effects: Effect) -> HeatProblem:
    other = replace(CONCRETE, conductivity_w_mk=contrast * CONCRETE.conductivity_w_mk)
    return HeatProblem(body(shape, regions=True), {"even": CONCRETE, "odd": other}, effects=effects)


@pytest.mark.parametrize(("contrast", "options"), [(1e-4, {}), (1.0, {"order": 2})])
def test_what_leaves_the_range_says_by_how_much(contrast, options) -> None:
    solution = solve_steady(problem("torus", contrast, FixedTemperature(("x0",), HIGH), STRONG), **options)
    everywhere = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    beyond = np.maximum(LOW - everywhere, everywhere - HIGH)
    assert beyond.max() > 1.0
    count = np.count_nonzero(beyond > OVERSHOOT_K)
    said = f"The temperature of {count} of {len(everywhere)} nodes is up to {beyond.max():.2g} K out of the range"
    assert said in solution.status and solution.energy_residual < 1e-9
    mild = solve_steady(problem("torus", 1.0, Convection(("*",), 8.0, 20.0), HeatFlux(("x0",), 10.0)), **options)
    assert "range" not in mild.status


def test_meshes_without_obtuse_angles_keep_the_range() -> None:
    axis = np.linspace(0.0, 0.7, 8)
    mesh = box_mesh(axis, axis, axis)
    for tolerance in (1e-6, 1e-8, 1e-12):
        for effects in ((FixedTemperature(SIDES, HOT_SPOTS),), (FixedTemperature(("x0",), HIGH), STRONG)):
            solution = solve_steady(HeatProblem(mesh, CONCRETE, effects=effects), relative_tolerance=tolerance)
            assert "range" not in solution.status
            assert solution.temperature_c.min() >= LOW - 2e-4 and solution.temperature_c.max() <= HIGH + 2e-4
