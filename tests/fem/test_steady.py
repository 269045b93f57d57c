import numpy as np
import pytest

from tests.support.heat_bodies import STEEL
from tests.support.heat_meshes import SIDES, box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem import implicit_equation
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.heat.effects import Convection, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material

SIGMA = 5.67e-8


def slab(temperature_c=20.0, parts: int = 10):
    return box_mesh(np.linspace(0, 0.1, parts + 1), [0, 0.02], [0, 0.02], temperature_c=temperature_c)


def test_layers_between_two_airs_are_exact() -> None:
    """Temperatures are linear in each layer, so P1 has them exactly: q = (20 - (-10)) / (1/h + sum d/k + 1/h)."""
    regions = {"brick": lambda p: p[..., 0] < 0.2, "wool": lambda p: p[..., 0] > 0.2}
    mesh = box_mesh(planes(0.0, 0.2, 0.3, step=0.05), [0, 0.1], [0, 0.1], regions=regions)
    materials = {"brick": Material("brick", 0.7, 1600.0, 940.0), "wool": Material("wool", 0.04, 30.0, 1030.0)}
    problem = HeatProblem(mesh, materials, effects=(Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -10.0)))
    for order in (1, 2):
        solution = solve_steady(problem, order=order)
        flux = 30.0 / (1 / 8 + 0.2 / 0.7 + 0.1 / 0.04 + 1 / 25)
        x = mesh.points_m[:, 0]
        exact = 20.0 - flux / 8 - flux * (np.minimum(x, 0.2) / 0.7 + np.maximum(x - 0.2, 0.0) / 0.04)
        np.testing.assert_allclose(solution.temperature_c, exact, atol=1e-9)
        assert [heat.heat_w[0] for heat in solution.effects] == pytest.approx([0.01 * flux, -0.01 * flux], rel=1e-9)
        assert solution.energy_residual < 1e-9 and solution.newton_iterations == 0
        assert "mass" not in solution.assembled.counts


def test_the_heat_of_fixed_surfaces_is_what_flows() -> None:
    effects = (FixedTemperature(("x0",), 100.0), FixedTemperature(("x1",), 0.0), InternalHeat(("*",), 1e4))
    solution = solve_steady(HeatProblem(slab(), STEEL, effects=effects))
    source = 1e4 * 0.1 * 0.02**2
    through = 50.0 * 100.0 / 0.1 * 0.02**2
    heat = [part.heat_w[0] for part in solution.effects]
    assert heat == pytest.approx([through - source / 2, -through - source / 2, source], rel=1e-9)
    assert solution.energy_residual < 1e-12


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


@pytest.mark.parametrize("start_c", [-273.15, -270.15, 20.0, 726.85])
@pytest.mark.parametrize("sky_c", [-273.14, -270.15, 726.85])
def test_radiation_alone_levels_the_body(start_c, sky_c) -> None:
    """Held by nothing but radiation, from 1000 K and to 3 K: the body takes the temperature of what it sees."""
    solution = solve_steady(HeatProblem(slab(start_c), STEEL, effects=(Radiation(("*",), 0.5, sky_c),)))
    np.testing.assert_allclose(solution.temperature_c, sky_c, atol=1e-4)


def test_too_few_newton_steps_are_a_status(monkeypatch) -> None:
    monkeypatch.setattr(implicit_equation, "MAX_ITERATIONS", 2)
    problem = HeatProblem(slab(900.0), STEEL, effects=(Radiation(("*",), 0.9, -270.0),))
    with pytest.raises(HeatError, match="Newton's method stopped after 2 steps"):
        solve_steady(problem)


def test_a_loose_piece_is_named() -> None:
    mesh = box_mesh(np.linspace(0, 0.5, 6), [0, 0.1], [0, 0.1], keep=lambda p: abs(p[..., 0] - 0.25) > 0.06)
    problem = HeatProblem(mesh, STEEL, effects=(Convection(("x0",), 5.0, 10.0),))
    with pytest.raises(
        HeatError, match=r"none on 1 of 2 pieces; the largest has 12 nodes in .*\(0\.3, 0, 0\) to \(0\.5,"
    ):
        solve_steady(problem)
    both = HeatProblem(mesh, STEEL, effects=(Convection(("x?",), 5.0, 10.0),))
    np.testing.assert_allclose(solve_steady(both).temperature_c, 10.0, atol=1e-9)


def test_more_cooling_than_heat_is_refused() -> None:
    effects = (FixedTemperature(("x0",), 0.0), HeatFlux(("x1",), -1e6))
    with pytest.raises(HeatError, match=r"falls to -1726.* K, below absolute zero.*Check their sign"):
        solve_steady(HeatProblem(slab(), STEEL, effects=effects))
    radiating = (Radiation(("x0",), 0.9, 20.0), HeatFlux(("x1",), -1e6))
    with pytest.raises(HeatError, match="below absolute zero"):
        solve_steady(HeatProblem(slab(), STEEL, effects=radiating))


@pytest.mark.parametrize("contrast", [1e-6, 1e6])
@pytest.mark.parametrize("order", [1, 2])
def test_conductivity_contrast(contrast, order) -> None:
    n = 12 // order
    rod = {"block": lambda p: p[..., 0] > -1, "rod": lambda p: np.hypot(p[..., 1] - 0.5, p[..., 2] - 0.5) < 0.2}
    axis = np.linspace(0, 1, n + 1)
    mesh = box_mesh(axis, axis, axis, regions=rod)
    materials = {"block": Material("a", 1.0, 1000.0, 1000.0), "rod": Material("b", contrast, 1000.0, 1000.0)}
    effects = (Convection(("x0",), 10.0, 20.0), FixedTemperature(("x1",), 0.0), Radiation(("z1",), 0.9, 10.0))
    solution = solve_steady(HeatProblem(mesh, materials, effects=effects), order=order)
    assert solution.energy_residual < 1e-9
    assert order == 2 or (solution.temperature_c.min() >= -1e-9 and solution.temperature_c.max() <= 20.0 + 1e-9)


def test_the_residual_is_round_off_also_where_nothing_flows_or_flows_cancel() -> None:
    mesh = box_mesh(*(planes(0.0, 0.4, step=0.1) for _ in range(3)))
    still = HeatProblem(mesh, STEEL, effects=(Convection(SIDES[:1], 8.0, 20.0), Convection(SIDES[1:], 25.0, 20.0)))
    assert solve_steady(still).energy_residual < 1e-9
    # Heat comes in through one half of a patch and leaves through the other.
    air = Varying(lambda places, _: np.where(places.points_m[:, 1] > 0.2, 30.0, -10.0), in_time=False)
    through = solve_steady(HeatProblem(mesh, STEEL, effects=(Convection(SIDES[:1], 8.0, air),)))
    assert abs(through.effects[0].heat_w[0]) < 1e-6 and through.energy_residual < 1e-9
