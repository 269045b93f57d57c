"""Stiffness and mass of linear tetrahedra, for tests that step or solve by themselves."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from skfem import BilinearForm

from thermoxels_ns.fem.implicit_equation import LinearSolver
from thermoxels_ns.fem.linear_tets import lumped_mass, stiffness_matrix
from thermoxels_ns.fem.problem import TimeSteps
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh


@dataclass(frozen=True)
class HeatMatrices:
    """The two matrices of M dT/dt + K T = 0."""

    stiffness_w_k: sparse.csr_matrix
    mass_j_k: sparse.csr_matrix

    @property
    def nodal_mass_j_k(self) -> np.ndarray:
        return self.mass_j_k @ np.ones(self.mass_j_k.shape[0])


@BilinearForm
def storage(u, v, w):
    return w.heat_capacity * u * v


def assemble(mesh: TetMesh, material: Material, *, lumped: bool = True) -> HeatMatrices:
    """The product's matrices, or with the consistent mass by scikit-fem, as other programs have it."""
    stiffness = stiffness_matrix(mesh.points_m, mesh.tets, np.full(len(mesh.tets), material.conductivity_w_mk))
    capacity = np.full(len(mesh.tets), material.heat_capacity_j_m3k)
    if lumped:
        nodal = lumped_mass(mesh.points_m, mesh.tets, capacity)
        return HeatMatrices(stiffness, sparse.diags(nodal, format="csr"))
    return HeatMatrices(stiffness, Space(Selection(mesh)).assembled(storage, 2, heat_capacity=capacity))


def backward_euler(matrices: HeatMatrices, start_c: np.ndarray, time: TimeSteps) -> np.ndarray:
    """Steps with given matrices and our linear solver, shape (steps, n)."""
    solver = LinearSolver((matrices.mass_j_k / time.step_seconds + matrices.stiffness_w_k).tocsr())
    states = [start_c]
    for _ in range(time.steps):
        change = solver.solve(-(matrices.stiffness_w_k @ states[-1]))
        assert change.converged
        states.append(states[-1] + change.x)
    return np.array(states[1:])
