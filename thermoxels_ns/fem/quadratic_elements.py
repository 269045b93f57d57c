"""Matrices of quadratic tetrahedra (P2), row by row.

Local nodes 0 to 3 are the corners with phi_i = l_i (2 l_i - 1), 4 to 9 the middles of `TET_EDGES` with
phi_ij = 4 l_i l_j, l being the four linear shape functions. Edges are straight, so that the gradients of l are constant
and every entry of an element's matrix is a fixed combination of the six couplings of P1.

"""

from __future__ import annotations

from functools import lru_cache
from math import factorial

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.edge_midpoints import FACET_EDGES, TET_EDGES

_ANGLE_ROUND_OFF = 16.0 * np.finfo(np.float64).eps
"""Round-off of the cosine of an angle per largest coordinate over the tetrahedron's size; an estimate from above."""


def stiffness_matrix(
    points_m: npt.NDArray[np.float64],
    tets: npt.NDArray[np.int64],
    nodes: npt.NDArray[np.int64],
    conductivity_w_mk: float | npt.NDArray[np.float64],
    num_nodes: int,
) -> sparse.csr_matrix:
    """Assemble entries k * integral(grad phi_i . grad phi_j), symmetric bit for bit, shape (n, n), [W / K].

    As in P1, an angle between faces that is right up to round-off counts as right, and entries that are 0 are left out.

    Args:
        points_m: Corners of the tetrahedra, shape (v, 3), [m].
        tets: Their numbers, shape (t, 4), positively oriented and not flat.
        nodes: Numbers of all ten nodes, shape (t, 10).
        conductivity_w_mk: Thermal conductivity, [W / (m K)], one for all or one per tetrahedron, shape (t,).
        num_nodes: n.
    """
    points = np.ascontiguousarray(points_m, np.float64)
    conductivity = np.ascontiguousarray(np.broadcast_to(conductivity_w_mk, len(tets)), np.float64)
    coupling = np.empty((len(tets), 6))
    reach = float(np.max(np.abs(points), initial=0.0))
    _couplings(points, np.ascontiguousarray(tets, np.int64), conductivity, reach * _ANGLE_ROUND_OFF, coupling)
    return _rows(nodes, coupling, _stiffness_table(), num_nodes)


def mass_matrix(
    nodes: npt.NDArray[np.int64], capacity_j_k: npt.NDArray[np.float64], num_nodes: int
) -> sparse.csr_matrix:
    """Assemble entries rho c * integral(phi_i phi_j), symmetric bit for bit, shape (n, n), [J / K].

    Args:
        nodes: Numbers of all ten nodes, shape (t, 10).
        capacity_j_k: Heat capacity of each tetrahedron, rho c V, shape (t,), [J / K].
        num_nodes: n.
    """
    return _rows(nodes, capacity_j_k[:, None], mass_table()[:, :, None], num_nodes)


