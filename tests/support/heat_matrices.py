"""Stiffness and mass of linear tetrahedra, for tests that step or solve by themselves."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from thermoxels_ns.fem.p1_kernels import lumped_mass, stiffness_matrix
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh


@dataclass(frozen=True)
class HeatMatrices:
    """The two matrices of M dT/dt + K T = 0."""

    stiffness_w_k: sparse.csr_matrix
    mass_j_k: sparse.csr_matrix
    nodal_mass_j_k: np.ndarray


def assemble(mesh: TetMesh, material: Material, *, lumped: bool = True) -> HeatMatrices:
    stiffness = stiffness_matrix(mesh.points_m, mesh.tets, material.conductivity_w_mk)
    if lumped:
        nodal = lumped_mass(mesh.points_m, mesh.tets, material.heat_capacity_j_m3k)
        return HeatMatrices(stiffness, sparse.diags(nodal, format="csr"), nodal)
    mass, nodal = Space(Selection(mesh), lumped=False).mass(material.heat_capacity_j_m3k)
    assert mass is not None
    return HeatMatrices(stiffness, mass, nodal)
