"""Measured orders of linear tetrahedra on a manufactured solution: 2 in the mean square, 1 in the gradient."""

from __future__ import annotations

import numpy as np
import pytest

from tests.heat_meshes import box_mesh
from thermoxels_ns.fem.effects import Convection, Effect, FixedTemperature, InternalHeat
from thermoxels_ns.fem.materials import Material
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quantities import Places, Varying
from thermoxels_ns.fem.steady import solve_steady

PI = np.pi
CONDUCTOR = Material("conductor", 2.0, 1.0, 1.0)
A, B = 0.5854101966249685, 0.1381966011250105
POINTS = np.full((4, 4), B) + (A - B) * np.eye(4)
"""Four points in a tetrahedron that integrate polynomials of degree 2 exactly, as barycentric coordinates."""


def exact(p: np.ndarray) -> np.ndarray:
    return np.cos(PI * p[..., 0]) * np.sin(PI * p[..., 1]) * np.exp(p[..., 2])


def exact_gradient(p: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(p, -1, 0)
    return np.stack(
        [
            -PI * np.sin(PI * x) * np.sin(PI * y) * np.exp(z),
            PI * np.cos(PI * x) * np.cos(PI * y) * np.exp(z),
            np.cos(PI * x) * np.sin(PI * y) * np.exp(z),
        ],
        axis=-1,
    )


def source(places: Places, time_s: float) -> np.ndarray:
    return 2.0 * (2.0 * PI**2 - 1.0) * exact(places.points_m)


def air(places: Places, time_s: float) -> np.ndarray:
    """Temperature of the air that draws the exact flux: T + k grad T . n / h, with h = 3."""
    flux = 2.0 * np.einsum("ki,ki->k", exact_gradient(places.points_m), places.normals)
    return exact(places.points_m) + flux / 3.0


ROUND = ("x0", "x1", "y0", "y1", "z0", "z1")
BOUNDARIES: dict[str, tuple[Effect, ...]] = {
    "fixed": (FixedTemperature(ROUND, Varying(lambda places, time_s: exact(places.points_m), in_time=False)),),
    "convection": (Convection(ROUND, 3.0, Varying(air, in_time=False)),),
}


def errors(n: int, effects: tuple[Effect, ...], lumped_boundary: bool) -> tuple[float, float]:
    axis = np.linspace(0, 1, n + 1)
    mesh = box_mesh(axis, axis, axis, temperature_c=0.0)
    effects = (*effects, InternalHeat(("*",), Varying(source, in_time=False)))
    nodal = solve_steady(HeatProblem(mesh, CONDUCTOR, effects=effects), lumped_boundary=lumped_boundary).temperature_c
    corner = mesh.points_m[mesh.tets]
    side = corner[:, 1:] - corner[:, :1]
    volume = np.linalg.det(side) / 6.0
    difference = nodal[mesh.tets] @ POINTS.T - exact(POINTS @ corner)
    gradient = np.linalg.solve(side, (nodal[mesh.tets[:, 1:]] - nodal[mesh.tets[:, :1]])[..., None])[..., 0]
    gradient_difference = gradient[:, None] - exact_gradient(POINTS @ corner)
    mean_square = np.sqrt(np.sum(0.25 * volume[:, None] * difference**2))
    return float(mean_square), float(np.sqrt(np.sum(0.25 * volume[:, None, None] * gradient_difference**2)))


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("lumped_boundary", [True, False])
def test_orders_in_space(boundary, lumped_boundary) -> None:
    found = np.array([errors(n, BOUNDARIES[boundary], lumped_boundary) for n in (6, 12, 24)])
    orders = np.log2(found[:-1] / found[1:])
    assert np.all(np.abs(orders[-1] - [2.0, 1.0]) < 0.12), f"observed orders {orders}, errors {found}"
