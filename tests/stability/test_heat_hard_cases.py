import re
from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import assemble, box_mesh, make_body
from tests.support.stuffed_shapes import AT_THE_BOUNDS, BLOCKS, CONCRETE, STEP_S, H, body, faults, spots
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import SDIRK2, solve_heat
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, Radiation
from thermoxels_ns.heat.materials import Material

CARVED = np.random.default_rng(0).random((8, 8, 8)) < 0.7


@pytest.mark.parametrize("cells", [CARVED, np.ones((60, 1, 1), bool), np.ones((1, 1, 1), bool)])
@pytest.mark.parametrize(("voxel_m", "dt"), [(0.05, 1e14), (0.05, 1e300), (1e-10, 60.0), (1e-30, 60.0)])
def test_a_level_body_stays_level(cells, voxel_m: float, dt: float) -> None:
    """Once the differences are gone, K T is round-off and M / dt + K all but singular: nothing may move or fail."""
    solution = solve_heat(HeatProblem(make_body(cells, voxel_m, spots), CONCRETE), TimeSteps(10, dt))
    states = solution.temperature_c
    assert solution.energy_residual < 1e-14
    assert states.min() >= -30.0 - 1e-9 and states.max() <= 90.0 + 1e-9
    assert np.ptp(states[-1]) < 1e-10
    np.testing.assert_array_equal(states[-1], states[-2])


@pytest.mark.parametrize("flux_w_m2", [0.0, 100.0])
def test_a_disconnected_piece(flux_w_m2) -> None:
    mesh = box_mesh(np.arange(8) * H, [0, H, 2 * H], [0, H, 2 * H], keep=lambda p: np.abs(p[..., 0] - 3.5 * H) > H)
    right = mesh.points_m[:, 0] > 3.5 * H
    problem = HeatProblem(mesh, CONCRETE, effects=(FixedTemperature(("x0",), 50.0), HeatFlux(("x1",), flux_w_m2)))
    solution = solve_heat(problem, TimeSteps(3, 1e9))
    np.testing.assert_allclose(solution.temperature_c[-1, ~right], 50.0, atol=1e-9)
    volume = H**3 * 4 * 2
    warmer = flux_w_m2 * 4 * H * H * 3e9 / (volume * 2200.0 * 880.0)
    mass = assemble(mesh, CONCRETE)[1].diagonal()[right]
    assert mass @ solution.temperature_c[-1, right] / mass.sum() == pytest.approx(20.0 + warmer, rel=1e-9)
    assert solution.energy_residual < 1e-9
    with pytest.raises(HeatError, match=r"none on 1 of 2 pieces; the largest has 27 nodes"):
        solve_steady(problem)


