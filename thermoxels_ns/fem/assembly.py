"""Stiffness and mass matrices of linear tetrahedra (P1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.fem.elements import capacities, edge_couplings
from thermoxels_ns.fem.problem import Conductor
from thermoxels_ns.fem.sparsity import MeshEdges, mesh_edges, symmetric_matrix
from thermoxels_ns.mesh.tetrahedra import TetMesh


@dataclass(frozen=True)
class HeatMatrices:
    """The two matrices of M dT/dt + K T = 0, assembled once."""

    stiffness_w_k: sparse.csr_matrix
    """K, entries k * integral(grad phi_i . grad phi_j), shape (n, n), [W / K]; its rows sum to 0."""
    mass_j_k: sparse.csr_matrix
    """M, shape (n, n), [J / K]; its entries sum to the body's heat capacity."""
    nodal_mass_j_k: npt.NDArray[np.float64]
    """Row sums of M, rho c * integral(phi_i), shape (n,), [J / K]."""


def assemble(mesh: TetMesh, material: Conductor, *, lumped: bool = True) -> HeatMatrices:
    """Assemble stiffness and mass for linear tetrahedra.

    Args:
        mesh: The body.
        material: What it is made of.
        lumped: Put each row's mass on the diagonal. With non-obtuse tetrahedra, such as the mesher's, backward
            Euler then keeps every temperature within the initial range for any step length (Li and Huang,
            arXiv 1209.5657). The consistent mass does so only for steps above about h^2 / diffusivity, but its
            error at larger steps is smaller by a constant.

    Returns:
        The matrices in SI units.

    Raises:
        HeatError: If a node number is out of range or a tetrahedron is flat or inverted.
    """
    points, tets, capacity = mesh.points_m, mesh.tets, material.heat_capacity_j_m3k
    edges = mesh_edges(tets, len(points))
    stiffness = assemble_stiffness(points, tets, material.conductivity_w_mk, edges=edges)
    if lumped:
        nodal_mass, _ = capacities(points, tets, capacity)
        return HeatMatrices(stiffness, sparse.csr_matrix(sparse.diags(nodal_mass)), nodal_mass)
    return HeatMatrices(stiffness, *assemble_mass(points, tets, capacity, edges=edges))


def assemble_stiffness(
    points_m: npt.NDArray[np.float64],
    tets: npt.NDArray[np.int64],
    conductivity_w_mk: float | npt.NDArray[np.float64],
    *,
    edges: MeshEdges | None = None,
) -> sparse.csr_matrix:
    """Assemble K for linear tetrahedra whose conductivity may differ from one to the next.

    Nodes at the ends of an edge that lies in right angles only are not coupled, and K has no entry for them.

    Args:
        points_m: Nodes, shape (n, 3), [m].
        tets: Node numbers, shape (t, 4), positively oriented.
        conductivity_w_mk: Thermal conductivity, [W / (m K)], one for all or one per tetrahedron, shape (t,).
        edges: The edges of the mesh, if they have been found already.

    Returns:
        K, symmetric bit for bit, rows sum to 0 up to round-off, shape (n, n), [W / K].

    Raises:
        HeatError: If an array has the wrong shape, a conductivity is not above 0, a node number is out of range or a
            tetrahedron is flat or inverted.

    >>> corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> (6 * assemble_stiffness(corner, np.array([[0, 1, 2, 3]]), 1.0)).toarray().round(12).tolist()
    [[3.0, -1.0, -1.0, -1.0], [-1.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 1.0]]
    """
    if edges is None:
        edges = mesh_edges(tets, len(points_m))
    coupling = edge_couplings(points_m, tets, conductivity_w_mk, edges)
    # A constant has no gradient: what couples a node to the others sums to 0.
    diagonal = np.zeros(edges.num_nodes)
    diagonal -= np.bincount(edges.smaller_nodes(), coupling, edges.num_nodes)
    diagonal -= np.bincount(edges.other, coupling, edges.num_nodes)
    return symmetric_matrix(edges, coupling, diagonal)


def assemble_mass(
    points_m: npt.NDArray[np.float64],
    tets: npt.NDArray[np.int64],
    heat_capacity_j_m3k: float | npt.NDArray[np.float64],
    *,
    edges: MeshEdges | None = None,
) -> tuple[sparse.csr_matrix, npt.NDArray[np.float64]]:
    """Assemble the consistent M for linear tetrahedra whose heat capacity may differ from one to the next.

    Args:
        points_m: Nodes, shape (n, 3), [m].
        tets: Node numbers, shape (t, 4), positively oriented.
        heat_capacity_j_m3k: rho c, [J / (m3 K)], one for all or one per tetrahedron, shape (t,).
        edges: The edges of the mesh, if they have been found already.

    Returns:
        mass: M, entries rho c * integral(phi_i phi_j), symmetric bit for bit, shape (n, n), [J / K].
        nodal: Its row sums, which are the lumped mass, shape (n,), [J / K].

    Raises:
        HeatError: If an array has the wrong shape, a heat capacity is not above 0, a node number is out of range or a
            tetrahedron is flat or inverted.
    """
    if edges is None:
        edges = mesh_edges(tets, len(points_m))
    nodal, along = capacities(points_m, tets, heat_capacity_j_m3k, edges)
    # In a tetrahedron of volume V, phi_i integrates to V / 4 and its square to V / 10.
    return symmetric_matrix(edges, along, 0.4 * nodal), nodal
