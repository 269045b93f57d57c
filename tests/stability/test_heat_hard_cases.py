import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, make_body
from tests.support.heat_matrices import assemble
from tests.support.heat_meshes import box_mesh
from tests.support.obtuse_bodies import H, body
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, InternalHeat
from thermoxels_ns.heat.materials import Material


def carved(seed: int = 0, size: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).random((size, size, size)) < 0.7


def spots(points: np.ndarray) -> np.ndarray:
    """Single hot and cold nodes in an even body: the roughest field there is."""
    rng = np.random.default_rng(1)
    return rng.choice([-30.0, 20.0, 20.0, 20.0, 90.0], len(points))


@pytest.mark.parametrize("conductivity", [1e-9, 0.024, 400.0, 1e9])
def test_conductivity_extremes(conductivity: float) -> None:
    material = Material("extreme", conductivity, 2200.0, 880.0)
    mesh = make_body(np.ones((6, 6, 6), bool), 0.05, spots)
    solution = solve_heat(HeatProblem(mesh, material), TimeSteps(10, 60.0))
    assert solution.energy_residual < 1e-12
    left = np.ptp(solution.temperature_c[-1])
    if conductivity == 1e-9:
        assert left == pytest.approx(120.0, rel=1e-6)
    if conductivity == 1e9:
        assert left < 1e-6


@pytest.mark.parametrize("voxel_m", [1e-6, 1e-3, 1e3])
def test_similar_bodies_have_the_same_solution(voxel_m: float) -> None:
    states = []
    for h in (0.1, voxel_m):
        mesh = make_body(carved(2, 5), h, spots)
        dt = 0.3 * h**2 / CONCRETE.diffusivity_m2_s
        states.append(solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(4, dt)).temperature_c)
    np.testing.assert_allclose(states[0], states[1], atol=1e-8)


@pytest.mark.parametrize("touching", ["edge", "corner"])
def test_voxels_that_touch_by_an_edge_or_a_corner(touching: str) -> None:
    cells = np.zeros((2, 2, 2), bool)
    cells[0, 0, 0] = True
    cells[(1, 1, 0) if touching == "edge" else (1, 1, 1)] = True
    mesh = make_body(cells, 0.05, lambda points: np.where(points.sum(axis=1) > 0.11, 60.0, 20.0))
    solution = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(2, 1e9))
    assert solution.energy_residual < 1e-14
    assert np.ptp(solution.temperature_c[-1]) < 1e-4


def test_differences_of_a_nanokelvin_survive() -> None:
    """Temperatures relative to a reference: at 300 K a difference of 1e-9 K is still followed."""
    mesh = make_body(np.ones((6, 2, 2), bool), 0.05, lambda points: 26.85 + 1e-9 * (points[:, 0] > 0.14))
    solution = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(10, 600.0))
    assert solution.energy_residual_of_spread < 1e-9
    assert 1e-11 < np.ptp(solution.temperature_c[-1]) < 0.9e-9


@pytest.mark.parametrize("shape", ["cube", "carved", "bar", "voxel"])
@pytest.mark.parametrize(("voxel_m", "dt"), [(0.05, 1e14), (0.05, 1e20), (0.05, 1e300), (1e-10, 60.0), (1e-30, 60.0)])
def test_a_level_body_stays_level(shape: str, voxel_m: float, dt: float) -> None:
    """Once the differences are gone, K T is round-off and M / dt + K all but singular: nothing may move or fail."""
    sides = {"cube": (6, 6, 6), "bar": (60, 1, 1), "voxel": (1, 1, 1)}
    cells = carved() if shape == "carved" else np.ones(sides[shape], bool)
    solution = solve_heat(HeatProblem(make_body(cells, voxel_m, spots), CONCRETE), TimeSteps(10, dt))
    states = solution.temperature_c
    assert solution.energy_residual < 1e-14
    assert states.min() >= -30.0 - 1e-9 and states.max() <= 90.0 + 1e-9
    assert np.ptp(states[-1]) < 1e-10
    np.testing.assert_array_equal(states[-1], states[-2])


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