def edge_shapes(barycentric: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Values of the shape functions of a quadratic triangle or tetrahedron at points, corners first, shape (q, m).

    >>> edge_shapes(np.array([[0.5, 0.5, 0.0]])).tolist()
    [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]]
    """
    ends = FACET_EDGES if barycentric.shape[1] == 3 else TET_EDGES
    corners = barycentric * (2.0 * barycentric - 1.0)
    return np.concatenate([corners, 4.0 * barycentric[:, ends[:, 0]] * barycentric[:, ends[:, 1]]], axis=1) + 0.0


@lru_cache
def mass_table() -> npt.NDArray[np.float64]:
    """Means of phi_i phi_j over a tetrahedron, shape (10, 10)."""
    shapes = [_corner(i) for i in range(4)] + [{_power(i, j): 4.0} for i, j in TET_EDGES.tolist()]
    return np.array([[_mean_of_product(first, second) for second in shapes] for first in shapes])


def _power(*variables: int) -> tuple[int, ...]:
    """Exponents of a product of the four linear shape functions."""
    return tuple(variables.count(i) for i in range(4))


def _corner(i: int) -> dict[tuple[int, ...], float]:
    return {_power(i, i): 2.0, _power(i): -1.0}


def _mean_of_product(first: dict[tuple[int, ...], float], second: dict[tuple[int, ...], float]) -> float:
    """Mean over a tetrahedron, by integral(l^a) = V 3! a! / (|a| + 3)!."""
    total = 0.0
    for one, weight in first.items():
        for other, factor in second.items():
            powers = [p + q for p, q in zip(one, other)]
            share = 6.0 / factorial(sum(powers) + 3)
            for power in powers:
                share *= factorial(power)
            total += weight * factor * share
    return total


@lru_cache
def _stiffness_table() -> npt.NDArray[np.float64]:
    """Multiples of the couplings of P1 in each entry, shape (10, 10, 6).

    With g_ab = grad l_a . grad l_b, an entry is the sum over a and b of mean(d phi_i / d l_a  d phi_j / d l_b) g_ab,
    and g_aa is minus the sum of the other g_ab.
    """
    # d phi / d l_a as {exponents: factor}.
    slopes: list[list[dict[tuple[int, ...], float]]] = []
    for i in range(4):
        slopes.append([{_power(i): 4.0, _power(): -1.0} if a == i else {} for a in range(4)])
    for i, j in TET_EDGES.tolist():
        slopes.append([{_power(j): 4.0} if a == i else {_power(i): 4.0} if a == j else {} for a in range(4)])
    table = np.zeros((10, 10, 6))
    for i in range(10):
        for j in range(10):
            means = np.array([[_mean_of_product(slopes[i][a], slopes[j][b]) for b in range(4)] for a in range(4)])
            for edge, (a, b) in enumerate(TET_EDGES):
                table[i, j, edge] = means[a, b] + means[b, a] - means[a, a] - means[b, b]
    return np.round(table, 12)


def _rows(
    nodes: npt.NDArray[np.int64],
    values: npt.NDArray[np.float64],
    table: npt.NDArray[np.float64],
    num_nodes: int,
) -> sparse.csr_matrix:
    """Add up element matrices: entry (i, j) of element t is the sum over m of values[t, m] table[i, j, m]."""
    nodes = np.ascontiguousarray(nodes, np.int64)
    first = np.zeros(num_nodes + 1, np.int64)
    member = np.empty(nodes.size, np.int64)
    _members(nodes, first, member)
    place = np.full(num_nodes, -1, np.int64)
    start = np.zeros(num_nodes + 1, np.int32)
    _count(nodes, first, member, place, start)
    columns, entries = np.empty(start[-1], np.int32), np.zeros(start[-1])
    place[:] = -1
    _fill(nodes, first, member, place, start, np.ascontiguousarray(values), table, columns, entries)
    matrix = sparse.csr_matrix((entries, columns, start), shape=(num_nodes, num_nodes))
    matrix.eliminate_zeros()
    matrix.sort_indices()
    return matrix


@kernel
def _couplings(points, tets, conductivity, right, coupling):
    """k V grad l_a . grad l_b for the six edges of each tetrahedron."""
    side, normal = np.empty((3, 3)), np.empty((4, 3))
    for t in range(len(tets)):
        size = 0.0
        for i in range(3):
            for x in range(3):
                side[i, x] = points[tets[t, i + 1], x] - points[tets[t, 0], x]
                size = max(size, abs(side[i, x]))
        # In units of the size, so that nothing over- or underflows.
        for i in range(3):
            for x in range(3):
                side[i, x] /= size
        for i in range(3):
            u, v = side[(i + 1) % 3], side[(i + 2) % 3]
            normal[i + 1, 0] = u[1] * v[2] - u[2] * v[1]
            normal[i + 1, 1] = u[2] * v[0] - u[0] * v[2]
            normal[i + 1, 2] = u[0] * v[1] - u[1] * v[0]
        for x in range(3):
            normal[0, x] = -normal[1, x] - normal[2, x] - normal[3, x]
        six_volumes = side[0, 0] * normal[1, 0] + side[0, 1] * normal[1, 1] + side[0, 2] * normal[1, 2]
        factor = conductivity[t] * size / (6.0 * six_volumes)
        edge = 0
        for i in range(3):
            for j in range(i + 1, 4):
                product = first = second = 0.0
                for x in range(3):
                    product += normal[i, x] * normal[j, x]
                    first += normal[i, x] ** 2
                    second += normal[j, x] ** 2
                is_right = abs(product) <= right / size * min(first, second)
                coupling[t, edge] = 0.0 if is_right else factor * product
                edge += 1


@kernel
def _members(nodes, first, member):
    """Elements that have each node, as 10 t + local number."""
    width = nodes.shape[1]
    for t in range(len(nodes)):
        for i in range(width):
            first[nodes[t, i] + 1] += 1
    for node in range(len(first) - 1):
        first[node + 1] += first[node]
    # Filled from behind: afterwards each node's place is back at its beginning.
    filled = first[1:].copy()
    for t in range(len(nodes) - 1, -1, -1):
        for i in range(width):
            node = nodes[t, i]
            filled[node] -= 1
            member[filled[node]] = width * t + i


@kernel
def _count(nodes, first, member, place, start):
    width = nodes.shape[1]
    for node in range(len(first) - 1):
        count = 0
        for k in range(first[node], first[node + 1]):
            t = member[k] // width
            for j in range(width):
                if place[nodes[t, j]] != node:
                    place[nodes[t, j]] = node
                    count += 1
        start[node + 1] = start[node] + count


@kernel
def _fill(nodes, first, member, place, start, values, table, columns, entries):
    width = nodes.shape[1]
    for node in range(len(first) - 1):
        kept = np.int64(start[node])
        for k in range(first[node], first[node + 1]):
            t, i = member[k] // width, member[k] % width
            for j in range(width):
                other = nodes[t, j]
                # Places of earlier rows lie before this row's.
                if place[other] < start[node]:
                    place[other] = kept
                    columns[kept] = other
                    kept += 1
                total = 0.0
                for m in range(values.shape[1]):
                    total += values[t, m] * table[i, j, m]
                entries[place[other]] += total
