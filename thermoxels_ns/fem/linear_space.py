"""Linear tetrahedra (P1): the nodes of a body and how what happens in it and on it becomes numbers on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.fem.assembly import assemble_stiffness
from thermoxels_ns.fem.elements import capacities
from thermoxels_ns.fem.quantities import Places
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.sparsity import MeshEdges, mesh_edges, symmetric_matrix


@dataclass(frozen=True)
class FacetRule:
    """Where on a boundary triangle integrals are evaluated."""

    shapes: npt.NDArray[np.float64]
    """Value of each of the triangle's shape functions at each point, shape (q, m)."""
    weights: npt.NDArray[np.float64]
    """Share of the area at each point, shape (q,); their sum is 1."""


def _six_points() -> FacetRule:
    """Six points that integrate polynomials of degree 4 exactly (Strang and Fix 1973; Dunavant 1985, degree 4)."""
    shapes, weights = [], []
    for a, weight in ((0.108103018168070, 0.223381589678011), (0.816847572980459, 0.109951743655322)):
        b = 0.5 * (1.0 - a)
        shapes += [[a, b, b], [b, a, b], [b, b, a]]
        weights += [weight] * 3
    return FacetRule(np.array(shapes), np.array(weights) / np.sum(weights))


CORNERS = FacetRule(np.eye(3), np.full(3, 1.0 / 3.0))
"""Exchange at the nodes: matrices are diagonal, and the maximum principle holds where it does for conduction."""
SIX_POINTS = _six_points()
"""Exchange integrated over the triangle: exact for convection."""


class LinearSpace:
    """One unknown temperature per node of the mesh, linear in each tetrahedron."""

    def __init__(self, selection: Selection, *, lumped: bool = True, lumped_boundary: bool = True) -> None:
        """Choose how masses and boundary exchange are integrated.

        Args:
            selection: The mesh and its parts.
            lumped: Put each node's mass on the diagonal.
            lumped_boundary: Evaluate boundary exchange at the nodes.
        """
        self.selection = selection
        self.lumped = lumped
        self.rule = CORNERS if lumped_boundary else SIX_POINTS

    @cached_property
    def edges(self) -> MeshEdges:
        """The edges of the mesh."""
        return mesh_edges(self.selection.mesh.tets, len(self.selection.mesh.points_m))

    @property
    def num_nodes(self) -> int:
        """Number of unknowns."""
        return len(self.selection.mesh.points_m)

    @property
    def points_m(self) -> npt.NDArray[np.float64]:
        """Positions of the unknowns, shape (n, 3), [m]."""
        return self.selection.mesh.points_m

    def from_mesh_nodes(self, nodal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Give unknowns the values that the mesh's nodes have, shape (n, ...)."""
        return nodal

    def stiffness(self, conductivity_w_mk: float | npt.NDArray[np.float64]) -> sparse.csr_matrix:
        """K, entries integral(k grad phi_i . grad phi_j), shape (n, n), [W / K]."""
        mesh = self.selection.mesh
        return assemble_stiffness(mesh.points_m, mesh.tets, conductivity_w_mk, edges=self.edges)

    def mass(
        self, heat_capacity_j_m3k: float | npt.NDArray[np.float64]
    ) -> tuple[sparse.csr_matrix | None, npt.NDArray[np.float64]]:
        """M, entries integral(rho c phi_i phi_j), None if lumped, and its row sums, shapes (n, n) and (n,), [J / K]."""
        mesh = self.selection.mesh
        if self.lumped:
            return None, capacities(mesh.points_m, mesh.tets, heat_capacity_j_m3k)[0]
        edges = self.edges
        nodal, along = capacities(mesh.points_m, mesh.tets, heat_capacity_j_m3k, edges)
        # phi_i^2 integrates to V / 10 in each tetrahedron around node i, phi_i to V / 4.
        return symmetric_matrix(edges, along, 0.4 * nodal), nodal

    def facet_nodes(self, facets: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Nodes of boundary triangles, shape (k, m)."""
        return self.selection.mesh.facets[facets]

    def tet_load(self, tets: npt.NDArray[np.int64], heat_w: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Spread heat that is even in each tetrahedron over the nodes, shape (n,), [W]."""
        nodes = self.selection.mesh.tets[tets]
        return sums_by_number(nodes.ravel(), np.repeat(0.25 * heat_w, 4), self.num_nodes)

    def source_points(self, tets: npt.NDArray[np.int64]) -> tuple[Places, npt.NDArray[np.float64]]:
        """Places where sources in tetrahedra are asked, those of one after the other, and the volume of each, [m3]."""
        return self.selection.tet_places(tets), self.tet_volumes_m3(tets)

    def source_load(self, tets: npt.NDArray[np.int64], point_w: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Spread heat at the points of `source_points` over the nodes, shape (n,), [W]."""
        return self.tet_load(tets, point_w)

    def tet_volumes_m3(self, tets: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Volumes of tetrahedra, shape (k,), [m3]."""
        corner = self.selection.mesh.points_m[self.selection.mesh.tets[tets]]
        side = corner[:, 1:] - corner[:, :1]
        return np.einsum("ti,ti->t", side[:, 0], np.cross(side[:, 1], side[:, 2])) / 6.0

    def node_places(self, nodes: npt.NDArray[np.int64]) -> Places:
        """Give the positions of nodes, with the mean normal of the boundary around them."""
        total = self._normals[nodes]
        length = np.sqrt(np.einsum("ki,ki->k", total, total))[:, None]
        normals = np.divide(total, length, out=np.zeros_like(total), where=length > 0.0)
        return Places(self.points_m[nodes], normals, self.selection.up)

    @cached_property
    def _normals(self) -> npt.NDArray[np.float64]:
        """Sums of the normals around each node by area, shape (n, 3), [m2]."""
        selection = self.selection
        owners = self.facet_nodes(np.arange(len(selection.mesh.facets)))
        weighted = np.repeat(selection.facet_normal * selection.facet_area_m2[:, None], owners.shape[1], axis=0)
        return np.stack([sums_by_number(owners.ravel(), part, self.num_nodes) for part in weighted.T], axis=1)


def sums_by_number(numbers: npt.NDArray[np.int64], values: npt.NDArray, count: int) -> npt.NDArray[np.float64]:
    """Add up values that have the same number; the sums of the numbers 0 to count - 1.

    >>> sums_by_number(np.array([2, 0, 2]), np.array([1.0, 5.0, 3.0]), 4).tolist()
    [5.0, 0.0, 4.0, 0.0]
    """
    # Without values, numpy counts in whole numbers.
    return np.bincount(numbers, values, count).astype(np.float64, copy=False)
