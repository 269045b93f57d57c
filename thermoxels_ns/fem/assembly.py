"""Stiffness and mass matrices of linear tetrahedra (P1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse
from skfem import Basis, BilinearForm, ElementTetP1, LinearForm, MeshTet
from skfem.helpers import dot

from thermoxels_ns.fem.materials import Material
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


@BilinearForm
def _gradient_product(u: Any, v: Any, _: Any) -> Any:
    return dot(u.grad, v.grad)


@BilinearForm
def _product(u: Any, v: Any, _: Any) -> Any:
    return u * v


@LinearForm
def _integral(v: Any, _: Any) -> Any:
    return 1.0 * v


def assemble(mesh: TetMesh, material: Material, *, lumped: bool = True) -> HeatMatrices:
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
    """
    space = MeshTet(np.ascontiguousarray(mesh.points_m.T), np.ascontiguousarray(mesh.tets.T), validate=False)
    element = ElementTetP1()
    # Gradients are constant and phi is linear: one quadrature point is exact for K and for the row sums of M.
    basis = Basis(space, element, intorder=1)
    stiffness = material.conductivity_w_mk * _gradient_product.assemble(basis).tocsr()
    nodal_mass = material.heat_capacity_j_m3k * _integral.assemble(basis)
    if lumped:
        mass = sparse.csr_matrix(sparse.diags(nodal_mass))
    else:
        mass = material.heat_capacity_j_m3k * _product.assemble(Basis(space, element, intorder=2)).tocsr()
    return HeatMatrices(stiffness, mass, nodal_mass)
