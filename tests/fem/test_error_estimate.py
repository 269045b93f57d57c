from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.error_estimate import RecoveredError, error_ratios, recovered_error, richardson
from thermoxels_ns.fem.hierarchical_error_in_time import edge_surplus
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.recovered_gradient import curvature_k
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.heat.effects import Convection, FixedTemperature, InternalHeat
from thermoxels_ns.heat.materials import Material

STEEL = Material("steel", 50.0, 7800.0, 450.0)
WOOL = Material("wool", 0.04, 30.0, 1000.0)


def exact(p: np.ndarray) -> np.ndarray:
    return np.cos(np.pi * p[:, 0]) * np.sin(np.pi * p[:, 1]) * np.exp(p[:, 2])


ENERGY = (np.exp(2.0) - 1.0) / 8.0 * (2.0 * np.pi**2 + 1.0)
"""integral |grad u|^2 over the unit cube for the function above."""


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
    error = recovered_error(problem, solve_steady(problem, order=order))
    through = 0.01 * 30.0 / (1 / 8 + 0.2 / 50 + 0.1 / 0.04 + 1 / 25)
    assert len(error.tet_w_k) == len(mesh.tets)
    assert 0.0 <= error.total_w_k < 1e-12 * through * 30.0
    one = replace(mesh, region=np.zeros_like(mesh.region), region_names=("steel",))
    mixed = recovered_error(HeatProblem(one, STEEL, effects=effects), solve_steady(problem, order=order))
    assert mixed.total_w_k > 1.0


@pytest.mark.parametrize(("order", "parts"), [(1, (4, 8, 16)), (2, (4, 8))])
def test_the_recovered_error_is_close_to_the_true_one(order, parts) -> None:
    """All of it with P1; with P2 means around nodes find two thirds."""
    totals = []
    for number in parts:
        problem = smooth(number)
        totals.append(recovered_error(problem, solve_steady(problem, order=order)).total_w_k)
    # L2 norms of the gradient's error, measured in tests/convergence with 64 points per tetrahedron.
    true = {1: (1.6120, 0.82468, 0.41478), 2: (0.25428, 0.065222)}[order]
    effectivity = np.sqrt(totals) / np.array(true)
    low, high = {1: (0.95, 1.05), 2: (0.6, 0.75)}[order]
    assert np.all((effectivity > low) & (effectivity < high)), effectivity


def test_the_recovered_error_is_that_of_the_heat_flow() -> None:
    """Between two airs, flow times their difference exceeds the exact one by the error: here within a factor of 2."""
    exact_w = solve_steady(replace_mesh(corner(16), 1), order=2).effects[0].heat_w[0]
    for parts in (8, 16):
        problem = corner(parts)
        depth = (1 / parts) / (1 / 16)
        solution = solve_steady(problem, lumped_boundary=False)
        surplus_w = solution.effects[0].heat_w[0] - depth * exact_w
        estimate_w = recovered_error(problem, solution).total_w_k / 20.0
        assert surplus_w > 0.0
        assert 0.5 < estimate_w / surplus_w < 2.0, (parts, estimate_w, surplus_w)


def test_the_worst_tetrahedra_are_at_the_notch() -> None:
    problem = corner(16)
    error = recovered_error(problem, solve_steady(problem))
    centre = problem.mesh.points_m[problem.mesh.tets].mean(axis=1)
    from_notch = np.abs(centre[:, :2] - 0.5).max(axis=1)
    assert error.tet_w_k[from_notch < 1 / 16].mean() > 10.0 * error.tet_w_k.mean()


def test_richardson() -> None:
    """T_h = 1 + 0.4 h^2: from h = 1 and h = 1/2 the error of the second is 0.1."""
    assert richardson(1.4 - 1.1, 0.25) == pytest.approx(0.1)
    assert richardson(1.1 - 1.4, 0.25) == pytest.approx(0.1)
    assert richardson(0.0, 0.5) == 0.0
    for ratio in (0.0, 1.0, -0.1, np.nan):
        with pytest.raises(HeatError, match="ratio: expected a number above 0 and below 1"):
            richardson(1.0, ratio)


def test_error_ratios() -> None:
    first, second = RecoveredError(np.array([1.0, 3.0])), RecoveredError(np.array([0.5, 0.5]))
    ratios = error_ratios(first, second, same_order=True)
    assert (ratios.temperature, ratios.heat_flow) == (0.25, 0.25)
    ratios = error_ratios(first, second, same_order=False)
    assert (ratios.temperature, ratios.heat_flow) == (pytest.approx(0.25**0.57), 0.25)
    assert error_ratios(second, first, same_order=True).heat_flow == 0.7
    nothing = RecoveredError(np.zeros(2))
    for pair in ((first, nothing), (nothing, first)):
        assert error_ratios(*pair, same_order=True).temperature == 1e-3


