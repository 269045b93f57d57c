"""Measured orders in time; and in space, on u = cos(pi x) sin(pi y) e^z in the unit cube."""

from functools import cache

import numpy as np
import pytest
from skfem import Basis, ElementTetP1, ElementTetP2, MeshTet

from tests.support.heat_bodies import CONCRETE, box_mesh
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, Varying
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import BACKWARD_EULER, SDIRK2, Scheme, solve_heat
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material

DURATION_S = 4 * 3600.0


def swing(middle: float, size: float) -> Varying:
    return Varying(lambda places, time_s: middle + size * np.sin(2.0 * np.pi * time_s / DURATION_S))


EFFECTS: dict[str, tuple[Effect, ...]] = {
    "air and sun": (Convection(("x0",), 20.0, swing(10.0, 8.0)), HeatFlux(("x1",), swing(100.0, 80.0))),
    "wind": (Convection(("x0",), swing(10.0, 6.0), 5.0), Convection(("x1",), 8.0, 20.0)),
    "sky": (Radiation(("x0",), 0.9, swing(-20.0, 10.0)), Convection(("x1",), 8.0, 20.0)),
    "swinging end": (FixedTemperature(("x0",), swing(20.0, 15.0)), InternalHeat(("*",), swing(50.0, 40.0))),
}


def problem(name: str) -> HeatProblem:
    mesh = box_mesh(
        np.linspace(0, 0.2, 9), [0, 0.02], [0, 0.02], temperature_c=lambda p: 20.0 + 5.0 * np.cos(15 * p[:, 0])
    )
    if name == "swinging end":
        mesh = box_mesh(np.linspace(0, 0.2, 9), [0, 0.02], [0, 0.02])
    return HeatProblem(mesh, CONCRETE, effects=EFFECTS[name])


def end(name: str, scheme: Scheme, steps: int) -> np.ndarray:
    time = TimeSteps(steps, DURATION_S / steps)
    return solve_heat(problem(name), time, scheme=scheme).temperature_c[-1]


@cache
def reference(name: str) -> np.ndarray:
    """Short steps on the same mesh and Richardson's extrapolation, so that only the time error is left."""
    return (4.0 * end(name, SDIRK2, 320) - end(name, SDIRK2, 160)) / 3.0


def observed(name: str, scheme: Scheme) -> tuple[float, list[float]]:
    errors = [float(np.abs(end(name, scheme, steps) - reference(name)).max()) for steps in (20, 40, 80)]
    return float(np.log2(errors[1] / errors[2])), errors


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize(("scheme", "order"), [(BACKWARD_EULER, 1), (SDIRK2, 2)])
def test_orders_in_time(name, scheme, order) -> None:
    found, errors = observed(name, scheme)
    assert abs(found - order) < 0.15, f"observed order {found}, errors {errors}"
    assert errors[0] > errors[1] > errors[2]


def test_adaptive_steps_pay_the_third_root_of_the_tolerance() -> None:
    """The estimate is of third order: a thousandth of the tolerance takes about ten times the steps."""
    steps = [
        solve_heat(problem("wind"), AdaptiveSteps(DURATION_S, tolerance, outputs=1)).steps for tolerance in (1.0, 1e-3)
    ]
    assert 5.0 < steps[1] / steps[0] < 15.0, steps


def exact(p: np.ndarray) -> np.ndarray:
    return np.cos(np.pi * p[..., 0]) * np.sin(np.pi * p[..., 1]) * np.exp(p[..., 2])


def exact_gradient(p: np.ndarray) -> np.ndarray:
    wave = np.exp(p[..., 2])
    x, y = np.pi * p[..., 0], np.pi * p[..., 1]
    return np.stack(
        [-np.pi * np.sin(x) * np.sin(y) * wave, np.pi * np.cos(x) * np.cos(y) * wave, np.cos(x) * np.sin(y) * wave]
    )


def errors(parts: int, order: int) -> tuple[float, float]:
    """L2 norms of the error and of its gradient, integrated by scikit-fem, whose numbers of unknowns are ours."""
    axis = np.linspace(0, 1, parts + 1)
    mesh = box_mesh(axis, axis, axis)
    fixed = FixedTemperature(("*",), Varying(lambda places, t: exact(places.points_m), in_time=False))
    # -div grad u = (2 pi^2 - 1) u
    source = Varying(lambda places, t: (2 * np.pi**2 - 1) * exact(places.points_m), in_time=False)
    effects = (fixed, InternalHeat(("*",), source))
    solution = solve_steady(HeatProblem(mesh, Material("any", 1.0, 1.0, 1.0), effects=effects), order=order)
    every = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    element = ElementTetP1() if order == 1 else ElementTetP2()
    basis = Basis(MeshTet(mesh.points_m.T.copy(), mesh.tets.T.copy()), element, intorder=6)
    found, places = basis.interpolate(every), np.moveaxis(np.asarray(basis.global_coordinates()), 0, -1)
    square = np.sum(basis.dx * (np.asarray(found) - exact(places)) ** 2)
    gradient_square = np.sum(basis.dx * np.sum((found.grad - exact_gradient(places)) ** 2, axis=0))
    return float(np.sqrt(square)), float(np.sqrt(gradient_square))


@pytest.mark.parametrize(("order", "parts"), [(1, (4, 8, 16)), (2, (2, 4, 8))])
def test_orders_in_space(order, parts) -> None:
    """L2 2 and H1 1 for linear tetrahedra, 3 and 2 for quadratic ones."""
    found = np.array([errors(n, order) for n in parts])
    orders = np.log2(found[:-1] / found[1:])
    message = f"P{order} with {parts} parts: observed orders L2 {orders[:, 0]}, H1 {orders[:, 1]}; errors {found}"
    assert abs(orders[-1, 0] - (order + 1)) < 0.15, message
    assert abs(orders[-1, 1] - order) < 0.1, message
