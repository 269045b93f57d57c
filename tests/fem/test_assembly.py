from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from thermoxels_ns.fem.assembly import assemble
from thermoxels_ns.fem.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh


def linear(points: np.ndarray) -> np.ndarray:
    return 20.0 + points @ np.array([3.0, -5.0, 7.0])


@pytest.fixture
def interior(random_body: TetMesh) -> np.ndarray:
    inside = np.ones(len(random_body.points_m), bool)
    inside[random_body.facets] = False
    assert inside.any()
    return inside


def test_linear_temperature_needs_no_heat_inside(random_body, interior, concrete) -> None:
    stiffness = assemble(random_body, concrete).stiffness_w_k
    heat = stiffness @ linear(random_body.points_m)
    assert np.abs(heat[interior]).max() < 1e-12
    assert np.abs(heat[~interior]).max() > 1e-2  # the boundary does need heat: the product is not trivially 0


def test_patch_test_on_a_carved_mesh(random_body, interior, concrete) -> None:
    """Dirichlet values of a linear field on the boundary give that field at every node, to 1e-10."""
    stiffness = assemble(random_body, concrete).stiffness_w_k
    exact = linear(random_body.points_m)
    solved = exact.copy()
    solved[interior] = spsolve(stiffness[interior][:, interior], -stiffness[interior][:, ~interior] @ exact[~interior])
    assert np.abs(solved - exact).max() < 1e-10


def test_patch_test_with_moved_nodes(random_body, interior, concrete) -> None:
    points = random_body.points_m.copy()
    points[interior] += np.random.default_rng(3).uniform(-0.01, 0.01, (int(interior.sum()), 3))
    stiffness = assemble(replace(random_body, points_m=points), concrete).stiffness_w_k
    assert np.abs((stiffness @ linear(points))[interior]).max() < 1e-12


def test_energy_of_a_gradient_is_volume_times_conductivity(random_body, carved_cells, concrete) -> None:
    """T^T K T = k |grad T|^2 V for a linear T."""
    temperature = linear(random_body.points_m)
    volume = carved_cells.sum() * 0.05**3
    energy = temperature @ assemble(random_body, concrete).stiffness_w_k @ temperature
    assert energy == pytest.approx(1.7 * 83.0 * volume, rel=1e-12)


@pytest.mark.parametrize("lumped", [True, False])
def test_mass_holds_the_heat_capacity(random_body, carved_cells, concrete, lumped) -> None:
    matrices = assemble(random_body, concrete, lumped=lumped)
    capacity = carved_cells.sum() * 0.05**3 * 2200.0 * 880.0
    assert matrices.mass_j_k.sum() == pytest.approx(capacity, rel=1e-12)
    np.testing.assert_allclose(np.ravel(matrices.mass_j_k.sum(axis=1)), matrices.nodal_mass_j_k, rtol=1e-12)


def test_single_tetrahedron_by_hand() -> None:
    """Unit corner tetrahedron: consistent mass V/20 (1 + delta_ij), lumped V/4, K from the gradients."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    none = np.zeros((0, 3), np.int64)
    mesh = TetMesh(points, np.array([[0, 1, 2, 3]]), np.zeros(4), np.ones(4, bool), none, none[:, 0], np.zeros(1, int))
    unit = Material("unit", 1.0, 1.0, 1.0)
    matrices = assemble(mesh, unit, lumped=False)
    np.testing.assert_allclose(matrices.mass_j_k.toarray(), (np.ones((4, 4)) + np.eye(4)) / 120.0, rtol=1e-12)
    expected = np.array([[3.0, -1, -1, -1], [-1, 1, 0, 0], [-1, 0, 1, 0], [-1, 0, 0, 1]]) / 6.0
    np.testing.assert_allclose(matrices.stiffness_w_k.toarray(), expected, atol=1e-15)
    np.testing.assert_allclose(assemble(mesh, unit).mass_j_k.toarray(), np.eye(4) / 24.0, rtol=1e-12)


def test_stiffness_of_the_voxel_mesh_is_an_m_matrix(random_body, concrete) -> None:
    """Non-obtuse tetrahedra: no positive off-diagonal entry, symmetric, rows sum to 0."""
    dense = assemble(random_body, concrete).stiffness_w_k.toarray()
    off_diagonal = dense - np.diag(np.diag(dense))
    assert off_diagonal.max() < 1e-15
    assert np.abs(dense - dense.T).max() < 1e-15
    assert np.abs(dense.sum(axis=1)).max() < 1e-14
