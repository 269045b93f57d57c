"""How far the gradient of a temperature is from its own mean around each node, tetrahedron by tetrahedron."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.edge_midpoints import TET_EDGES
from thermoxels_ns.fem.quadratic_elements import mass_table
from thermoxels_ns.mesh.tetrahedra import TetMesh

_LINEAR_MEANS = (np.ones((4, 4)) + np.eye(4)) / 20.0


def gradient_defect(
    points_m: npt.NDArray[np.float64],
    tets: npt.NDArray[np.int64],
    nodes: npt.NDArray[np.int64],
    nodal_k: npt.NDArray[np.float64],
    group: npt.NDArray[np.int64],
) -> npt.NDArray[np.float64]:
    """Integrate |grad T - G|^2, G being what interpolates the means of grad T over the tetrahedra around each node.

    Means are weighted by volume and taken over each group of tetrahedra apart, because gradients jump where the
    conductivity does.

    Args:
        points_m: Corners, shape (v, 3), [m].
        tets: Their numbers, shape (t, 4).
        nodes: Numbers of all nodes of the tetrahedra, shape (t, 4) if temperatures are linear, (t, 10) if quadratic.
        nodal_k: Temperatures, shape (n,), [K].
        group: Number of each tetrahedron's group, from 0, shape (t,).

    Returns:
        One integral per tetrahedron, shape (t,), [K2 m].
    """
    defect = np.zeros(len(tets))
    by_group, ends = _groups(group)
    means = _LINEAR_MEANS if nodes.shape[1] == 4 else mass_table()
    _defect(
        np.ascontiguousarray(points_m, np.float64),
        np.ascontiguousarray(tets, np.int64),
        np.ascontiguousarray(nodes, np.int64),
        np.ascontiguousarray(nodal_k, np.float64),
        by_group,
        ends,
        TET_EDGES,
        means,
        defect,
    )
    return defect


def curvature_k(mesh: TetMesh, temperature_c: npt.NDArray[np.float64]) -> float:
    """Estimate roughly what temperatures of linear tetrahedra miss by being straight, [K].

    That is a quarter of the size of a tetrahedron times how far its gradient is from that of its surroundings, the
    largest of all.

    Args:
        mesh: The mesh.
        temperature_c: Temperatures of its nodes, one row per time, shape (s, n).
    """
    by_group, ends = _groups(mesh.region)
    points, tets = np.ascontiguousarray(mesh.points_m, np.float64), np.ascontiguousarray(mesh.tets, np.int64)
    return float(_largest_curvature(points, tets, np.ascontiguousarray(temperature_c, np.float64), by_group, ends))


def _groups(group: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Tetrahedra in the order of their groups, and where each group ends."""
    return np.argsort(group, kind="stable"), np.concatenate([[0], np.cumsum(np.bincount(group))])


@kernel
def _gradients(points, tet, nodes, nodal, ends, slope, gradient):
    """Gradient at each node of a tetrahedron into `gradient`; returns the volume."""
    side = np.empty((3, 3))
    for i in range(3):
        for x in range(3):
            side[i, x] = points[tet[i + 1], x] - points[tet[0], x]
    for i in range(3):
        u, v = side[(i + 1) % 3], side[(i + 2) % 3]
        slope[i + 1, 0] = u[1] * v[2] - u[2] * v[1]
        slope[i + 1, 1] = u[2] * v[0] - u[0] * v[2]
        slope[i + 1, 2] = u[0] * v[1] - u[1] * v[0]
    six_volumes = side[0, 0] * slope[1, 0] + side[0, 1] * slope[1, 1] + side[0, 2] * slope[1, 2]
    for x in range(3):
        slope[0, x] = 0.0
        for i in range(1, 4):
            slope[i, x] /= six_volumes
            slope[0, x] -= slope[i, x]
    quadratic = len(nodes) == 10
    for corner in range(4):
        for x in range(3):
            gradient[corner, x] = 0.0
        for i in range(4):
            factor = 1.0
            if quadratic:
                factor = 3.0 if i == corner else -1.0
            for x in range(3):
                gradient[corner, x] += factor * nodal[nodes[i]] * slope[i, x]
    if quadratic:
        for j in range(6):
            a, b = ends[j, 0], ends[j, 1]
            for x in range(3):
                gradient[a, x] += 4.0 * nodal[nodes[4 + j]] * slope[b, x]
                gradient[b, x] += 4.0 * nodal[nodes[4 + j]] * slope[a, x]
        for j in range(6):
            for x in range(3):
                gradient[4 + j, x] = 0.5 * (gradient[ends[j, 0], x] + gradient[ends[j, 1], x])
    return six_volumes / 6.0