def test_a_solution_of_another_mesh_is_refused() -> None:
    problem = smooth(2)
    with pytest.raises(HeatError, match="solution: expected 125 temperatures, got 27"):
        recovered_error(smooth(4), solve_steady(problem))
    quadratic = solve_steady(problem, order=2)
    with pytest.raises(HeatError, match="solution: expected 125 temperatures, got 124"):
        recovered_error(problem, replace(quadratic, edge_temperature_c=quadratic.edge_temperature_c[1:]))


def replace_mesh(problem: HeatProblem, times: int) -> HeatProblem:
    for _ in range(times):
        problem = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=None)
    return problem


def test_straight_temperatures_have_no_curvature_and_bent_ones_four_times_less_on_half_the_size() -> None:
    sizes = []
    for parts in (4, 8):
        mesh = smooth(parts).mesh
        assert curvature_k(mesh, (mesh.points_m @ [1.0, 2.0, 3.0])[None]) < 1e-9
        sizes.append(curvature_k(mesh, np.stack([0.0 * mesh.points_m[:, 0], exact(mesh.points_m)])))
    assert 3.0 < sizes[0] / sizes[1] < 5.0, sizes


@pytest.mark.parametrize("at_once", [1, 1000, 200_000])
def test_the_surplus_of_all_times_together_is_that_of_one_after_the_other(at_once, monkeypatch) -> None:
    """A coefficient that may change with time, and does not, gives each time a matrix of its own."""
    monkeypatch.setattr("thermoxels_ns.fem.hierarchical_error_in_time._AT_ONCE", at_once)
    axis = np.linspace(0.0, 0.3, 4)
    warm = Varying(lambda places, time_s: 60.0 * np.cos(time_s / 1000.0))
    air = Varying(lambda places, time_s: 5.0 * np.sin(time_s / 500.0))

    def surplus(coefficient: float | Varying):
        effects = (
            Convection(("x0",), coefficient, air),
            FixedTemperature(("x1",), warm),
            InternalHeat(("*",), 500.0),
        )
        problem = HeatProblem(box_mesh(axis, axis, axis, temperature_c=20.0), STEEL, effects=effects)
        return edge_surplus(problem, solve_heat(problem, AdaptiveSteps(3600.0, 0.1)))

    together, apart = surplus(25.0), surplus(Varying(lambda places, time_s: 25.0))
    size_k, size_w = np.abs(apart.temperature_k).max(), np.abs(apart.group_heat_w).max()
    assert size_k > 0.1 and size_w > 0.1 and together.groups == apart.groups
    np.testing.assert_allclose(together.temperature_k, apart.temperature_k, atol=1e-6 * size_k)
    np.testing.assert_allclose(together.group_heat_w, apart.group_heat_w, atol=1e-6 * size_w)


def test_the_surplus_follows_the_error_through_time() -> None:
    """A block that one hot side warms, against a mesh of half the size twice; heat that flowed in too."""
    axis = np.linspace(0, 0.1, 7)
    swing = Varying(lambda places, t: 100.0 * np.sin(np.pi * t / 40.0))
    effects = (FixedTemperature(("x1",), swing), Convection(("y0",), 400.0, 0.0))
    mesh = box_mesh(axis, axis, [0, 0.1 / 6], temperature_c=0.0)
    problem = HeatProblem(mesh, Material("steel", 35.0, 7200.0, 440.5), effects=effects)
    steps = AdaptiveSteps(32.0, 0.05)
    rough, fine = solve_heat(problem, steps), solve_heat(replace_mesh(problem, 2), steps)
    surplus = edge_surplus(problem, rough)
    true_k = fine.temperature_c[:, : len(mesh.points_m)] - rough.temperature_c
    assert np.all(surplus.temperature_k[0] == 0.0)
    share = np.abs(surplus.temperature_k).max() / np.abs(true_k).max()
    assert 0.7 < share < 1.4, share
    last = surplus.temperature_k[-1] @ true_k[-1]
    assert last > 0.8 * np.linalg.norm(surplus.temperature_k[-1]) * np.linalg.norm(true_k[-1])
    true_w = [fine.effects[k].heat_w.mean() - rough.effects[k].heat_w.mean() for k in (0, 1)]
    added_w = {label: surplus.group_heat_w[1:, i].mean() for i, (label, _) in enumerate(surplus.groups)}
    estimated_w = [added_w[heat.effect] for heat in rough.effects]
    assert np.sign(estimated_w).tolist() == np.sign(true_w).tolist()
    assert 0.7 < estimated_w[1] / true_w[1] < 1.4, (estimated_w, true_w)
    assert 1.0 < estimated_w[0] / true_w[0] < 4.0, (estimated_w, true_w)
