from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_matrices import assemble
from tests.support.heat_meshes import box_mesh
from tests.support.obtuse_bodies import STEP_S, H, body, faults, spots
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh


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
    assert faults(solve_heat(HeatProblem(mesh, CONCRETE, effects=(effect,)), TimeSteps(10, 60.0)), -30.0, 90.0) == []


def flat_tets(degrees: float) -> TetMesh:
    """A block whose layers lean so that its smallest dihedral angle is near the given one."""
    mesh = body("regular", spots, size=4)
    lean = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0 / np.tan(np.radians(degrees)), 0.0, 1.0]])
    return replace(mesh, points_m=mesh.points_m @ lean)


@pytest.mark.parametrize("degrees", [45.0, 20.0, 11.0])
def test_meshes_at_the_angle_bounds(degrees) -> None:
    mesh = flat_tets(degrees)
    effects = (Convection(("*",), 10.0, 20.0), Radiation(("*",), 0.9, 0.0))
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    for fourier in (1e-3, 1.0, 1e6):
        assert faults(solve_heat(problem, TimeSteps(4, fourier * STEP_S)), -60.0, 120.0) == []
    end = solve_steady(problem)
    assert end.energy_residual < 1e-9
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
