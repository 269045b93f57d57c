"""Errors of heat solutions: from one solution of linear tetrahedra, or two solutions (Richardson) and their fluxes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.linear_solver import LinearSolver
from thermoxels_ns.fem.p1_kernels import TET_EDGES, _cross, _dot, _sides
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import ErrorSize, Solution, SteadySolution, mean_flows_w, share_of_heat
from thermoxels_ns.fem.space import Space, sums_by_number
from thermoxels_ns.fem.system import HeatSystem

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
_SHARPENINGS = 3  # Corrections of the recovered gradient, which without them lags by half an element at surfaces
_TOLERANCE = 1e-2  # Relative tolerance of the linear solver: a percent of an estimate
_EQUAL = 1e-9
"""Given temperatures that differ by less than this share of all differences are even: T does not curve between them."""
_LEFT = 0.3
"""Share of a heat flow's error that is left after the mesh size is halved: 1/4 where temperatures are smooth, 0.4 at a
notch."""


def p1_error(system: HeatSystem, solution: SteadySolution, time_s: float) -> ErrorSize | None:
    """Estimate the errors of a steady state of lumped linear tetrahedra from its own recovered gradients.

    Means G of the gradient around each node, in every region apart (Zienkiewicz and Zhu 1987), tell how the temperature
    curves: in the middle of an edge e from i to j quadratic tetrahedra would exceed the mean of both ends by b = (G_i -
    G_j) . e / 8. With b known, the equations of quadratic tetrahedra become one system for the error c of the nodes,

        (K + R) c = load - (K + R) T - integral(k grad b . grad phi) - integral(h (T + b) phi) + the lumped h T,

    with radiation's slope in h. The flows of T + b + c less those of T are the errors of flows. Where temperatures are
    singular b is not all that is missed, only what half the mesh size would find, 1 - 0.3 of it (Richardson).

    Where two materials side by side touch one air, nodes that they share have one temperature, and the film heats half
    a cell of the one material as if it were the other. The temperature of its own falls within k / h of the edge, as
    exp(-h x / k): what the film brings beyond that is counted as missed.

    Where sources act the error is at least s h^2 / (16 k), half of what a source bends the temperature in a tetrahedron
    of the extent h along its gradient; what leaves at once through the surface beside it is not in s.

    Effects that change are taken at `time_s`. None where the estimates are no numbers.
    """
    problem, fixed, num_nodes = system.problem, system.fixed, system.num_nodes
    points, tets = np.ascontiguousarray(problem.mesh.points_m), problem.mesh.tets
    relative_k = solution.temperature_c - system.reference_c
    place = problem.mesh.region.astype(np.int64) * num_nodes
    conductivity = np.broadcast_to(np.asarray(problem.conductivity_w_mk, np.float64), len(tets)).copy()
    even, level_k = np.zeros(num_nodes, dtype=bool), _EQUAL * float(np.ptp(relative_k))
    even[fixed.nodes] = True
    with np.errstate(all="ignore"):
        gradient, volumes_m3 = _recovered(points, tets, place, relative_k)
        bent_w = np.zeros(num_nodes)
        _add_bubbles(points, tets, place, gradient, conductivity, relative_k, even, level_k, TET_EDGES, bent_w)
        shared, surfaces = np.count_nonzero(volumes_m3, axis=0) > 1, []
        of_region = np.zeros(len(volumes_m3))
        of_region[problem.mesh.region] = conductivity
        for form in system.surface_forms:
            nodes = form.nodes
            strength = form.basis.dx.sum(axis=1) * form.slope_w_m2k(relative_k, time_s).mean(axis=1)
            # The gradient of the material behind each triangle: nodes that two share have one in each.
            region = volumes_m3[:, nodes].min(axis=2).argmax(axis=0)
            behind = region[:, None] * num_nodes + nodes
            bubble_k = np.empty(nodes.shape)
            for corner in range(3):
                i, j = nodes[:, corner - 2], nodes[:, corner - 1]
                turn = gradient[behind[:, corner - 2]] - gradient[behind[:, corner - 1]]
                bubble_k[:, corner] = np.sum(turn * (points[j] - points[i]), axis=1) / 8.0
                bubble_k[even[i] & even[j] & (np.abs(relative_k[i] - relative_k[j]) <= level_k), corner] = 0.0
            thin = strength * np.sqrt(2.0 / form.basis.dx.sum(axis=1)) / of_region[region]  # a cell's width over k / h
            own = ~shared[nodes]
            jumps = np.where(own.all(axis=1), 0.0, np.fmax(1.0 + 2.0 * np.expm1(-thin) / thin, 0.0))[:, None]
            count = np.maximum(own.sum(axis=1, keepdims=True), 1)
            own_k = np.where(own, relative_k[nodes], 0.0).sum(axis=1, keepdims=True) / count
            beyond_k = np.where(own | ~own.any(axis=1, keepdims=True), 0.0, jumps * (own_k - relative_k[nodes]) / 3.0)
            bubble_k *= 1.0 - jumps
            lumping_k = relative_k[nodes].mean(axis=1, keepdims=True) - relative_k[nodes]
            around_k = lumping_k / 4.0 + (2.0 * bubble_k.sum(axis=1, keepdims=True) - bubble_k) / 15.0 + beyond_k
            bent_w += sums_by_number(nodes.ravel(), (strength[:, None] * around_k).ravel(), num_nodes)
            surfaces.append((form.effect, nodes, strength, bubble_k.mean(axis=1) + beyond_k.sum(axis=1)))
        matrix = system.matrix(time_s, np.inf)
        if system.nonlinear:
            matrix = sparse.csr_matrix(matrix + system.radiation_slope(relative_k, time_s))
        free, error_k = fixed.free, np.zeros(num_nodes)
        rest_w = system.net_heat(relative_k, time_s) - bent_w
        inner = matrix if len(free) == num_nodes else sparse.csr_matrix(matrix[free][:, free])
        error_k[free] = LinearSolver(inner, relative_tolerance=_TOLERANCE).solve(rest_w[free]).x
        missed_w = {heat.effect: 0.0 for heat in solution.effects}
        for effect, nodes, strength, between_k in surfaces:
            missed_w[effect] -= float(np.sum(strength * (error_k[nodes].mean(axis=1) + between_k)))
        kept_w = fixed.shares @ (matrix @ error_k + bent_w)[fixed.nodes]
        for (effect, _), heat_w in zip(fixed.groups, kept_w):
            missed_w[effect] += float(heat_w)
        largest_w = max(map(abs, missed_w.values()), default=0.0) / (1.0 - _LEFT)
        largest_k = float(np.max(np.abs(error_k)))
        kept_w = np.abs(system.exchanged_heat(relative_k, time_s)) if system.sources else np.zeros(0)
        for form in system.sources:
            inside = tets[form.term.tets]
            slope = gradient[place[form.term.tets, None] + inside].mean(axis=1)
            along = np.square(np.ptp(relative_k[inside], axis=1)) / np.sum(np.square(slope), axis=1)
            square_m2 = np.fmin(along, np.sum(np.square(np.ptp(points[inside], axis=1)), axis=1))
            volumes_m3 = system.space.tet_volumes_m3(np.arange(len(tets)))
            volume_m3 = sums_by_number(tets.ravel(), np.repeat(volumes_m3, 4), num_nodes)
            density_w_m3 = np.fmin(form.mean_w_m3(time_s), (4.0 * kept_w / volume_m3)[inside].mean(axis=1))
            curved_k = density_w_m3 * square_m2 / (16.0 * conductivity[form.term.tets])
            largest_k = max(largest_k, float(np.max(curved_k)))
        found = ErrorSize(largest_k, share_of_heat(largest_w, solution))
    return found if np.isfinite(found.temperature_k + found.heat_flow) else None


def _recovered(
    points: Vector, tets: npt.NDArray[np.int64], place: npt.NDArray[np.int64], values: Vector
) -> tuple[Vector, Vector]:
    """Gradient at each node of each region, shape (r * n, 3), [K / m], and its tetrahedra there, shape (r, n), [m3]."""
    size = (int(place.max()) // len(points) + 1) * len(points)
    gradient, volumes, nodal = np.empty((len(tets), 3)), np.empty(len(tets)), np.zeros((size, 3))
    _gradients(points, tets, values, gradient, volumes)
    total = np.zeros((size, 4))
    for _ in range(1 + _SHARPENINGS):
        total[:] = 0.0
        _add_defects(tets, place, gradient, volumes, nodal, total)
        nodal += total[:, :3] / np.maximum(total[:, 3:], np.finfo(np.float64).tiny)
    return nodal, total[:, 3].reshape(-1, len(points))


@kernel
def _gradients(points, tets, values, gradient, volumes):
    for t in range(len(tets)):
        tet = tets[t]
        a, b, c = _sides(points, tet, 1.0)
        n1, n2, n3 = _cross(b, c), _cross(c, a), _cross(a, b)
        six_volumes, start = _dot(a, n1), values[tet[0]]
        u, v, w = values[tet[1]] - start, values[tet[2]] - start, values[tet[3]] - start
        volumes[t] = six_volumes / 6.0
        for x in range(3):
            gradient[t, x] = (u * n1[x] + v * n2[x] + w * n3[x]) / six_volumes


@kernel
def _add_defects(tets, place, gradient, volumes, nodal, total):
    """Adds up volumes and, times volume, what gradients differ from the means of their corners."""
    for t in range(len(tets)):
        for x in range(3):
            mean = 0.0
            for i in range(4):
                mean += 0.25 * nodal[place[t] + tets[t, i], x]
            for i in range(4):
                total[place[t] + tets[t, i], x] += volumes[t] * (gradient[t, x] - mean)
        for i in range(4):
            total[place[t] + tets[t, i], 3] += volumes[t]


@kernel
def _add_bubbles(points, tets, place, nodal, conductivity, values, even, level, edges, heat):
    """Adds integral(k grad b . grad phi); a bubble of 1 in the middle of an edge is 4 phi_i phi_j."""
    slope, bend = np.empty((4, 3)), np.empty(3)
    for t in range(len(tets)):
        tet = tets[t]
        a, b, c = _sides(points, tet, 1.0)
        normals = (_cross(b, c), _cross(c, a), _cross(a, b))
        six_volumes = _dot(a, normals[0])
        for x in range(3):
            for i in range(3):
                slope[i + 1, x] = normals[i][x] / six_volumes
            slope[0, x] = -slope[1, x] - slope[2, x] - slope[3, x]
            bend[x] = 0.0
        for e in range(6):
            i, j = edges[e, 0], edges[e, 1]
            if even[tet[i]] and even[tet[j]] and abs(values[tet[i]] - values[tet[j]]) <= level:
                continue
            bubble = 0.0
            for x in range(3):
                turn = nodal[place[t] + tet[i], x] - nodal[place[t] + tet[j], x]
                bubble += turn * (points[tet[j], x] - points[tet[i], x]) / 8.0
            for x in range(3):
                bend[x] += bubble * (slope[i, x] + slope[j, x])
        for i in range(4):
            heat[tet[i]] += conductivity[t] * six_volumes / 6.0 * _dot(bend, slope[i])


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
