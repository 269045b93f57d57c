"""Errors of heat solutions estimated from two levels (Richardson) and recovered fluxes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import ErrorSize, Solution, SteadySolution, mean_flows_w, share_of_heat
from thermoxels_ns.fem.space import Space

Vector = npt.NDArray[np.float64]

HALVED = 0.3
"""Share of an error that is left after the mesh size of linear tetrahedra, or the steps of SDIRK2, are halved. Theory
says 1/4 where temperatures are smooth, and 0.4 at the edges of a notch of a right angle, where they behave as r^(2/3).
An estimate with the value between is off by a factor of 1.6 after one halving and of 2.6 after three."""
_RATIO_RANGE = (1e-3, 0.7)
"""Range of ratios between the errors of two levels; outside of it an estimate of either error cannot be trusted."""
_QUADRATIC_RECOVERY = 0.5
"""Factor on the recovered error of quadratic tetrahedra beside that of linear ones: where a temperature is
singular it is found two to three times too large. Then ratios are 0.3 to 1.4 times the true ones."""
_FROM_P1_TO_P2, _MOST_FROM_P1_TO_P2 = 0.57, 0.24
"""The error of a node falls as this power of the squared error of the flux from linear to quadratic tetrahedra, and to
no more than this share. Theory says 1/2 where temperatures are smooth, from h^2 to h^3 against h^2 to h^4. Estimates
with both are 0.45 to 1.5 times the true error on smooth solutions, shells and bodies with notches, and 2.9 times where
a given temperature meets convection at an edge."""
_LEAST_OF_HALF_THE_SIZE = 0.17
"""Least share of a node's error with quadratic tetrahedra that is left after the mesh size is halved: 1/8 where
temperatures are smooth, 0.3 where two airs meet at an edge."""
_CORNERS = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Corners of the reference tetrahedron, shape (3, 4)."""


def richardson(difference: float, ratio: float) -> float:
    """Estimate the error of the finer of two solutions from their difference, in any unit.

    If the finer one has a share `ratio`, above 0 and below 1, of the error of the coarser one, they differ by (1 -
    ratio) of that error (Richardson 1911). Galerkin's heat flows approach the exact one from one side.

    Raises:
        HeatError: The ratio is out of range.

    >>> richardson(0.5, 0.2)
    0.125
    """
    if not 0.0 < ratio < 1.0:
        remedy = "Use 1/4 for two meshes of linear tetrahedra, one with half the size of the other."
        raise HeatError("ratio", expected="a number above 0 and below 1", got=repr(ratio), remedy=remedy)
    return abs(difference) * ratio / (1.0 - ratio)


def compared_values(solution: Solution, num_nodes: int) -> Vector:
    """List temperatures of the first `num_nodes` nodes, which solutions share, at all times, then `mean_flows_w`."""
    flows_w = np.array(list(mean_flows_w(solution).values()))
    return np.concatenate([solution.temperature_c[..., :num_nodes].ravel(), flows_w])


def error_size(error: Vector, solution: Solution) -> ErrorSize:
    """Give the largest errors of a solution from those of its `compared_values`; shares are of its heat flows."""
    errors, first_flow = np.abs(error), len(error) - len(solution.effects)
    largest_w = float(np.max(errors[first_flow:], initial=0.0))
    return ErrorSize(float(np.max(errors[:first_flow])), share_of_heat(largest_w, solution))


def difference_between(coarse: Solution, fine: Solution, num_nodes: int) -> ErrorSize:
    """Compare two solutions of one problem at the same times; `num_nodes` as in `compared_values`."""
    return error_size(compared_values(fine, num_nodes) - compared_values(coarse, num_nodes), fine)


def recovered_error_w_k(problem: HeatProblem, solution: SteadySolution) -> Vector:
    """Estimate integral(k |grad(T_exact - T)|^2) over each tetrahedron (Zienkiewicz and Zhu 1987), shape (t,), [W K].

    The recovered gradient interpolates means of grad T over the tetrahedra around each corner, weighted by volume. The
    means are taken in every region apart, because gradients jump where the conductivity does.

    Raises:
        HeatError: The solution is not of this problem's mesh.
    """
    mesh = problem.mesh
    gradient, volumes_m3 = _corner_gradients(problem, solution)
    key = (mesh.region[:, None] * len(mesh.points_m) + mesh.tets).ravel()
    weights = np.repeat(volumes_m3, 4)
    totals = [np.bincount(key, weights * gradient[..., axis].ravel()) for axis in range(3)]
    mean = np.stack([total[key] for total in totals], axis=-1) / np.bincount(key, weights)[key, None]
    defect = gradient - mean.reshape(gradient.shape)
    squares = np.square(defect.sum(axis=1)).sum(axis=1) + np.square(defect).sum(axis=(1, 2))
    return problem.conductivity_w_mk * volumes_m3 * squares / 20.0


def error_ratios(before_w_k: Vector, after_w_k: Vector, decrease: float | None = None) -> ErrorSize:
    """Tell what is left of the errors of a coarser solution in a finer, quadratic one, from their recovered errors.

    The error of a heat flow is of second order in that of the flux. So is that of a temperature from one mesh to a
    finer one; where a given temperature meets convection at an edge, nodes gain more. `decrease`, the difference of
    both solutions over the one before, shows it; None: the coarser solution has linear tetrahedra.
    """
    before, after = float(before_w_k.sum()), float(after_w_k.sum())
    share = after / before if before > 0.0 else 0.0
    if decrease is None:
        squared = float(np.clip(_QUADRATIC_RECOVERY * share, *_RATIO_RANGE))
        return ErrorSize(min(squared**_FROM_P1_TO_P2, _MOST_FROM_P1_TO_P2), squared)
    squared = float(np.clip(share, *_RATIO_RANGE))
    return ErrorSize(max(float(np.sqrt(squared * np.clip(decrease, *_RATIO_RANGE))), _LEAST_OF_HALF_THE_SIZE), squared)


def _corner_gradients(problem: HeatProblem, solution: SteadySolution) -> tuple[Vector, Vector]:
    """Gradient of T at the corners of each tetrahedron, shape (t, 4, 3), [K / m], and volumes, shape (t,), [m3]."""
    mesh, quadratic = problem.mesh, len(solution.edge_temperature_c) > 0
    space = Space(Selection(mesh), order=2 if quadratic else 1, lumped=not quadratic)
    nodal_c = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    if len(nodal_c) != space.num_nodes:
        expected, remedy = f"{space.num_nodes} temperatures", "Give the problem that was solved."
        raise HeatError("solution", expected=expected, got=len(nodal_c), remedy=remedy)
    corners, nodes = mesh.points_m[mesh.tets], space.tet_nodes()
    sides = corners[:, 1:] - corners[:, :1]
    slopes = [np.broadcast_to(space.element.lbasis(_CORNERS, i)[1], (3, 4)) for i in range(nodes.shape[1])]
    local = np.einsum("ti,iac->tca", nodal_c[nodes], np.stack(slopes))
    return local @ np.linalg.inv(sides).transpose(0, 2, 1), np.abs(np.linalg.det(sides)) / 6.0
