"""Measured orders in space of linear and quadratic tetrahedra, on u = cos(pi x) sin(pi y) e^z in the unit cube."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.edge_midpoints import TET_EDGES
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quadratic_elements import edge_shapes
from thermoxels_ns.fem.quadratic_space import QuadraticSpace
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.heat.effects import FixedTemperature, InternalHeat
from thermoxels_ns.heat.materials import Material


def exact(p: np.ndarray) -> np.ndarray:
    return np.cos(np.pi * p[..., 0]) * np.sin(np.pi * p[..., 1]) * np.exp(p[..., 2])


def exact_gradient(p: np.ndarray) -> np.ndarray:
    wave = np.exp(p[..., 2])
    x, y = np.pi * p[..., 0], np.pi * p[..., 1]
    return np.stack(
        [
            -np.pi * np.sin(x) * np.sin(y) * wave,
            np.pi * np.cos(x) * np.cos(y) * wave,
            np.cos(x) * np.sin(y) * wave,
        ],
        axis=-1,
    )


def cubature(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric points and weights of a tetrahedron, Gauss in each of three directions (Stroud's conical product)."""
    node, weight = np.polynomial.legendre.leggauss(points)
    node, weight = 0.5 * (node + 1.0), 0.5 * weight
    a, b, c = np.meshgrid(node, node, node, indexing="ij")
    weights = np.einsum("i,j,k->ijk", weight * (1 - node) ** 2, weight * (1 - node), weight) * 6.0
    first, second, third = a, (1 - a) * b, (1 - a) * (1 - b) * c
    return np.stack([1 - first - second - third, first, second, third], axis=-1).reshape(-1, 4), weights.ravel()


def errors(parts: int, order: int) -> tuple[float, float]:
    """L2 norms of the error and of its gradient."""
    axis = np.linspace(0, 1, parts + 1)
    mesh = box_mesh(axis, axis, axis)
    fixed = FixedTemperature(("*",), Varying(lambda places, t: exact(places.points_m), in_time=False))
    # -div grad u = (2 pi^2 - 1) u
    source = Varying(lambda places, t: (2 * np.pi**2 - 1) * exact(places.points_m), in_time=False)
    corner = mesh.points_m[mesh.tets]
    effects = (fixed, InternalHeat(("*",), source))
    solution = solve_steady(HeatProblem(mesh, Material("any", 1.0, 1.0, 1.0), effects=effects), order=order)
    side = corner[:, 1:] - corner[:, :1]
    slope = np.linalg.inv(side).transpose(0, 2, 1)
    slope = np.concatenate([-slope.sum(axis=1, keepdims=True), slope], axis=1)
    volume = np.linalg.det(side) / 6.0
    nodal = solution.temperature_c[mesh.tets]
    if order == 2:
        every = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
        nodal = every[QuadraticSpace(Selection(mesh)).tet_nodes()]
    shares, weights = cubature(4)
    square = gradient_square = 0.0
    for share, weight in zip(shares, weights):
        place = np.einsum("a,tai->ti", share, corner)
        if order == 1:
            value, gradient = nodal @ share, np.einsum("ta,tai->ti", nodal, slope)
        else:
            value = nodal @ edge_shapes(share[None])[0]
            gradient = np.einsum("ta,tai->ti", nodal[:, :4] * (4 * share - 1), slope)
            for number, (i, j) in enumerate(TET_EDGES):
                mixed = share[i] * slope[:, j] + share[j] * slope[:, i]
                gradient += 4 * nodal[:, 4 + number, None] * mixed
        square += weight * volume @ (value - exact(place)) ** 2
        gradient_square += weight * volume @ np.sum((gradient - exact_gradient(place)) ** 2, axis=1)
    return float(np.sqrt(square)), float(np.sqrt(gradient_square))


@pytest.mark.parametrize(("order", "parts"), [(1, (4, 8, 16)), (2, (2, 4, 8))])
def test_orders_in_space(order, parts) -> None:
    """L2 2 and H1 1 for linear tetrahedra, 3 and 2 for quadratic ones."""
    found = np.array([errors(n, order) for n in parts])
    orders = np.log2(found[:-1] / found[1:])
    message = f"P{order} with {parts} parts: observed orders L2 {orders[:, 0]}, H1 {orders[:, 1]}; errors {found}"
    assert abs(orders[-1, 0] - (order + 1)) < 0.15, message
    assert abs(orders[-1, 1] - order) < 0.1, message