@kernel
def _defect(points, tets, nodes, nodal, by_group, group_ends, ends, means, defect):
    width = nodes.shape[1]
    total, weight = np.zeros((len(nodal), 3)), np.zeros(len(nodal))
    slope, gradient = np.empty((4, 3)), np.empty((width, 3))
    for group in range(len(group_ends) - 1):
        members = by_group[group_ends[group] : group_ends[group + 1]]
        for t in members:
            for i in range(width):
                weight[nodes[t, i]] = 0.0
                for x in range(3):
                    total[nodes[t, i], x] = 0.0
        for t in members:
            volume = _gradients(points, tets[t], nodes[t], nodal, ends, slope, gradient)
            for i in range(width):
                weight[nodes[t, i]] += volume
                for x in range(3):
                    total[nodes[t, i], x] += volume * gradient[i, x]
        for t in members:
            volume = _gradients(points, tets[t], nodes[t], nodal, ends, slope, gradient)
            square = 0.0
            for x in range(3):
                for i in range(width):
                    gradient[i, x] -= total[nodes[t, i], x] / weight[nodes[t, i]]
                for i in range(width):
                    for j in range(width):
                        square += means[i, j] * gradient[i, x] * gradient[j, x]
            defect[t] = volume * square


@kernel
def _largest_curvature(points, tets, states, by_group, group_ends):
    """`curvature_k`; in a tetrahedron where temperatures are linear, the integral of `_defect` is a short sum."""
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    gradient, volume, size = np.empty((len(tets), 3)), np.empty(len(tets)), np.empty(len(tets))
    side, normal = np.empty((3, 3)), np.empty((3, 3))
    largest = 0.0
    for row in range(len(states)):
        for group in range(len(group_ends) - 1):
            members = by_group[group_ends[group] : group_ends[group + 1]]
            for t in members:
                for i in range(4):
                    weight[tets[t, i]] = 0.0
                    for x in range(3):
                        total[tets[t, i], x] = 0.0
            for t in members:
                for i in range(3):
                    for x in range(3):
                        side[i, x] = points[tets[t, i + 1], x] - points[tets[t, 0], x]
                for i in range(3):
                    u, v = side[(i + 1) % 3], side[(i + 2) % 3]
                    normal[i, 0] = u[1] * v[2] - u[2] * v[1]
                    normal[i, 1] = u[2] * v[0] - u[0] * v[2]
                    normal[i, 2] = u[0] * v[1] - u[1] * v[0]
                six_volumes = side[0, 0] * normal[0, 0] + side[0, 1] * normal[0, 1] + side[0, 2] * normal[0, 2]
                volume[t] = six_volumes / 6.0
                if row == 0:
                    size[t] = abs(volume[t]) ** (1.0 / 3.0) / 4.0
                for x in range(3):
                    rise = 0.0
                    for i in range(3):
                        rise += (states[row, tets[t, i + 1]] - states[row, tets[t, 0]]) * normal[i, x]
                    gradient[t, x] = rise / six_volumes
                for i in range(4):
                    weight[tets[t, i]] += volume[t]
                    for x in range(3):
                        total[tets[t, i], x] += volume[t] * gradient[t, x]
            for t in members:
                square = 0.0
                for x in range(3):
                    together = apart = 0.0
                    for i in range(4):
                        part = gradient[t, x] - total[tets[t, i], x] / weight[tets[t, i]]
                        together += part
                        apart += part * part
                    square += (together * together + apart) / 20.0
                largest = max(largest, size[t] * math.sqrt(square))
    return largest
