from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import STEEL
from tests.support.heat_meshes import box_mesh, planes
from tests.support.heat_problems import finer
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.error_estimate import recovered_error_w_k
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.heat.effects import Convection, FixedTemperature, InternalHeat
from thermoxels_ns.heat.materials import Material

WOOL = Material("wool", 0.04, 30.0, 1000.0)


def exact(p: np.ndarray) -> np.ndarray:
    return np.cos(np.pi * p[:, 0]) * np.sin(np.pi * p[:, 1]) * np.exp(p[:, 2])


def smooth(parts: int) -> HeatProblem:
    axis = np.linspace(0, 1, parts + 1)
    given = Varying(lambda places, t: exact(places.points_m), in_time=False)
    source = Varying(lambda places, t: (2 * np.pi**2 - 1) * exact(places.points_m), in_time=False)
    effects = (FixedTemperature(("*",), given), InternalHeat(("*",), source))
    return HeatProblem(box_mesh(axis, axis, axis), Material("any", 1.0, 1.0, 1.0), effects=effects)


def corner(parts: int, cold: tuple[str, ...] = ("other",)) -> HeatProblem:
    """Two materials around a notch, warm air above and cold air in it: the temperature is singular at the notch."""
    mesh = box_mesh(
        np.linspace(0, 1, parts + 1),
        np.linspace(0, 1, parts + 1),
        [0, 1 / parts],
        regions={"steel": lambda p: p[..., 0] > -1, "wool": lambda p: p[..., 0] > 0.75},
        keep=lambda p: (p[..., 0] > 0.5) | (p[..., 1] > 0.5),
    )
    effects = (Convection(("y1",), 500.0, 20.0), Convection(cold, 500.0, 0.0))
    return HeatProblem(mesh, {"steel": STEEL, "wool": replace(STEEL, conductivity_w_mk=5.0)}, effects=effects)


@pytest.mark.parametrize("order", [1, 2])
def test_a_flux_that_is_even_in_each_layer_has_no_error(order) -> None:
    """The gradient jumps by 1250 between layers; means are taken in each material apart."""
    regions = {"steel": lambda p: p[..., 0] < 0.2, "wool": lambda p: p[..., 0] > 0.2}
    mesh = box_mesh(planes(0.0, 0.2, 0.3, step=0.05), [0, 0.1], [0, 0.1], regions=regions)
    effects = (Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -10.0))
    problem = HeatProblem(mesh, {"steel": STEEL, "wool": WOOL}, effects=effects)
    error = recovered_error_w_k(problem, solve_steady(problem, order=order))
    through = 0.01 * 30.0 / (1 / 8 + 0.2 / 50 + 0.1 / 0.04 + 1 / 25)
    assert len(error) == len(mesh.tets)
    assert 0.0 <= error.sum() < 1e-12 * through * 30.0
    one = replace(mesh, region=np.zeros_like(mesh.region), region_names=("steel",))
    mixed = recovered_error_w_k(HeatProblem(one, STEEL, effects=effects), solve_steady(problem, order=order))
    assert mixed.sum() > 1.0


@pytest.mark.parametrize(("order", "parts"), [(1, (4, 8, 16)), (2, (4, 8))])
def test_the_recovered_error_is_close_to_the_true_one(order, parts) -> None:
    """On a smooth solution."""
    totals = []
    for number in parts:
        problem = smooth(number)
        totals.append(recovered_error_w_k(problem, solve_steady(problem, order=order)).sum())
    # L2 norms of the gradient's error, measured in tests/convergence with 64 points per tetrahedron.
    true = {1: (1.6120, 0.82468, 0.41478), 2: (0.25428, 0.065222)}[order]
    effectivity = np.sqrt(totals) / np.array(true)
    low, high = {1: (0.95, 1.05), 2: (0.9, 1.1)}[order]
    assert np.all((effectivity > low) & (effectivity < high)), effectivity


def test_the_recovered_error_is_that_of_the_heat_flow() -> None:
    """Between two airs, flow times their difference exceeds the exact one by the error: here within a factor of 2."""
    exact_w = solve_steady(finer(corner(16)), order=2).effects[0].heat_w[0]
    for parts in (8, 16):
        problem = corner(parts)
        depth = (1 / parts) / (1 / 16)
        solution = solve_steady(problem, lumped_boundary=False)
        surplus_w = solution.effects[0].heat_w[0] - depth * exact_w
        estimate_w = recovered_error_w_k(problem, solution).sum() / 20.0
        assert surplus_w > 0.0
        assert 0.5 < estimate_w / surplus_w < 2.0, (parts, estimate_w, surplus_w)


def test_a_solution_of_another_mesh_is_refused() -> None:
    problem = smooth(2)
    with pytest.raises(HeatError, match="solution: expected 125 temperatures, got 27"):
        recovered_error_w_k(smooth(4), solve_steady(problem))
    quadratic = solve_steady(problem, order=2)
    with pytest.raises(HeatError, match="solution: expected 125 temperatures, got 124"):
        recovered_error_w_k(problem, replace(quadratic, edge_temperature_c=quadratic.edge_temperature_c[1:]))
