"""Quadratic tetrahedra (P2): a second kind of unknown in the middle of every edge."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.fem.edge_midpoints import FACET_EDGES, TET_EDGES, edge_numbers, midpoints
from thermoxels_ns.fem.linear_space import SIX_POINTS, FacetRule, LinearSpace, sums_by_number
from thermoxels_ns.fem.quadratic_elements import edge_shapes, mass_matrix, stiffness_matrix
from thermoxels_ns.fem.quantities import Places
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.sparsity import mesh_edges

_QUADRATIC_SIX_POINTS = FacetRule(edge_shapes(SIX_POINTS.shapes), SIX_POINTS.weights)
"""The same points as in P1; of products of quadratic functions they are exact too."""
_FOUR_POINTS = (5.0 - np.sqrt(5.0)) / 20.0 + np.eye(4) / np.sqrt(5.0)
"""Points of a tetrahedron whose mean integrates polynomials of degree 2 exactly (Hammer and Stroud 1956): what a source
is integrated with, so that the error of the temperature falls with the cube of the mesh size."""


class QuadraticSpace(LinearSpace):
    """The unknowns of `LinearSpace` and one more per edge: temperatures are quadratic in each tetrahedron.

    Boundary values are asked once per triangle, as in P1: where they vary within one, the error falls with the square
    of the mesh size only. The space is for steady states. Lumping its mass would give the corners negative masses, and
    with the consistent mass temperatures leave their range in steps below about h^2 / diffusivity, so that it is not
    offered in time.
    """

    def __init__(self, selection: Selection) -> None:
        """Number the edges.

        Args:
            selection: The mesh and its parts.
        """
        super().__init__(selection, lumped=False, lumped_boundary=False)
        mesh = selection.mesh
        self._num_corners = len(mesh.points_m)
        self._edges = mesh_edges(mesh.tets, self._num_corners)
        self._middles = edge_numbers(self._edges, mesh.tets, TET_EDGES)
        self.rule = _QUADRATIC_SIX_POINTS

    @property
    def num_nodes(self) -> int:
        """Number of unknowns: the mesh's nodes, then its edges."""
        return self._num_corners + len(self._edges.other)

    @property
    def points_m(self) -> npt.NDArray[np.float64]:
        """Positions of the unknowns, shape (n, 3), [m]."""
        return self.from_mesh_nodes(self.selection.mesh.points_m)

    def from_mesh_nodes(self, nodal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Interpolate what is linear between the mesh's nodes, shape (n, ...)."""
        return np.concatenate([nodal, midpoints(self._edges, nodal)])

    def prolongation(self) -> sparse.csr_matrix:
        """Give `from_mesh_nodes` as a matrix, shape (n, v)."""
        corners, edges = self._num_corners, len(self._edges.other)
        ends = np.stack([self._edges.smaller_nodes(), self._edges.other], axis=1)
        columns = np.concatenate([np.arange(corners), ends.ravel()])
        starts = np.concatenate([np.arange(corners), corners + 2 * np.arange(edges + 1)])
        weights = np.repeat([1.0, 0.5], [corners, 2 * edges])
        return sparse.csr_matrix((weights, columns, starts), shape=(corners + edges, corners))

    def tet_nodes(self) -> npt.NDArray[np.int64]:
        """Corners of each tetrahedron, then the middles of its edges, shape (t, 10)."""
        return np.concatenate([self.selection.mesh.tets, self._num_corners + self._middles], axis=1)

    def stiffness(self, conductivity_w_mk: float | npt.NDArray[np.float64]) -> sparse.csr_matrix:
        """K, entries integral(k grad phi_i . grad phi_j), shape (n, n), [W / K]."""
        mesh = self.selection.mesh
        return stiffness_matrix(mesh.points_m, mesh.tets, self.tet_nodes(), conductivity_w_mk, self.num_nodes)

    def mass(
        self, heat_capacity_j_m3k: float | npt.NDArray[np.float64]
    ) -> tuple[sparse.csr_matrix | None, npt.NDArray[np.float64]]:
        """M, entries integral(rho c phi_i phi_j), and its row sums, which are negative at corners, [J / K]."""
        capacity = heat_capacity_j_m3k * self.tet_volumes_m3(np.arange(len(self._middles)))
        matrix = mass_matrix(self.tet_nodes(), capacity, self.num_nodes)
        return matrix, matrix @ np.ones(self.num_nodes)

    def facet_nodes(self, facets: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Nodes of boundary triangles, corners first, shape (k, 6)."""
        corners = self.selection.mesh.facets[facets]
        return np.concatenate([corners, self._num_corners + edge_numbers(self._edges, corners, FACET_EDGES)], axis=1)

    def source_points(self, tets: npt.NDArray[np.int64]) -> tuple[Places, npt.NDArray[np.float64]]:
        """Places where sources in tetrahedra are asked, those of one after the other, and the volume of each, [m3]."""
        corners = self.selection.mesh.points_m[self.selection.mesh.tets[tets]]
        points = np.einsum("qa,tai->tqi", _FOUR_POINTS, corners).reshape(-1, 3)
        volumes = np.repeat(self.tet_volumes_m3(tets) / len(_FOUR_POINTS), len(_FOUR_POINTS))
        return Places(points, np.zeros_like(points), self.selection.up), volumes

    def source_load(self, tets: npt.NDArray[np.int64], point_w: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Spread heat at the points of `source_points` over the nodes, shape (n,), [W]."""
        shares = point_w.reshape(-1, len(_FOUR_POINTS)) @ edge_shapes(_FOUR_POINTS)
        return sums_by_number(self.tet_nodes()[tets].ravel(), shares.ravel(), self.num_nodes)

    def tet_load(self, tets: npt.NDArray[np.int64], heat_w: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Spread heat that is even in each tetrahedron over the nodes: -1/20 to a corner, 1/5 to an edge; [W]."""
        nodes = self.tet_nodes()[tets]
        shares = heat_w[:, None] * np.repeat([-0.05, 0.2], [4, 6])
        return sums_by_number(nodes.ravel(), shares.ravel(), self.num_nodes)
