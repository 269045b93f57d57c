"""Hard cases of the heat solver with effects, each on a regular and on a carved body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_matrices import assemble
from tests.support.heat_meshes import box_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh

CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)
H = 0.05
STEP_S = H**2 / CONCRETE.diffusivity_m2_s

SHAPES = ("regular", "carved", "shaken")


def body(shape: str, temperature_c=20.0, size: int = 6) -> TetMesh:
    """A block; one with a third of its voxels taken out; one with its nodes moved, so that angles are obtuse."""
    keep = None
    if shape == "carved":
        keep = lambda p: np.random.default_rng(5).random(p.shape[:3]) < 0.65  # noqa: E731
    regions = {"even": lambda p: p[..., 0] > -1.0, "odd": lambda p: np.floor(p / H).sum(axis=-1) % 2 == 1}
    mesh = box_mesh(*[np.arange(size + 1) * H] * 3, regions=regions, keep=keep, temperature_c=temperature_c)
    if shape == "shaken":
        mesh = replace(
            mesh, points_m=mesh.points_m + np.random.default_rng(6).uniform(-0.1 * H, 0.1 * H, mesh.points_m.shape)
        )
    return mesh


def spots(points: np.ndarray) -> np.ndarray:
    return np.random.default_rng(1).choice([-30.0, 20.0, 90.0], len(points))


def range_of(problem: HeatProblem, time, **options) -> tuple[float, float]:
    solution = solve_heat(problem, time, **options)
    assert solution.converged and np.isfinite(solution.temperature_c).all()
    assert solution.energy_residual < 1e-9 and solution.energy_residual_of_spread < 1e-9, solution.status
    return solution.temperature_c.min(), solution.temperature_c.max()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("fourier", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("strength", [1e-9, 1e6])
def test_range_and_balance_at_any_step_and_any_cooling(shape, fourier, strength) -> None:
    effects = (Convection(("*",), strength, -40.0), Radiation(("*",), 0.9, 100.0))
    low, high = range_of(HeatProblem(body(shape, spots), CONCRETE, effects=effects), TimeSteps(4, fourier * STEP_S))
    # Obtuse angles make a positive coupling here and there: a small excess at most.
    slack = 1e-9 if shape != "shaken" else 0.5
    assert low >= -40.0 - slack and high <= 100.0 + slack


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("contrast", [1e-6, 1e6])
def test_checkerboard_of_two_materials(shape, contrast) -> None:
    """Neighbouring voxels conduct a million times better or worse."""
    materials = {"even": CONCRETE, "odd": replace(CONCRETE, conductivity_w_mk=1.7 * contrast)}
    effects = (Convection(("*",), 10.0, -10.0), Radiation(("*",), 0.9, 30.0))
    problem = HeatProblem(body(shape), materials, effects=effects)
    for fourier in (1e-3, 1.0, 1e6):
        low, high = range_of(problem, TimeSteps(3, fourier * STEP_S))
        assert low >= -10.0 - 1e-2 and high <= 30.0 + 1e-2
    steady = solve_steady(problem)
    assert steady.energy_residual < 1e-9
    assert steady.temperature_c.min() >= -10.0 - 1e-2 and steady.temperature_c.max() <= 30.0 + 1e-2


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("start_c", "sky_c"), [(726.85, -270.15), (-270.15, 726.85), (-273.15, -270.15), (-273.15, 20.0)]
)
def test_radiation_between_1000_k_and_3_k(shape, start_c, sky_c) -> None:
    effects: tuple[Effect, ...] = (Radiation(("*",), 1.0, sky_c),)
    problem = HeatProblem(body(shape, start_c, size=4), CONCRETE, effects=effects)
    slack = 1e-9 if shape != "shaken" else 1.0
    for time in (TimeSteps(3, 1e-3 * STEP_S), TimeSteps(3, 10.0 * STEP_S), TimeSteps(3, 1e6 * STEP_S)):
        low, high = range_of(problem, time)
        assert low >= min(start_c, sky_c) - slack and high <= max(start_c, sky_c) + slack
    np.testing.assert_allclose(solve_steady(problem).temperature_c, sky_c, atol=1e-4)


@pytest.mark.parametrize("shape", SHAPES)
def test_adaptive_steps_through_a_shock(shape) -> None:
    effects = (Convection(("*",), 1e4, -50.0), Radiation(("*",), 0.9, -80.0))
    low, high = range_of(
        HeatProblem(body(shape, 200.0), CONCRETE, effects=effects), AdaptiveSteps(3600.0, 0.1, outputs=4)
    )
    slack = 1e-6 if shape != "shaken" else 0.5
    assert low >= -80.0 - slack and high <= 200.0 + slack


@pytest.mark.parametrize("shape", SHAPES)
def test_no_heat_capacity_to_speak_of(shape) -> None:
    empty = Material("nearly nothing", 1.7, 1e-9, 1e-6)
    effects = (Convection(("*",), 10.0, -10.0), Radiation(("*",), 0.9, 30.0))
    problem = HeatProblem(body(shape), empty, effects=effects)
    end = solve_heat(problem, TimeSteps(1, 1.0)).temperature_c[-1]
    np.testing.assert_allclose(end, solve_steady(problem).temperature_c, atol=1e-6)


@pytest.mark.parametrize("temperature_c", [-273.15, -273.1499])
def test_near_absolute_zero(temperature_c) -> None:
    problem = HeatProblem(body("regular", temperature_c, size=3), CONCRETE, effects=(Radiation(("*",), 1.0, -273.15),))
    low, high = range_of(problem, TimeSteps(3, STEP_S))
    assert low >= -273.15 and high <= temperature_c + 1e-12


def test_next_to_no_exchange_keeps_the_mean_exact() -> None:
    """h = 1e-12 on a good conductor over long steps: the matrix all but loses what holds the mean."""
    copper = Material("copper", 380.0, 8900.0, 380.0)
    mesh = body("carved", spots, size=5)
    capacity = 8900.0 * 380.0 * H**3 * len(mesh.tets) / 6
    corner = mesh.points_m[mesh.facets]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    problem = HeatProblem(mesh, copper, effects=(Convection(("*",), 1e-12, 0.0),))
    step = 0.5 * capacity / (1e-12 * area)
    solution = solve_heat(problem, TimeSteps(3, step))
    mass = assemble(mesh, copper).nodal_mass_j_k
    # A body of several pieces: each follows its own rate, and all of them are level.
    content = solution.temperature_c @ mass
    assert np.all(np.diff(np.abs(content)) < 0.0)
    assert solution.energy_residual_of_spread < 1e-12
    steady = solve_steady(problem)
    np.testing.assert_allclose(steady.temperature_c, 0.0, atol=1e-6)


@pytest.mark.parametrize("loose", ["insulated", "heated"])
def test_a_disconnected_piece(loose) -> None:
    """Two blocks, one held and one not: fine in time, each with its own heat, and a clear error when steady."""
    mesh = box_mesh(np.arange(8) * H, [0, H, 2 * H], [0, H, 2 * H], keep=lambda p: np.abs(p[..., 0] - 3.5 * H) > H)
    right = mesh.points_m[:, 0] > 3.5 * H
    effects: tuple[Effect, ...] = (FixedTemperature(("x0",), 50.0),)
    if loose == "heated":
        effects = (*effects, HeatFlux(("x1",), 100.0))
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    solution = solve_heat(problem, TimeSteps(3, 1e9))
    np.testing.assert_allclose(solution.temperature_c[-1, ~right], 50.0, atol=1e-9)
    volume = H**3 * 4 * 2
    warmer = 0.0 if loose == "insulated" else 100.0 * 4 * H * H * 3e9 / (volume * 2200.0 * 880.0)
    mass = assemble(mesh, CONCRETE).nodal_mass_j_k[right]
    assert mass @ solution.temperature_c[-1, right] / mass.sum() == pytest.approx(20.0 + warmer, rel=1e-9)
    assert solution.energy_residual < 1e-9
    with pytest.raises(HeatError, match=r"none on 1 of 2 pieces; the largest has 27 nodes"):
        solve_steady(problem)


@pytest.mark.parametrize("effect", [Convection(("*",), 8.0, -5.0), Radiation(("*",), 0.9, -5.0)])
def test_a_wall_one_element_thick(effect) -> None:
    mesh = box_mesh(np.arange(13) * H, np.arange(13) * H, [0, H], temperature_c=spots)
    low, high = range_of(HeatProblem(mesh, CONCRETE, effects=(effect,)), TimeSteps(10, 60.0))
    assert low >= -30.0 - 1e-9 and high <= 90.0 + 1e-9


def flat_tets(degrees: float) -> TetMesh:
    """A block whose layers lean so that its smallest dihedral angle is near the given one."""
    mesh = body("regular", spots, size=4)
    lean = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0 / np.tan(np.radians(degrees)), 0.0, 1.0]])
    return replace(mesh, points_m=mesh.points_m @ lean)


@pytest.mark.parametrize("degrees", [45.0, 20.0, 11.0])
def test_meshes_at_the_angle_bounds(degrees) -> None:
    """Tetrahedra as flat as a conforming mesh may have them: solved, finite, balanced, close to their range."""
    mesh = flat_tets(degrees)
    effects = (Convection(("*",), 10.0, 20.0), Radiation(("*",), 0.9, 0.0))
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    for fourier in (1e-3, 1.0, 1e6):
        low, high = range_of(problem, TimeSteps(4, fourier * STEP_S))
        assert low > -60.0 and high < 120.0
    end = solve_steady(problem)
    assert end.converged and end.energy_residual < 1e-9
    assert end.temperature_c.min() > 0.0 and end.temperature_c.max() < 20.0


def test_an_even_source_leaves_no_round_off_for_the_linear_solver() -> None:
    """A strong source moves each piece as a whole; its round-off is not what the iterations are spent on."""
    mesh = body("regular", lambda points: 20.0 + 1e-9 * spots(points), size=8)
    quiet, loud = (
        solve_heat(HeatProblem(mesh, CONCRETE, effects=(InternalHeat(("*",), watts),)), TimeSteps(1, 1e12))
        for watts in (1e-3, 1e8)
    )
    assert loud.iterations[0] <= quiet.iterations[0] + 10, (loud.iterations, quiet.iterations)
    warmer = 1e8 * 1e12 / (2200.0 * 880.0)
    np.testing.assert_allclose(loud.temperature_c[-1], 20.0 + warmer, rtol=1e-12)
