"""Measured orders in space of linear and quadratic tetrahedra, on u = cos(pi x) sin(pi y) e^z in the unit cube."""

import numpy as np
import pytest
from skfem import Basis, ElementTetP1, ElementTetP2, MeshTet

from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.problem import HeatProblem, Varying
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.heat.effects import FixedTemperature, InternalHeat
from thermoxels_ns.heat.materials import Material


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
