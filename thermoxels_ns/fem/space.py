"""The unknown temperatures of a body: linear (P1) or quadratic (P2) in each tetrahedron."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse
from skfem import Basis, BilinearForm, Dofs, ElementTetP1, ElementTetP2, ElementTriP1, ElementTriP2, MeshTet
from skfem.element import ElementH1
from skfem.helpers import dot
from skfem.quadrature import get_quadrature
from skfem.refdom import RefTet, RefTri

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.linear_tets import FACET_EDGES, TET_EDGES, MeshEdges, mesh_edges, stiffness_matrix
from thermoxels_ns.fem.selection import Places, Selection
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes

Vector = FloatArray
Numbers = IntArray

_CORNERS = (np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.full(3, 1.0 / 6.0))
"""Points and weights of the quadrature at the corners of the reference triangle, which linear tetrahedra use."""
_EXACT = 4  # Degree of exact integrals over triangles of quadratic tetrahedra: products of two quadratic functions
_BLOCK = 2_000  # Tetrahedra assembled at a time, so that scikit-fem's arrays, 4 kB per tetrahedron, fit into a cache


@BilinearForm
def conduction(u, v, w):
    """Return the integrand k grad u . grad v of the stiffness matrix; `w.conductivity` is k, [W / (m K)]."""
    return w.conductivity * dot(u.grad, v.grad)


class Space:
    """The n unknowns of a body: one per node of the mesh, then, for quadratic tetrahedra, one per midpoint of an edge.

    Scikit-fem assembles the stiffness of quadratic tetrahedra, `linear_tets` that of linear ones. With linear
    tetrahedra, convection and radiation are evaluated at the nodes (lumped), which keeps temperatures in the range of
    the surroundings; with quadratic tetrahedra they are integrated over triangles. Quadratic tetrahedra serve steady
    states only: lumped masses of their corners would be negative, and with the consistent mass temperatures leave their
    range in steps below about h^2 / diffusivity.
    """

    def __init__(self, selection: Selection, *, order: int = 1) -> None:
        """Choose linear (`order` 1) or quadratic (2) tetrahedra; raise `HeatError` for any other order."""
        if order not in (1, 2):
            remedy = "Use 1 for linear tetrahedra or 2 for quadratic ones."
            raise HeatError("order", expected="1 or 2", got=repr(order), remedy=remedy)
        self.selection, self.order = selection, order
        self.element = ElementTetP1() if order == 1 else ElementTetP2()

    @cached_property
    def edges(self) -> MeshEdges:
        """The edges of the mesh, found when first asked for."""
        return mesh_edges(self.selection.mesh.tets, len(self.selection.mesh.points_m))

    @property
    def num_nodes(self) -> int:
        """Number of unknowns, n."""
        return len(self.selection.mesh.points_m) + (len(self.edges.ends) if self.order == 2 else 0)

    @property
    def points_m(self) -> Vector:
        """Positions of the unknowns, shape (n, 3), [m]."""
        return self.from_mesh_nodes(self.selection.mesh.points_m)

    def from_mesh_nodes(self, nodal: Vector) -> Vector:
        """Return values at the unknowns, shape (n, ...), from values at the mesh's nodes; midpoints get means."""
        return nodal if self.order == 1 else np.concatenate([nodal, self.edges.midpoints(nodal)])

    def tet_nodes(self) -> Numbers:
        """Return the unknowns of each tetrahedron, shape (t, 4 or 10): corners, then midpoints of `TET_EDGES`."""
        return self._element_nodes(self.selection.mesh.tets, TET_EDGES)

    def facet_nodes(self, facets: Numbers) -> Numbers:
        """Return the unknowns of k boundary triangles, (k, 3 or 6): corners, then midpoints of `FACET_EDGES`."""
        return self._element_nodes(self.selection.mesh.facets[facets], FACET_EDGES)

    def _element_nodes(self, corners: Numbers, ends: Numbers) -> Numbers:
        if self.order == 1:
            return corners
        return np.concatenate([corners, len(self.selection.mesh.points_m) + self.edges.numbers(corners, ends)], axis=1)

    def stiffness(self, conductivity_w_mk: Vector) -> sparse.csr_matrix:
        """Return the stiffness matrix integral(k grad phi_i . grad phi_j), (n, n), [W / K], for k of shape (t,)."""
        mesh = self.selection.mesh
        if self.order == 1:
            return stiffness_matrix(mesh.points_m, mesh.tets, conductivity_w_mk)
        return self.assembled(conduction, 2, conductivity=conductivity_w_mk)

    def assembled(self, form: BilinearForm, degree: int, **tet_values: Vector) -> sparse.csr_matrix:
        """Return the matrix of a symmetric form, (n, n), assembled by scikit-fem and symmetric bit for bit.

        Quadrature is exact for polynomials of `degree`; `tet_values` are parameters of the form, each of shape (t,).
        """
        points_m, tets, nodes = self.selection.mesh.points_m, self.selection.mesh.tets, self.tet_nodes()
        parts = []
        for begin in range(0, len(tets), _BLOCK):
            block = slice(begin, begin + _BLOCK)
            # Tetrahedra of a block share no corners in scikit-fem's mesh, but do share unknowns.
            corners = points_m[tets[block]].reshape(-1, 3)
            mesh = MeshTet(corners.T.copy(), np.arange(len(corners)).reshape(-1, 4).T.copy(), validate=False)
            used, local = np.unique(nodes[block], return_inverse=True)
            dofs = Dofs(mesh, ElementTetP1())  # our numbers of unknowns: its own search for edges is ten times slower
            dofs.element_dofs, dofs.N = np.ascontiguousarray(local.reshape(len(mesh.t.T), -1).T, np.int32), len(used)
            basis = Basis(mesh, self.element, dofs=dofs, intorder=degree, disable_doflocs=True)
            parameters = {
                name: np.broadcast_to(value[block, None], basis.dx.shape) for name, value in tet_values.items()
            }
            part = sparse.triu(form.coo_data(basis, **parameters).tocsr(), format="coo")
            parts.append((part.data, used[part.row].astype(np.int32), used[part.col].astype(np.int32)))
        data, rows, columns = (np.concatenate(list(arrays)) for arrays in zip(*parts))
        del parts
        upper = sparse.csr_matrix((data, (rows, columns)), shape=(self.num_nodes, self.num_nodes))
        del data, rows, columns
        return sparse.csr_matrix(upper + sparse.triu(upper, 1, format="csr").T)

    def facet_rule(self, facets: Numbers) -> tuple[Numbers, Vector, Vector, Places]:
        """Return how to integrate over k boundary triangles with the numbers `facets`, (k,), with q points in each.

        The result is the m unknowns of each, (k, m), the m shape functions at the points, (m, q), the points' weights,
        (k, q), [m2], which add up to a triangle's area, and the k centroids, at which quantities are evaluated.
        """
        points, weights = _CORNERS if self.order == 1 else get_quadrature(RefTri, _EXACT)
        element = ElementTriP1() if self.order == 1 else ElementTriP2()
        sizes = 2.0 * self.selection.facet_area_m2[facets][:, None] * weights
        shapes = _shapes(element, points, 3 * self.order)
        return self.facet_nodes(facets), shapes, sizes, self.selection.facet_places(facets)

    def tet_rule(self, tets: Numbers) -> tuple[Numbers, Vector, Vector, Places]:
        """Return how to integrate sources over k tetrahedra, exactly for polynomials of degree `order`.

        The result is as in `facet_rule` with weights in [m3], but the places are all k q integration points.
        """
        (points, weights), mesh, nodes = get_quadrature(RefTet, self.order), self.selection.mesh, self.tet_nodes()[tets]
        barycentric = np.concatenate([1.0 - points.sum(axis=0, keepdims=True), points])
        places = np.einsum("aq,tai->tqi", barycentric, mesh.points_m[mesh.tets[tets]]).reshape(-1, 3)
        sizes = 6.0 * signed_volumes(mesh.points_m, mesh.tets[tets])[:, None] * weights
        shapes = _shapes(self.element, points, nodes.shape[1])
        return nodes, shapes, sizes, Places(places, np.zeros_like(places), self.selection.up)


def _shapes(element: ElementH1, points: Vector, count: int) -> Vector:
    """Return the first `count` shape functions of an element at q points of the reference cell, shape (count, q)."""
    return np.stack([element.lbasis(points, i)[0] * np.ones(points.shape[1]) for i in range(count)])


def sums_by_number(numbers: Numbers, values: npt.NDArray, count: int) -> Vector:
    """Return for each number from 0 to count - 1 the sum of the `values` that have this number, shape (count,).

    >>> sums_by_number(np.array([2, 0, 2]), np.array([1.0, 5.0, 3.0]), 4).tolist()
    [5.0, 0.0, 4.0, 0.0]
    """
    # `np.bincount` of empty arrays returns integers, hence the conversion.
    return np.bincount(numbers, values, count).astype(np.float64, copy=False)
