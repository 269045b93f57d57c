"""Case 3 of ISO 10211: an outer corner of two insulated walls, with a floor slab that goes through one to a balcony."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from tests.support.heat_bodies import box_mesh
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.heat.materials import Material

LISTED_W = (46.09, 13.89, -59.98)
"""Heat flows into the body from the lower room, the upper room and outside."""
COLDEST_C = {"lower room": 11.32, "upper room": 11.11}
"""Lowest temperatures of the surfaces of the rooms."""


def building_corner(cut_up: Callable[..., npt.NDArray[np.float64]]) -> HeatProblem:
    """Pose the problem.

    Args:
        cut_up: Takes the coordinates of the planes between parts along one axis, [m], all multiples of 0.05; returns
            those of the mesh, such as `planes` or `graded` of heat_bodies with their options filled in.

    Returns:
        Its effects are convection in the lower room, in the upper room and outside, in this order.
    """
    x, y, z = (
        cut_up(*knots)
        for knots in ((-0.1, 0, 0.05, 0.2, 1.2), (-0.7, -0.1, 0, 0.05, 0.2, 1.2), (0, 1.0, 1.15, 1.2, 2.15))
    )

    def depth(p):
        return np.minimum(p[..., 0], p[..., 1])

    def slab(p):
        return (p[..., 0] > 0.05) & (p[..., 2] > 1.0) & (p[..., 2] < 1.15)

    regions = {
        "inner wall": lambda p: depth(p) > 0.05,
        "insulation": lambda p: (depth(p) > 0) & (depth(p) < 0.05),
        "outer wall": lambda p: depth(p) < 0,
        "floor": lambda p: (depth(p) > 0.2) & (p[..., 2] > 1.15),
        "slab": slab,
    }

    def solid(p):
        wall = (depth(p) > -0.1) & (depth(p) < 0.2)
        return wall | slab(p) | ((depth(p) > 0.2) & (p[..., 2] > 1.15) & (p[..., 2] < 1.2))

    def cut(c):
        return (c[:, :2] > 1.2 - 1e-9).any(axis=1) | (c[:, 2] < 1e-9) | (c[:, 2] > 2.15 - 1e-9)

    def room(c):
        return ~cut(c) & (depth(c) > 0.2 - 1e-9)

    patches = {
        "cut": lambda c, n: cut(c),
        "outside": lambda c, n: ~cut(c) & ~room(c),
        "lower room": lambda c, n: room(c) & (c[:, 2] < 1.0 + 1e-9),
        "upper room": lambda c, n: room(c) & (c[:, 2] > 1.15),
    }
    conductivity = {"inner wall": 0.7, "insulation": 0.04, "outer wall": 1.0, "floor": 1.0, "slab": 2.5}
    effects = (
        Convection(("lower room",), 5.0, 20.0),
        Convection(("upper room",), 5.0, 15.0),
        Convection(("outside",), 20.0, 0.0),
    )
    mesh = box_mesh(x, y, z, regions=regions, patches=patches, keep=solid)
    return HeatProblem(mesh, {n: Material(n, k, 1000.0, 1000.0) for n, k in conductivity.items()}, effects=effects)
