"""How far a solution is from that of the equations themselves: by recovered gradients, and from two levels.

Both are about the body that the mesh describes; that a mesh cuts corners of a round body is another error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quadratic_space import QuadraticSpace
from thermoxels_ns.fem.recovered_gradient import gradient_defect
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import SteadySolution

HALF_THE_SIZE = 0.3
"""What halving the mesh size leaves of an error of P1: 1/4 where temperatures are smooth, 0.4 at the edges of a notch
of a right angle, where they behave as r^(2/3). An estimate with the value between is off by a factor of 1.6 after one
halving and of 2.6 after three."""
_RATIO_RANGE = (1e-3, 0.7)
_FROM_P1_TO_P2 = 0.57
"""The error of a node falls as this power of the squared error of the flux. Theory says 1/2 where temperatures are
smooth, from h^2 to h^3 against h^2 to h^4. Measured: 0.35 to 0.5 on a smooth solution, 0.5 to 0.6 on shells, 0.35 to
0.85 on bodies with notches. This value between estimates 0.35 to 2.7 times the true errors of them."""


@dataclass(frozen=True)
class RecoveredError:
    """Error of the heat flux by its distance from a smoother one (Zienkiewicz and Zhu 1987)."""

    tet_w_k: npt.NDArray[np.float64]
    """Estimate of integral(k |grad(T_exact - T)|^2) over each tetrahedron, shape (t,), [W K]: where to refine."""

    @property
    def total_w_k(self) -> float:
        """Its sum, [W K].

        With P1 it is 0.6 to 1.1 times the true one, with P2 0.4 to 0.5 times: means around a node gain less there.

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
    if len(solution.edge_temperature_c):
        nodal_k = np.concatenate([nodal_k, solution.edge_temperature_c])
        space = QuadraticSpace(Selection(mesh))
        if len(nodal_k) != space.num_nodes:
            raise _of_another_mesh(space.num_nodes, len(nodal_k))
        nodes = space.tet_nodes()
    defect = gradient_defect(mesh.points_m, mesh.tets, nodes, nodal_k, mesh.region)
    return RecoveredError(problem.conductivity_w_mk * defect)


@dataclass(frozen=True)
class ErrorRatios:
    """What a finer solution leaves of the errors of a coarser one, for `richardson`."""

    temperature: float
    """Of temperatures at nodes."""
    heat_flow: float
    """Of heat flows."""


def error_ratios(before: RecoveredError, after: RecoveredError, *, same_order: bool) -> ErrorRatios:
    """Tell how much of their errors solutions lose, from those of their fluxes.

    The error of a heat flow is of second order in that of the flux. So is that of a temperature from one mesh to a
    finer one; from P1 to P2 it gains less. Ratios are kept between 0.001 and 0.7, outside of which an estimate of
    either error cannot be trusted.

    Args:
        before: Of the coarser solution.
        after: Of the finer one.
        same_order: Whether both have tetrahedra of the same order.
    """
    total = before.total_w_k
    squared = float(np.clip(after.total_w_k / total if total > 0.0 else 0.0, *_RATIO_RANGE))
    return ErrorRatios(squared if same_order else squared**_FROM_P1_TO_P2, squared)


def richardson(difference: float, ratio: float) -> float:
    """Estimate the error of the finer of two solutions.

    If the finer one has a share `ratio` of the error of the coarser one, they differ by (1 - ratio) of that error
    (Richardson 1911). Galerkin's heat flows approach the exact one from one side, so errors do share their sign.

    Args:
        difference: Size of the difference between both, in any unit.
        ratio: Error of the finer one over that of the coarser one, above 0 and below 1.

    Raises:
        HeatError: The ratio is out of range.

    >>> richardson(0.5, 0.2)
    0.125
    """
    if not 0.0 < ratio < 1.0:
        remedy = "Use 1/4 for two meshes of linear tetrahedra, one with half the size of the other."
        raise HeatError("ratio", expected="a number above 0 and below 1", got=repr(ratio), remedy=remedy)
    return abs(difference) * ratio / (1.0 - ratio)


def _of_another_mesh(expected: int, got: int) -> HeatError:
    remedy = "Give the problem that was solved."
    return HeatError("solution", expected=f"{expected} temperatures", got=got, remedy=remedy)
