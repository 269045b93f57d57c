import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve
from threadpoolctl import threadpool_limits

from tests.support.heat_bodies import CONCRETE, SIDES, STEEL, box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem import implicit_equation
from thermoxels_ns.fem.implicit_equation import LinearSolver
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps, Varying
from thermoxels_ns.fem.solution import EffectHeat
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.time_loop import HeatBalance, solve_heat
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material

SIGMA = 5.67e-8


def slab(temperature_c=20.0):
    return box_mesh(np.linspace(0, 0.1, 11), [0, 0.02], [0, 0.02], temperature_c=temperature_c)


@pytest.mark.parametrize("start_c", [-273.15, -270.15, 20.0, 726.85, 5000.0])
@pytest.mark.parametrize("sky_c", [-270.15, 20.0, 726.85])
def test_newton_converges_from_anywhere(start_c, sky_c) -> None:
    """Radiation at one end, 500 K at the other: k (500 - T) / L = sigma eps (T^4 - T_s^4) at the radiating end."""
    effects = (FixedTemperature(("x0",), 226.85), Radiation(("x1",), 0.9, sky_c, SIGMA))
    mesh = slab(start_c)
    solution = solve_steady(HeatProblem(mesh, STEEL, effects=effects))
    end_k = solution.temperature_c[mesh.points_m[:, 0] > 0.0999] + 273.15
    sky_k = sky_c + 273.15
    np.testing.assert_allclose(50.0 * (500.0 - end_k) / 0.1, 0.9 * SIGMA * (end_k**4 - sky_k**4), rtol=1e-8, atol=1e-9)
    assert solution.energy_residual < 1e-9
    assert 0 < solution.newton_iterations < 25, solution.status


def test_too_few_newton_steps_are_a_status(monkeypatch) -> None:
    monkeypatch.setattr(implicit_equation, "MAX_ITERATIONS", 2)
    problem = HeatProblem(slab(900.0), STEEL, effects=(Radiation(("*",), 0.9, -270.0),))
    with pytest.raises(HeatError, match="Newton's method stopped after 2 steps"):
        solve_steady(problem)


def test_more_cooling_than_heat_is_refused() -> None:
    effects = (FixedTemperature(("x0",), 0.0), HeatFlux(("x1",), -1e6))
    with pytest.raises(HeatError, match=r"falls to -1726.* K, below absolute zero.*Check their sign"):
        solve_steady(HeatProblem(slab(), STEEL, effects=effects))
    radiating = (Radiation(("x0",), 0.9, 20.0), HeatFlux(("x1",), -1e6))
    with pytest.raises(HeatError, match="below absolute zero"):
        solve_steady(HeatProblem(slab(), STEEL, effects=radiating))


COPPER = Material("copper", 400.0, 8900.0, 385.0)
INSULATION = Material("insulation", 0.03, 30.0, 1400.0)
WRONG = 1e-6
"""Share of the heat that flows by which a balance is made wrong."""


def sheet(thickness_m: float, *effects: Effect) -> HeatProblem:
    """Two layers of copper on insulation: at a fixed side, conduction's terms are far more than the heat that flows."""
    across = [0.0, 0.02, 0.04]
    regions = {"copper": lambda c: c[..., 0] < 2 * thickness_m, "insulation": lambda c: c[..., 0] > 2 * thickness_m}
    mesh = box_mesh([0.0, thickness_m, 2 * thickness_m, 0.1], across, across, temperature_c=0.0, regions=regions)
    return HeatProblem(mesh, {"copper": COPPER, "insulation": INSULATION}, effects=effects)


GIVEN = (FixedTemperature(("x0",), 20.0), FixedTemperature(("x1",), -5.0))
HARDLY = (FixedTemperature(("x0",), 20.0), FixedTemperature(("x1",), 19.99))
AIR = (FixedTemperature(("x0",), 20.0), Convection(("x1",), 25.0, -5.0))
SKY = (FixedTemperature(("x0",), 20.0), Radiation(("x1",), 0.9, -5.0))
FLOWING = pytest.mark.parametrize("effects", [GIVEN, HARDLY, AIR, SKY], ids=["given", "hardly", "air", "sky"])


@FLOWING
@pytest.mark.parametrize("thickness_m", [1e-3, 1e-4, 1e-5, 1e-6])
def test_a_steady_balance_that_is_wrong_is_seen(monkeypatch, effects, thickness_m) -> None:
    problem, right = sheet(thickness_m, *effects), HeatSystem.by_group
    solution = solve_steady(problem)
    flows_w = np.array([heat.heat_w[0] for heat in solution.effects])
    # The share of the heat that flows is said as it is: in and out are counted.
    assert solution.energy_residual == pytest.approx(abs(flows_w.sum()) / np.abs(flows_w).sum(), rel=0.1, abs=1e-13)

    def wrong(*arguments) -> np.ndarray:
        heat_w = right(*arguments)
        heat_w[0] += WRONG * np.abs(heat_w).max() * (1.0 if heat_w.sum() >= 0.0 else -1.0)
        return heat_w

    monkeypatch.setattr(HeatSystem, "by_group", wrong)
    assert solve_steady(problem).energy_residual > 0.3 * WRONG


