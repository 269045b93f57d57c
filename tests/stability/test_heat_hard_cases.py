import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, make_body
from tests.support.heat_matrices import assemble
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.materials import Material


def carved(seed: int = 0, size: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).random((size, size, size)) < 0.7


def spots(points: np.ndarray) -> np.ndarray:
    """Single hot and cold nodes in an even body: the roughest field there is."""
    rng = np.random.default_rng(1)
    return rng.choice([-30.0, 20.0, 20.0, 20.0, 90.0], len(points))


@pytest.mark.parametrize("fourier", [1e-3, 1e-2, 1 / 6, 1.0, 1e2, 1e4, 1e6])
def test_maximum_principle_at_any_step_length(fourier: float) -> None:
    """Lumped mass and non-obtuse tetrahedra: no temperature leaves its range; dt = fourier h^2 / diffusivity."""
    mesh = make_body(carved(), 0.05, spots)
    dt = fourier * 0.05**2 / CONCRETE.diffusivity_m2_s
    states = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(5, dt)).temperature_c
    assert states.min() >= -30.0 - 1e-9
    assert states.max() <= 90.0 + 1e-9
    # Each step keeps the range of the one before it, too.
    assert np.all(np.diff(states.min(axis=1)) >= -1e-9) and np.all(np.diff(states.max(axis=1)) <= 1e-9)


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


def test_separate_pieces_keep_their_own_heat() -> None:
    cells = np.zeros((9, 3, 3), bool)
    cells[:4] = cells[6:] = True
    mesh = make_body(cells, 0.05, lambda points: np.where(points[:, 0] < 0.25, 10.0, 1000.0) + spots(points))
    left = mesh.points_m[:, 0] < 0.25
    mass = assemble(mesh, CONCRETE).nodal_mass_j_k
    states = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(3, 1e9)).temperature_c
    for piece in (left, ~left):
        content = (states[:, piece] + 273.15) @ mass[piece]
        assert np.abs(content / content[0] - 1.0).max() < 1e-12
        np.testing.assert_allclose(states[-1, piece], mass[piece] @ states[0, piece] / mass[piece].sum(), atol=1e-4)


@pytest.mark.parametrize("touching", ["edge", "corner"])
def test_voxels_that_touch_by_an_edge_or_a_corner(touching: str) -> None:
    cells = np.zeros((2, 2, 2), bool)
    cells[0, 0, 0] = True
    cells[(1, 1, 0) if touching == "edge" else (1, 1, 1)] = True
    mesh = make_body(cells, 0.05, lambda points: np.where(points.sum(axis=1) > 0.11, 60.0, 20.0))
    solution = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(2, 1e9))
    assert solution.energy_residual < 1e-14
    assert np.ptp(solution.temperature_c[-1]) < 1e-4


@pytest.mark.parametrize("shape", [(12, 12, 1), (1, 1, 1)])
def test_walls_and_bodies_of_one_voxel(shape) -> None:
    cells = np.ones(shape, bool)
    solution = solve_heat(HeatProblem(make_body(cells, 0.02, spots), CONCRETE), TimeSteps(10, 60.0))
    assert solution.energy_residual < 1e-14
    assert solution.temperature_c.min() >= -30.0 and solution.temperature_c.max() <= 90.0


def test_differences_of_a_nanokelvin_survive() -> None:
    """Temperatures relative to a reference: at 300 K a difference of 1e-9 K is still followed."""
    mesh = make_body(np.ones((6, 2, 2), bool), 0.05, lambda points: 26.85 + 1e-9 * (points[:, 0] > 0.14))
    solution = solve_heat(HeatProblem(mesh, CONCRETE), TimeSteps(10, 600.0))
    assert solution.energy_residual_of_spread < 1e-9
    assert 1e-11 < np.ptp(solution.temperature_c[-1]) < 0.9e-9


@pytest.mark.parametrize("shape", ["cube", "carved", "bar"])
@pytest.mark.parametrize(("voxel_m", "dt"), [(0.05, 1e14), (0.05, 1e20), (0.05, 1e300), (1e-10, 60.0), (1e-30, 60.0)])
def test_a_level_body_stays_level(shape: str, voxel_m: float, dt: float) -> None:
    """Once the differences are gone, K T is round-off and M / dt + K all but singular: nothing may move or fail."""
    cells = {"cube": np.ones((6, 6, 6), bool), "carved": carved(), "bar": np.ones((60, 1, 1), bool)}[shape]
    solution = solve_heat(HeatProblem(make_body(cells, voxel_m, spots), CONCRETE), TimeSteps(10, dt))
    states = solution.temperature_c
    assert solution.energy_residual < 1e-14
    assert states.min() >= -30.0 - 1e-9 and states.max() <= 90.0 + 1e-9
    assert np.ptp(states[-1]) < 1e-10
    np.testing.assert_array_equal(states[-1], states[-2])
