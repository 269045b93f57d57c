"""Conduction with a bubble on every edge beside the linear functions, without a matrix.

Linear functions l_i and bubbles b_ij = 4 l_i l_j together span what quadratic tetrahedra do (a hierarchical basis). So
the nodes' coefficients are those of linear tetrahedra, and what edges add is an estimate of what those lack.

Kernels are kept compiled by numba, which watches a kernel's own file: none may call one of another file.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from thermoxels_ns.fem.edge_midpoints import TET_EDGES
from thermoxels_ns.fem.problem import HeatProblem

Vector = npt.NDArray[np.float64]


class EdgeOperator:
    """Products with the stiffness K on nodes and edges; six couplings per tetrahedron are all that is kept."""

    def __init__(self, problem: HeatProblem, tet_edges: npt.NDArray[np.int64], num_edges: int) -> None:
        """Find the couplings of every tetrahedron.

        Args:
            problem: Body and materials.
            tet_edges: Numbers of the edges of each tetrahedron, in the order of `TET_EDGES`, shape (t, 6).
            num_edges: Number of edges of the mesh.
        """
        mesh = problem.mesh
        self._tets = np.ascontiguousarray(mesh.tets, np.int64)
        self._edge = tet_edges.astype(np.int32)
        self._coupling = np.empty((len(mesh.tets), 6))
        """k V grad l_a . grad l_b by edge, [W / K]."""
        conductivity = np.ascontiguousarray(np.broadcast_to(problem.conductivity_w_mk, len(mesh.tets)), np.float64)
        _prepare(np.ascontiguousarray(mesh.points_m, np.float64), self._tets, conductivity, self._coupling)
        self._num_nodes, self._num_edges = len(mesh.points_m), num_edges

    def conducted(self, nodal: Vector, edge: Vector) -> tuple[Vector, Vector]:
        """K times coefficients of nodes, shape (n,), and edges, shape (e,), [W]."""
        at_nodes, at_edges = np.zeros(self._num_nodes), np.zeros(self._num_edges)
        _conducted(self._tets, self._edge, self._coupling, nodal, edge, TET_EDGES, at_nodes, at_edges)
        return at_nodes, at_edges

    def conducted_to_edges(self, nodal: Vector) -> Vector:
        """Heat at the edges of linear temperatures, shape (e,), [W]: a third of the work of `conducted`."""
        at_edges = np.zeros(self._num_edges)
        _to_edges(self._tets, self._edge, self._coupling, nodal, TET_EDGES, at_edges)
        return at_edges

    def edge_diagonal(self) -> Vector:
        """Diagonal of K at edges, shape (e,), [W / K]."""
        diagonal = np.zeros(self._num_edges)
        _diagonal(self._edge, self._coupling, TET_EDGES, diagonal)
        return diagonal


@njit(nogil=True, cache=True, error_model="numpy")
def _prepare(points, tets, conductivity, coupling):
    side, normal = np.empty((3, 3)), np.empty((4, 3))
    for t in range(len(tets)):
        for i in range(3):
            for x in range(3):
                side[i, x] = points[tets[t, i + 1], x] - points[tets[t, 0], x]
        for i in range(3):
            u, v = side[(i + 1) % 3], side[(i + 2) % 3]
            normal[i + 1, 0] = u[1] * v[2] - u[2] * v[1]
            normal[i + 1, 1] = u[2] * v[0] - u[0] * v[2]
            normal[i + 1, 2] = u[0] * v[1] - u[1] * v[0]
        for x in range(3):
            normal[0, x] = -normal[1, x] - normal[2, x] - normal[3, x]
        six_volumes = side[0, 0] * normal[1, 0] + side[0, 1] * normal[1, 1] + side[0, 2] * normal[1, 2]
        factor = conductivity[t] / (6.0 * six_volumes)
        edge = 0
        for i in range(3):
            for j in range(i + 1, 4):
                product = 0.0
                for x in range(3):
                    product += normal[i, x] * normal[j, x]
                coupling[t, edge] = factor * product
                edge += 1


@njit(nogil=True, cache=True, error_model="numpy")
def _conducted(tets, edge_of, coupling, nodal, edge, ends, at_nodes, at_edges):
    # grad T = sum over a of p_a grad l_a with p_a = c_a + 4 sum over j of e_aj l_j.
    g, mean, total = np.zeros((4, 4)), np.empty((4, 4)), np.empty(4)
    for t in range(len(tets)):
        for a in range(4):
            g[a, a] = 0.0
            total[a] = 0.0
            for i in range(4):
                mean[a, i] = 0.0
        for k in range(6):
            a, b = ends[k, 0], ends[k, 1]
            g[a, b] = g[b, a] = coupling[t, k]
            g[a, a] -= coupling[t, k]
            g[b, b] -= coupling[t, k]
            bubble = edge[edge_of[t, k]]
            total[a] += bubble
            total[b] += bubble
            mean[a, b] = mean[b, a] = 0.2 * bubble
        for a in range(4):
            corner = nodal[tets[t, a]]
            for i in range(4):
                # The mean of p_a l_i.
                mean[a, i] += 0.25 * corner + 0.2 * total[a]
            total[a] += corner
        for i in range(4):
            heat = 0.0
            for a in range(4):
                heat += g[a, i] * total[a]
            at_nodes[tets[t, i]] += heat
        for k in range(6):
            i, j = ends[k, 0], ends[k, 1]
            heat = 0.0
            for a in range(4):
                heat += g[a, j] * mean[a, i] + g[a, i] * mean[a, j]
            at_edges[edge_of[t, k]] += 4.0 * heat


@njit(nogil=True, cache=True, error_model="numpy")
def _to_edges(tets, edge_of, coupling, nodal, ends, at_edges):
    flow = np.empty(4)
    for t in range(len(tets)):
        flow[:] = 0.0
        for k in range(6):
            a, b = ends[k, 0], ends[k, 1]
            # From the row sums of 0: coupling times the difference.
            heat = coupling[t, k] * (nodal[tets[t, b]] - nodal[tets[t, a]])
            flow[a] += heat
            flow[b] -= heat
        for k in range(6):
            at_edges[edge_of[t, k]] += flow[ends[k, 0]] + flow[ends[k, 1]]


@njit(nogil=True, cache=True, error_model="numpy")
def _diagonal(edge_of, coupling, ends, diagonal):
    own = np.empty(4)
    for t in range(len(edge_of)):
        own[:] = 0.0
        for k in range(6):
            own[ends[k, 0]] -= coupling[t, k]
            own[ends[k, 1]] -= coupling[t, k]
        for k in range(6):
            diagonal[edge_of[t, k]] += 1.6 * (own[ends[k, 0]] + own[ends[k, 1]] + coupling[t, k])
