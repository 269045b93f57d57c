"""Errors of linear tetrahedra from recovered gradients, without a second mesh or order."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.linear_solver import LinearSolver
from thermoxels_ns.fem.p1_kernels import TET_EDGES, _cross, _dot, _sides
from thermoxels_ns.fem.solution import ErrorSize, SteadySolution, share_of_heat
from thermoxels_ns.fem.space import sums_by_number
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

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
