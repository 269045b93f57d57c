"""How far a solution is from that of the equations themselves: by recovered gradients, and from two levels.

Both are about the body that the mesh describes; that a mesh cuts corners of a round body is another error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.errors import HeatError, explain
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quadratic_space import QuadraticSpace
from thermoxels_ns.fem.recovered_gradient import gradient_defect
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import SteadySolution

HALF_THE_SIZE = 0.3
"""What halving the mesh size leaves of an error of P1: 1/4 where temperatures are smooth, 0.4 at the edges of a notch
of a right angle, where they behave as r^(2/3). An estimate with the value between is off by a factor of 1.6 after one
halving and of 2.6 after three."""
_QUADRATIC_SHARE = 0.45
"""Share of the squared error that means around nodes find with P2, measured: 0.41 to 0.45 on a smooth solution, 0.52 on
a building corner with notches. With P1 it is 0.8 to 1.05."""
_RATIO_RANGE = (1.0 / 64.0, 0.7)


@dataclass(frozen=True)
class RecoveredError:
    """Error of the heat flux by its distance from a smoother one (Zienkiewicz and Zhu 1987)."""

    tet_w_k: npt.NDArray[np.float64]
    """Estimate of integral(k |grad(T_exact - T)|^2) over each tetrahedron, shape (t,), [W K]: where to refine."""

    @property
    def total_w_k(self) -> float:
        """Its sum, [W K].

        Divided by the difference between the temperatures of two surroundings it is the error of the heat flow from one
        to the other, since the error of a heat flow is of the second order in that of the flux.
        """
        return float(self.tet_w_k.sum())


def recovered_error(problem: HeatProblem, solution: SteadySolution) -> RecoveredError:
    """Estimate the error of the heat flux by recovery.

    The recovered flux interpolates means of k grad T over the tetrahedra around each node, taken in every material
    apart: it is continuous there and closer to the exact one than k grad T.

    Args:
        problem: What was solved.
        solution: Its steady state, with linear or quadratic tetrahedra.

    Raises:
        HeatError: The solution is not of this problem's mesh.
    """
    mesh = problem.mesh
    nodal_k, nodes = solution.temperature_c, mesh.tets
    if len(nodal_k) != len(mesh.points_m):
        raise _of_another_mesh(len(mesh.points_m), len(nodal_k))
    share = 1.0
    if len(solution.edge_temperature_c):
        nodal_k = np.concatenate([nodal_k, solution.edge_temperature_c])
        space = QuadraticSpace(Selection(mesh))
        if len(nodal_k) != space.num_nodes:
            raise _of_another_mesh(space.num_nodes, len(nodal_k))
        nodes, share = space.tet_nodes(), _QUADRATIC_SHARE
    defect = gradient_defect(mesh.points_m, mesh.tets, nodes, nodal_k, mesh.region)
    return RecoveredError(problem.conductivity_w_mk * defect / share)


def error_ratio(before: RecoveredError, after: RecoveredError) -> float:
    """Tell what a finer solution leaves of an error that is of second order in the flux, for `richardson`.

    Temperatures at nodes and heat flows have such errors. The ratio is kept between 1/64 and 0.7, outside of which an
    estimate of either error cannot be trusted.
    """
    total = before.total_w_k
    ratio = after.total_w_k / total if total > 0.0 else 0.0
    return float(np.clip(ratio, *_RATIO_RANGE))


def richardson(difference: float, ratio: float) -> float:
    """Estimate the error of the finer of two solutions.

    If the finer one has a share `ratio` of the error of the coarser one, they differ by (1 - ratio) of that error
    (Richardson 1911). Galerkin's heat flows approach the exact one from one side, so errors do share their sign.

    Args:
        difference: Size of the difference between both, in any unit.
        ratio: Error of the finer one over that of the coarser one, above 0 and below 1.

    Raises:
        HeatError: The ratio is out of range.

    >>> richardson(0.3, 0.25)
    0.1
    """
    if not 0.0 < ratio < 1.0:
        remedy = "Use 1/4 for two meshes of linear tetrahedra, one with half the size of the other."
        raise HeatError(explain("ratio", expected="a number above 0 and below 1", got=repr(ratio), remedy=remedy))
    return abs(difference) * ratio / (1.0 - ratio)


def _of_another_mesh(expected: int, got: int) -> HeatError:
    remedy = "Give the problem that was solved."
    return HeatError(explain("solution", expected=f"{expected} temperatures", got=got, remedy=remedy))