@FLOWING
@pytest.mark.parametrize("thickness_m", [1e-3, 1e-5])
@pytest.mark.parametrize("step_s", [60.0, 86400.0, 1e8])
def test_a_balance_through_time_that_is_wrong_is_seen(monkeypatch, effects, thickness_m, step_s) -> None:
    def moved_j(heat: EffectHeat) -> float:
        return float(np.abs(heat.heat_w).sum()) * step_s

    problem, steps, add = sheet(thickness_m, *effects), TimeSteps(3, step_s), HeatBalance.add

    def wrong(balance, step, step_s, **options) -> None:
        step.group_heat_w[0] *= 1.0 + WRONG
        add(balance, step, step_s, **options)

    monkeypatch.setattr(HeatBalance, "add", wrong)
    solution = solve_heat(problem, steps)
    share = moved_j(solution.effects[0]) / sum(moved_j(heat) for heat in solution.effects)
    # What the body stores in differences counts too, and is up to a hundred times as much as flows in a short time.
    assert share > 0.1 and solution.energy_residual > 0.005 * share * WRONG


@pytest.mark.parametrize(
    "effects",
    [
        (FixedTemperature(("x0",), 20.0),),
        (FixedTemperature(SIDES, 20.0),),
        (Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, 20.0)),
        (Radiation(SIDES, 0.9, 20.0), Convection(("x1",), 25.0, 20.0)),
        (FixedTemperature(("x0",), 0.0), Convection(("x1",), 25.0, 0.0)),
    ],
    ids=["one", "all", "equal airs", "air and sky", "as at the start"],
)
@pytest.mark.parametrize("relative_tolerance", [1e-12, 1e-8])
def test_where_nothing_makes_heat_flow_round_off_is_no_share_of_itself(effects, relative_tolerance) -> None:
    solution = solve_steady(sheet(1e-3, *effects), relative_tolerance=relative_tolerance)
    assert solution.energy_residual < 1e-9


def test_the_residual_is_round_off_where_flows_cancel() -> None:
    """Heat comes in through one half of a patch and leaves through the other."""
    air = Varying(lambda places, _: np.where(places.points_m[:, 1] > 0.02, 30.0, -10.0), in_time=False)
    through = solve_steady(sheet(1e-3, Convection(("x0",), 8.0, air)))
    assert abs(through.effects[0].heat_w[0]) < 1e-6 and through.energy_residual < 1e-9


@pytest.mark.parametrize("patience", [1, implicit_equation.PATIENCE])
def test_agrees_with_a_direct_solver(monkeypatch, patience) -> None:
    """Laplacian of a random graph with weights over six decades, plus a small mass: symmetric positive definite."""
    monkeypatch.setattr(implicit_equation, "PATIENCE", patience)
    rng = np.random.default_rng(0)
    ends, weight = rng.integers(0, 400, (2, 1600)), 10.0 ** rng.uniform(-3.0, 3.0, 1600)
    links = sparse.coo_matrix((weight, ends), shape=(400, 400))
    links = (links + links.T).tolil()
    links.setdiag(0.0)
    matrix = sparse.csr_matrix(sparse.diags(np.asarray(links.sum(axis=1)).ravel() + 1e-2) - links)
    b = np.random.default_rng(1).normal(size=400)
    solution = LinearSolver(matrix).solve(b)
    exact = spsolve(matrix.tocsc(), b)
    assert solution.converged and ("multigrid" in solution.status) == (patience == 1)
    np.testing.assert_allclose(solution.x, exact, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize("patience", [1, implicit_equation.PATIENCE])
def test_the_same_bits_with_any_number_of_threads(monkeypatch, patience) -> None:
    """A cube of 21^3 nodes, above the size from which BLAS shares a sum among threads."""
    monkeypatch.setattr(implicit_equation, "PATIENCE", patience)
    x = planes(0.0, 1.0, step=0.05)
    air = Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -5.0)
    system = HeatSystem(HeatProblem(box_mesh(x, x, x), CONCRETE, effects=air))
    matrix, heat_w = system.matrix(0.0, np.inf), system.net_heat(system.start_k, 0.0)
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            found.append(LinearSolver(matrix).solve(heat_w))
    assert found[0].converged and found[0].iterations == found[1].iterations
    assert patience > 1 or found[0].iterations <= 30
    np.testing.assert_array_equal(found[0].x, found[1].x)


def test_a_mesh_whose_corners_are_all_fixed() -> None:
    """The middles of the inner edges are all that is solved for."""
    mesh = box_mesh([0, 1], [0, 1], [0, 1])
    effects = (FixedTemperature(("*",), 0.0), InternalHeat(("*",), 60.0))
    solution = solve_steady(HeatProblem(mesh, STEEL, effects=effects), order=2)
    assert solution.edge_temperature_c.max() > 0.0 and np.abs(solution.temperature_c).max() == 0.0
    assert solution.effects[0].heat_w[0] == pytest.approx(-60.0, rel=1e-9)
