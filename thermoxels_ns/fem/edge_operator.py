"""Conduction with a bubble on every edge beside the linear functions, without a matrix.

Linear functions l_i and bubbles b_ij = 4 l_i l_j together span what quadratic tetrahedra do (a hierarchical basis). So
the nodes' coefficients are those of linear tetrahedra, and what edges add is an estimate of what those lack.

"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel
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
        _conducted(self._tets, self._edge, self._coupling, nodal, edge, at_nodes, at_edges)
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


@kernel
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


@kernel
def _conducted(tets, edge_of, coupling, nodal, edge, at_nodes, at_edges):
    # grad T = sum over a of p_a grad l_a with p_a = c_a + 4 sum over j of e_aj l_j. Means over a tetrahedron: 1/4 of
    # l_i, 1/10 of l_i l_i and 1/20 of l_i l_j. With t_a = sum over j of e_aj, q_i = sum over a of g_ai t_a and n_i the
    # same of c, node i has q_i + n_i, and edge ij 0.8 (q_i + q_j + sum over a of g_ai e_aj + g_aj e_ai) + n_i + n_j.
    for t in range(len(tets)):
        g01, g02, g03 = coupling[t, 0], coupling[t, 1], coupling[t, 2]
        g12, g13, g23 = coupling[t, 3], coupling[t, 4], coupling[t, 5]
        e01, e02, e03 = edge[edge_of[t, 0]], edge[edge_of[t, 1]], edge[edge_of[t, 2]]
        e12, e13, e23 = edge[edge_of[t, 3]], edge[edge_of[t, 4]], edge[edge_of[t, 5]]
        c0, c1, c2, c3 = nodal[tets[t, 0]], nodal[tets[t, 1]], nodal[tets[t, 2]], nodal[tets[t, 3]]
        t0, t1, t2, t3 = e01 + e02 + e03, e01 + e12 + e13, e02 + e12 + e23, e03 + e13 + e23
        # From the row sums of 0: couplings times differences.
        q0 = g01 * (t1 - t0) + g02 * (t2 - t0) + g03 * (t3 - t0)
        q1 = g01 * (t0 - t1) + g12 * (t2 - t1) + g13 * (t3 - t1)
        q2 = g02 * (t0 - t2) + g12 * (t1 - t2) + g23 * (t3 - t2)
        q3 = g03 * (t0 - t3) + g13 * (t1 - t3) + g23 * (t2 - t3)
        n0 = g01 * (c1 - c0) + g02 * (c2 - c0) + g03 * (c3 - c0)
        n1 = g01 * (c0 - c1) + g12 * (c2 - c1) + g13 * (c3 - c1)
        n2 = g02 * (c0 - c2) + g12 * (c1 - c2) + g23 * (c3 - c2)
        n3 = g03 * (c0 - c3) + g13 * (c1 - c3) + g23 * (c2 - c3)
        at_nodes[tets[t, 0]] += q0 + n0
        at_nodes[tets[t, 1]] += q1 + n1
        at_nodes[tets[t, 2]] += q2 + n2
        at_nodes[tets[t, 3]] += q3 + n3
        g0, g1, g2, g3 = -g01 - g02 - g03, -g01 - g12 - g13, -g02 - g12 - g23, -g03 - g13 - g23
        s01 = (g0 + g1) * e01 + g12 * e02 + g02 * e12 + g13 * e03 + g03 * e13
        s02 = (g0 + g2) * e02 + g12 * e01 + g01 * e12 + g23 * e03 + g03 * e23
        s03 = (g0 + g3) * e03 + g13 * e01 + g01 * e13 + g23 * e02 + g02 * e23
        s12 = (g1 + g2) * e12 + g02 * e01 + g01 * e02 + g23 * e13 + g13 * e23
        s13 = (g1 + g3) * e13 + g03 * e01 + g01 * e03 + g23 * e12 + g12 * e23
        s23 = (g2 + g3) * e23 + g03 * e02 + g02 * e03 + g13 * e12 + g12 * e13
        at_edges[edge_of[t, 0]] += 0.8 * (q0 + q1 + s01) + n0 + n1
        at_edges[edge_of[t, 1]] += 0.8 * (q0 + q2 + s02) + n0 + n2
        at_edges[edge_of[t, 2]] += 0.8 * (q0 + q3 + s03) + n0 + n3
        at_edges[edge_of[t, 3]] += 0.8 * (q1 + q2 + s12) + n1 + n2
        at_edges[edge_of[t, 4]] += 0.8 * (q1 + q3 + s13) + n1 + n3
        at_edges[edge_of[t, 5]] += 0.8 * (q2 + q3 + s23) + n2 + n3


@kernel
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


@kernel
def _diagonal(edge_of, coupling, ends, diagonal):
    own = np.empty(4)
    for t in range(len(edge_of)):
        own[:] = 0.0
        for k in range(6):
            own[ends[k, 0]] -= coupling[t, k]
            own[ends[k, 1]] -= coupling[t, k]
        for k in range(6):
            diagonal[edge_of[t, k]] += 1.6 * (own[ends[k, 0]] + own[ends[k, 1]] + coupling[t, k])