@pytest.mark.parametrize("shape", [*BLOCKS, "sphere", "slab at 30 degrees", AT_THE_BOUNDS])
@pytest.mark.parametrize("fourier", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize(("strength", "sky"), [(0.0, False), (1e-9, False), (1e-9, True), (1e6, True)])
def test_range_and_balance_at_any_step_and_any_cooling(shape, fourier, strength, sky) -> None:
    effects: tuple[Effect, ...] = (Convection(("*",), strength, -40.0),) if strength else ()
    effects += (Radiation(("*",), 0.9, 100.0),) if sky else ()
    low, high = (-40.0 if strength else -30.0), (100.0 if sky else 90.0)
    problem = HeatProblem(body(shape, spots), CONCRETE, effects=effects)
    assert faults(solve_heat(problem, TimeSteps(3, fourier * STEP_S)), low, high, shape) == []


@pytest.mark.parametrize("shape", [*BLOCKS, "slab at 30 degrees", AT_THE_BOUNDS])
@pytest.mark.parametrize("contrast", [1e-6, 1e6])
def test_two_materials_in_turns(shape, contrast) -> None:
    """Neighbouring voxels conduct a million times better or worse."""
    materials = {"even": CONCRETE, "odd": replace(CONCRETE, conductivity_w_mk=1.7 * contrast)}
    effects = (Convection(("*",), 10.0, -10.0), Radiation(("*",), 0.9, 30.0))
    problem = HeatProblem(body(shape, 20.0, regions=True), materials, effects=effects)
    for fourier in (1e-3, 1.0, 1e6):
        assert faults(solve_heat(problem, TimeSteps(3, fourier * STEP_S)), -10.0, 30.0, shape) == []
    steady = solve_steady(problem)
    assert steady.energy_residual < 1e-9
    assert steady.temperature_c.min() >= -10.0 - 1e-2 and steady.temperature_c.max() <= 30.0 + 1e-2


@pytest.mark.parametrize("shape", [*BLOCKS, "sphere", AT_THE_BOUNDS])
@pytest.mark.parametrize(
    ("start_c", "sky_c"), [(726.85, -270.15), (-270.15, 726.85), (-273.15, -270.15), (-273.15, 20.0)]
)
def test_radiation_between_1000_k_and_3_k(shape, start_c, sky_c) -> None:
    problem = HeatProblem(body(shape, start_c, size=4), CONCRETE, effects=(Radiation(("*",), 1.0, sky_c),))
    low, high = sorted((start_c, sky_c))
    for fourier in (1e-3, 10.0, 1e6):
        try:
            solution = solve_heat(problem, TimeSteps(3, fourier * STEP_S))
        except HeatError as refusal:
            # Beside obtuse angles a temperature may fall below absolute zero.
            assert shape not in BLOCKS[:2] and "below absolute zero" in str(refusal)
            continue
        assert faults(solution, low, high, shape) == []
    np.testing.assert_allclose(solve_steady(problem).temperature_c, sky_c, atol=1e-4)


@pytest.mark.parametrize("shape", [*BLOCKS, "slab at 30 degrees", AT_THE_BOUNDS])
def test_adaptive_steps_through_a_shock(shape) -> None:
    effects = (Convection(("*",), 1e4, -50.0), Radiation(("*",), 0.9, -80.0))
    problem = HeatProblem(body(shape, 200.0), CONCRETE, effects=effects)
    time = AdaptiveSteps(3600.0, 0.1, outputs=4) if shape in BLOCKS else AdaptiveSteps(1800.0, 0.5, outputs=2)
    assert faults(solve_heat(problem, time), -80.0, 200.0, shape) == []


@pytest.mark.parametrize("options", [{}, {"scheme": SDIRK2}])
def test_steps_say_when_a_temperature_leaves_its_range(options) -> None:
    """A body at 20 C that is held at 100 C on one side from now on, followed by steps too short for the mesh."""
    jump = HeatProblem(body("sphere"), CONCRETE, effects=(FixedTemperature(("x1",), 100.0),))
    solution = solve_heat(jump, TimeSteps(2, 1e-2 * STEP_S), **options)
    beyond_k = 20.0 - float(solution.temperature_c.min())
    said = re.search(r"A temperature left its range by up to ([\d.]+) K", solution.status)
    assert beyond_k > 0.01 and said and float(said[1]) >= 0.94 * beyond_k
    # Long steps are smooth.
    assert options or "left" not in solve_heat(jump, TimeSteps(4, 20.0 * STEP_S)).status


@pytest.mark.parametrize("material", [CONCRETE, Material("aluminium", 200.0, 2700.0, 900.0)], ids=lambda m: m.name)
@pytest.mark.parametrize("step_s", [600.0, 3600.0, 86400.0])
def test_round_off_near_equilibrium_is_no_temperature_out_of_range(material, step_s) -> None:
    """The range of a step shrinks to nothing as the body comes to the temperature of the air; round-off does not."""
    mesh = box_mesh(*(np.linspace(0.0, 0.2, count) for count in (11, 6, 6)), temperature_c=60.0)
    problem = HeatProblem(mesh, material, effects=(Convection(("*",), 500.0, -10.0),))
    status = solve_heat(problem, TimeSteps(24, step_s)).status
    assert "range" not in status, status


LOW, HIGH = -30.0, 90.0
STRONG = Convection(("x1",), 1e5, LOW)


def problem(shape: str, contrast: float, *effects: Effect) -> HeatProblem:
    other = replace(CONCRETE, conductivity_w_mk=contrast * CONCRETE.conductivity_w_mk)
    return HeatProblem(body(shape, regions=True), {"even": CONCRETE, "odd": other}, effects=effects)


@pytest.mark.parametrize(("contrast", "options"), [(1e-4, {}), (1.0, {"order": 2})])
def test_what_leaves_the_range_says_by_how_much(contrast, options) -> None:
    solution = solve_steady(problem("torus", contrast, FixedTemperature(("x0",), HIGH), STRONG), **options)
    everywhere = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    beyond = np.maximum(LOW - everywhere, everywhere - HIGH)
    assert beyond.max() > 1.0
    assert f"left its range by up to {beyond.max():.2g} K" in solution.status and solution.energy_residual < 1e-9
    mild = solve_steady(problem("torus", 1.0, Convection(("*",), 8.0, 20.0), HeatFlux(("x0",), 10.0)), **options)
    assert "range" not in mild.status


def test_effects_of_one_name_are_numbered_whatever_others_are_called() -> None:
    flux, odd = HeatFlux(("x0",), 1.0), HeatFlux(("x0 (2)",), 1.0)
    labels = effect_labels(problem("regular", 1.0, flux, odd, flux, odd, flux, flux))
    numbers = ("", " (2)", " (3)", " (2) (2)", " (4)", " (5)")
    assert labels == tuple(f"heat flux on x0{number}" for number in numbers)
